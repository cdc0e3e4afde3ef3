"""A robot of which one process is replaced by one that the suite has broken."""

import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.subject import Change, Subject
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

MODULES = "gigabrain_zenoh.qa.faults."


def as_module(names: tuple[str, ...], module: str, *words: str) -> Change:
    """The same processes; those named run as `python -m gigabrain_zenoh.qa.faults.MODULE WORDS`."""

    def change(specs: list[ProcessSpec]) -> list[ProcessSpec]:
        command = (sys.executable, "-P", "-m", MODULES + module, *words)
        return [
            replace(spec, argv=(*command, spec.argv[-1])) if spec.name in names else spec
            for spec in specs
        ]

    return change


@asynccontextmanager
async def tampered(rig: Rig, *kinds: str) -> AsyncIterator[Subject]:
    """A robot of a test's own whose driver sends what `kinds` say, see `tampering`."""
    await rig.give_up()
    change = as_module(("driver",), "tampering", ",".join(kinds))
    async with rig.new(deployment_of(rig.options, "sim"), change) as subject:
        await subject.settle()
        yield subject
        await subject.check()


def go_on(subject: Subject) -> None:
    """The next kind of tampering begins, or the present one ends."""
    subject.send("driver", signal.SIGUSR1)
