"""A robot that knows nothing explores its world, then is sent to places drawn at random.

All processes run as under `gigabrain up`; contacts, clearance and how exactly it gets there are the
simulation's truth.
"""

import asyncio
import contextlib
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec
import yaml
from msgspec import Struct

from gigabrain_drivers.driver.catalog import robot_path
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.navigation.planner import warm_up
from gigabrain_zenoh.qa.bench.goals_sender import Failure, Off, Sender
from gigabrain_zenoh.qa.bench.group import client, running
from gigabrain_zenoh.qa.bench.growth import Growth
from gigabrain_zenoh.qa.bench.runs import LOOPBACK
from gigabrain_zenoh.runtime.deployment import Deployment, client_endpoint, with_free_port

START_S = 600.0  # a robot's processes and its first map, on a busy machine
REACHED = 0.99  # of all goals
CAPACITY_AH = 1000.0  # of a body that drives for hours: in two, a burger's own battery is empty

Say = Callable[[str], None]


class Course(Struct, frozen=True, kw_only=True):
    """What a robot has to go through."""

    goals: int
    meetings: int = 0  # it is sent on until it has met the person so often
    hours: float = 0.0  # and for so long, of the robot's time
    speed: float = 5.0
    seed: int = 0
    logs: Path | None = None  # where the processes' logs are kept


class GoalFigures(Struct, frozen=True, kw_only=True):
    """How one body fared in one world."""

    body: str
    world: str
    speed: float
    accepted_s: float  # of the host's time, from the start of the processes to the first task
    explored: str  # how exploring ended
    explored_s: float  # of the robot's time
    goals: int
    reached: int
    off: tuple[Off, ...]  # wherever it said that it was there
    contacts: int
    min_clearance_m: float
    met: int  # how often the person had to stand for the robot
    distance_m: float
    seconds: float  # of the robot's time, in all
    alone: int  # ticks that went on without the brain, on a host too busy for the speed
    failures: tuple[Failure, ...]
    growth: Growth  # of perception

    @property
    def worst_m(self) -> float:
        """How far from a goal it came to rest at most [m]."""
        return max((off.m for off in self.off), default=0.0)

    @property
    def worst_rad(self) -> float:
        """How far from a wanted heading it came to rest at most [rad]."""
        return max((off.rad for off in self.off if off.rad is not None), default=0.0)

    @property
    def seconds_per_goal(self) -> float:
        """Mean of the robot's time from one goal to the next [s]."""
        return (self.seconds - self.explored_s) / self.goals

    @property
    def ok(self) -> bool:
        """Whether it touched nothing and got to nearly all of its goals."""
        return self.contacts == 0 and self.reached >= REACHED * self.goals


class GoalsResult(Struct, frozen=True, kw_only=True):
    """All bodies in all worlds."""

    seed: int
    runs: tuple[GoalFigures, ...]

    @property
    def ok(self) -> bool:
        """Whether all did well."""
        return all(run.ok for run in self.runs)


async def measure_goals(
    bodies: Sequence[str], worlds: Sequence[str], course: Course, say: Say
) -> GoalsResult:
    """Send each body through each world, on the same course.

    Raises GigabrainError when a process dies on the way.
    """
    warm_up()
    runs = []
    for world in worlds:
        for body in bodies:
            deployment = Deployment(
                body=body,
                world=world,
                seed=course.seed,
                speed=course.speed,
                resume="auto",
                router=LOOPBACK,
                perception=PerceptionConfig(mapping="slam"),
                decision=DecisionConfig(behaviour="navigate"),
            )
            runs.append(await _run(with_free_port(deployment), course, say))
    return GoalsResult(seed=course.seed, runs=tuple(runs))


async def _run(deployment: Deployment, course: Course, say: Say) -> GoalFigures:
    """One body in one world, from its start to its end."""
    who = deployment.body
    name = f"{who} in {deployment.world}"
    with _folder(course, name.replace(" ", "-")) as folder:
        if course.hours:
            body = str(with_capacity(robot_path(deployment.body), folder / "body"))
            deployment = msgspec.structs.replace(deployment, body=body)
        specs = process_specs(deployment, "robot", folder, folder / "state")
        say(f"{name}: starting")
        began_s = asyncio.get_running_loop().time()
        async with (
            running(specs, START_S) as group,
            client(client_endpoint(deployment)) as bus,
        ):
            sender = Sender(bus, group, deployment.seed)
            await group.until(lambda: sender.knows_its_place, START_S)
            say(f"{name}: exploring")
            explored = await sender.explore()
            explored_s = sender.seconds
            while not await sender.done(course.goals, course.meetings, course.hours):
                await sender.send()
                say(f"{name}: {sender.reached} of {sender.sent} reached")
            report, growth = await sender.report(), sender.growth()
    return GoalFigures(
        body=who,
        world=deployment.world,
        speed=deployment.speed,
        accepted_s=round(sender.accepted_s - began_s, 2),
        explored=explored,
        explored_s=explored_s,
        goals=sender.sent,
        reached=sender.reached,
        off=tuple(sender.off),
        contacts=int(report["contacts"]),
        min_clearance_m=report["min_clearance_m"],
        met=int(report["person_stood"]),
        distance_m=report["distance_m"],
        seconds=report["sim_seconds"],
        alone=int(report["lockstep_timeouts"]),
        failures=tuple(sender.failures),
        growth=growth,
    )


def with_capacity(robot: Path, folder: Path) -> Path:
    """Copy a robot's folder and give its simulation a large battery; return the new file."""
    shutil.copytree(robot.parent, folder, dirs_exist_ok=True)
    described = yaml.safe_load(robot.read_text("utf-8"))
    described["sim"] = (described.get("sim") or {}) | {"battery_capacity": CAPACITY_AH}
    copy = folder / robot.name
    copy.write_text(yaml.safe_dump(described), "utf-8")
    return copy


@contextlib.contextmanager
def _folder(course: Course, name: str) -> Iterator[Path]:
    """Where the logs of one run go."""
    if course.logs:
        folder = course.logs / name
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as temporary:
        yield Path(temporary)
