"""Small processes for tests of the supervisor, and helpers to observe them."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from gigabrain_zenoh.runtime.fork_server import ForkRequest
from gigabrain_zenoh.runtime.supervisor import Backoff, ProcessSpec, Supervisor
from gigabrain_zenoh.testing.waiting import settle, until
from tests.places import ROOT

QUICK = Backoff(first_s=0.01, factor=2.0, longest_s=0.04)
CHILD = f"""
import json, os, signal, subprocess, sys, time
sys.path.insert(0, {str(ROOT)!r})
from gigabrain_zenoh.host import this_process as lifeline
def say(event, **data):
    print(json.dumps({{"event": event, **data}}), file=sys.stderr, flush=True)
def wait():
    while True:
        time.sleep(60)
"""
SERVE = "say('ready'); wait()"
HANG = "signal.signal(signal.SIGTERM, signal.SIG_IGN); say('ready'); wait()"


def spec(name: str, code: str = SERVE, *after: str, **more: Any) -> ProcessSpec:
    return ProcessSpec(name, (sys.executable, "-c", CHILD + code), after, **more)


def forked(name: str, code: str = SERVE, *after: str, **more: Any) -> ProcessSpec:
    """Return such a process that a fork server may start. Needs ROOT in PYTHONPATH."""
    imports = more.pop("imports", ((__name__,),))
    request = ForkRequest("tests.system.children:run", CHILD + code, f"forked {name}", imports)
    return spec(name, code, *after, fork=request, **more)


def run(code: str) -> int:
    exec(code, {"__name__": "forked"})
    return 0


class Records:
    def __init__(self) -> None:
        self.all: list[tuple[str, Mapping[str, Any]]] = []

    def __call__(self, name: str, record: Mapping[str, Any]) -> None:
        self.all.append((name, record))

    def events(self) -> list[tuple[str, str]]:
        return [(name, record["event"]) for name, record in self.all]

    def texts(self, event: str) -> list[str]:
        return [record["text"] for _, record in self.all if record["event"] == event]


@asynccontextmanager
async def running(
    *specs: ProcessSpec, backoff: Backoff = QUICK
) -> AsyncIterator[tuple[Supervisor, Records]]:
    records = Records()
    async with Supervisor(specs, records, backoff) as supervisor:
        task = asyncio.create_task(supervisor.run())
        yield supervisor, records
        pids = [status.pid for status in supervisor.statuses.values() if status.pid]
        await supervisor.stop(within_s=1.0)
        await task
    for pid in pids:
        with pytest.raises(ProcessLookupError):  # not even a zombie
            os.kill(pid, 0)


def state(pid: int) -> str:
    """Return the state letter in /proc (`S`, `T`, `Z`, ...); empty without the process or /proc."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    return ""


def alive(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return state(pid) not in ("Z", "X")


async def reaped(pid: int) -> None:
    """Wait until a process is gone, and asyncio's waiting thread has informed the event loop."""
    await until(lambda: not state(pid))
    await until(lambda: not any("waitpid" in each.name for each in threading.enumerate()))
    await settle()


async def freeze(pid: int | None) -> None:
    assert pid
    os.kill(pid, signal.SIGSTOP)
    if sys.platform == "linux":  # else a later signal may arrive before the process stops
        await until(lambda: state(pid) == "T")


PARENT = f"""
import asyncio, json, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have ignored it
sys.path.insert(0, {str(ROOT)!r})
from gigabrain_zenoh.runtime.supervisor import ProcessSpec, Supervisor
codes = json.loads(sys.argv[1])
specs = [ProcessSpec(n, (sys.executable, "-c", code)) for n, code in codes.items()]
def show(name, record):
    if record["event"] == "ready":
        print(json.dumps([name, supervisor.statuses[name].pid]), flush=True)
supervisor = Supervisor(specs, show)
asyncio.run(supervisor.run())
"""


@contextmanager
def another_supervisor(
    parent_code: str = PARENT, /, **codes: str
) -> Iterator[tuple[subprocess.Popen[str], dict[str, int]]]:
    """Run a supervisor in another process; yield it and the pids of its ready processes."""
    argv = [sys.executable, "-c", parent_code, json.dumps(codes)]
    pids: dict[str, int] = {}
    with subprocess.Popen(
        argv, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as parent:
        assert parent.stdout
        try:
            while len(pids) < len(codes):
                name, pid = json.loads(parent.stdout.readline())
                pids[name] = pid
            yield parent, pids
        finally:
            parent.kill()
            for pid in pids.values():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
