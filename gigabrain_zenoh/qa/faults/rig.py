"""What fault tests run on: one robot at a time, used again by as many tests as it stands."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from gigabrain_drivers.emulators.emulator import wire_of
from gigabrain_zenoh.config.settings import DecisionConfig, LinkName, PerceptionConfig, Resume
from gigabrain_zenoh.qa.faults.fault import Skipped, Stage
from gigabrain_zenoh.qa.faults.subject import TIRELESS, Change, Subject
from gigabrain_zenoh.runtime.deployment import Deployment
from gigabrain_zenoh.runtime.managed_process import Backoff

SPEED = 0.26  # [m/s], of all tests that do not say otherwise
BODIES: dict[Stage, str] = {
    "sim": "turtlebot3_waffle",
    "auto": "turtlebot3_waffle",
    "line": "mycustombot",
    "serial": "mycustombot",
    "tcp": "alpha",
}


@dataclass(frozen=True)
class Options:
    """How the suite is run."""

    body: str = ""  # instead of the one that each stage has
    world: str = "arena"
    behaviour: Literal["avoid", "navigate"] = "avoid"
    long: bool = False  # the forms for a release, instead of those for every change
    wall: bool = True  # judge wall-clock limits as well, which need a machine with nothing beside


class Rig:
    """Hands out running robots. Used as `async with`; no process is left afterwards."""

    def __init__(self, options: Options, folder: Path) -> None:
        self.options, self.folder = options, folder
        self._numbers = itertools.count(1)
        self._kept: tuple[Deployment, Subject] | None = None
        self._subjects: list[Subject] = []

    def pids(self) -> list[int]:
        """Return the pids of all processes that are ready, of the robots that run now."""
        return [pid for subject in self._subjects for pid in subject.ready_pids()]

    @property
    def long(self) -> bool:
        """Whether there is time for the long forms."""
        return self.options.long

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.give_up()

    async def robot(self, stage: Stage) -> Subject:
        """The robot of a stage: the one that runs if it is unharmed, else a new one.

        Raises Skipped where the chosen body cannot play that part.
        """
        kept, wanted = self._kept, deployment_of(self.options, stage)
        if kept and (kept[0] != wanted or not kept[1].unharmed):
            await self.give_up()
        if self._kept is None:
            self._kept = wanted, await self.new(wanted).__aenter__()
        _, subject = self._kept
        await subject.settle()
        return subject

    def new(
        self,
        deployment: Deployment,
        change: Change | None = None,
        backoff: Backoff = TIRELESS,
        *,
        keep_stuck: bool = True,
    ) -> Subject:
        """A robot of a test's own, not started yet; to be used as `async with`.

        Call `give_up` first, so that two robots do not share the machine.
        """
        subject = Subject(deployment, self.fresh_folder(), change, backoff, keep_stuck=keep_stuck)
        self._subjects.append(subject)
        return subject

    def fresh_folder(self) -> Path:
        """An empty folder of a test's own."""
        folder = self.folder / str(next(self._numbers))
        folder.mkdir(parents=True)
        return folder

    async def give_up(self) -> None:
        """End the running robot. The next test gets a new one."""
        kept, self._kept = self._kept, None
        if kept:
            await kept[1].close()

    async def check(self) -> None:
        """Raise Failed where a test has left contacts or a dead program behind."""
        if self._kept:
            await self._kept[1].check()


def deployment_of(options: Options, stage: Stage, resume: Resume = "manual") -> Deployment:
    """What runs on a stage. Raises Skipped where the chosen body has no such link."""
    body = options.body or BODIES[stage]
    link: LinkName = "sim" if stage in ("sim", "auto") else "emulated"
    wire: Literal["serial", "tcp", ""] = wire_of(body) if link == "emulated" else ""
    if link == "emulated" and not (wire == stage or (wire and stage == "line")):
        raise Skipped(f"{body} has no {stage} line" if stage != "line" else f"{body} has no line")
    return Deployment(
        body=body,
        link=link,
        world=options.world,
        resume="auto" if stage == "auto" else resume,
        router="tcp/127.0.0.1:0",
        perception=PerceptionConfig(mapping="slam" if options.behaviour == "navigate" else "off"),
        decision=DecisionConfig(
            behaviour=options.behaviour, linear_speed=SPEED, speed_limit=SPEED, begin="roam"
        ),
    )
