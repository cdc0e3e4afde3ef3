"""`gigabrain bench fetch`: a robot with a base and an arm brings a can; the physics judge it."""

import json
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.sim import SimPoses
from gigabrain_schemas.topics import SIM_POSES, SIM_SCENE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.decision.tasks.arm_steps import Solid
from gigabrain_zenoh.decision.tasks.mission import Mission, Step, text_of
from gigabrain_zenoh.errors import BodyLost, Refused
from gigabrain_zenoh.geometry.pose import compose, inverse, to_parent
from gigabrain_zenoh.navigation.global_planner import warm_up
from gigabrain_zenoh.qa.bench.clutter import (
    START_TIMEOUT_S,
    CourseDriver,
    Over,
    Progress,
    lock_stepped,
)
from gigabrain_zenoh.qa.bench.cluttered_worlds import ClutteredWorld, Point
from gigabrain_zenoh.qa.robot_under_test import ProcessGroup, measured_robot

LONG_M, WIDE_M = 6.0, 4.0  # two rooms together; the wall between them has a door
DOOR_M = 1.2
# 0.12 m tall, 160 g: a label with a band between two rims of metal; its core stands on the floor
CAN = """<mujoco>
  <default><geom type="cylinder" condim="6" friction="1 .02 .0005" rgba=".8 .81 .83 1"/></default>
  <worldbody><body name="can" pos="{x} {y} .06">
    <freejoint/>
    <geom size=".0335 .05" mass=".15" rgba=".78 .16 .12 1"/>
    <geom size=".03 .0567" mass="0" contype="0" conaffinity="0"/>
    <geom size=".0336 .015" pos="0 0 .006" mass="0" contype="0" conaffinity="0" rgba=".95 .9 .8 1"/>
    <geom size=".027 .06" mass=".01"/>
  </body></worldbody></mujoco>
"""
AHEAD_M = 0.3  # distance from the body at which it puts the can down
BROUGHT_M = 0.15  # largest error of the can's place: the base may miss its goal by 10 cm
UPRIGHT = 0.95  # cosine of the can's tilt
GAP_M = 0.55  # between things, enough for a base
CARTONS = 4
WALK_M_S = 0.4  # speed of the person


class FetchRun(Struct, frozen=True, kw_only=True):
    """The result of one world."""

    seed: int
    outcome: str  # "brought" or "not brought"
    reason: str = ""
    off_m: float | None = None  # distance of the can from its target, by the physics
    contacts: int = 0  # of base and arm; those of the hand do not count
    seconds: float = 0.0  # of the robot's time
    distance_m: float = 0.0
    alone: int = 0  # ticks that did not wait for the brain


class FetchResult(Struct, frozen=True, kw_only=True):
    """The results of all worlds."""

    body: str
    speed: float
    people: bool
    runs: tuple[FetchRun, ...]


class FetchWorld(Struct, frozen=True, kw_only=True):
    """Two rooms with cartons: the can is in the far one, its target in the near one."""

    start: Pose
    can: Point
    drop: Pose  # of the body, to put the can down
    cartons: tuple[tuple[float, float, float, float], ...]  # x, y, side, height [m]
    door: float  # [m], y of its middle


async def measure_fetch(
    seeds: Sequence[int], body: str, speed: float, seconds: float, show: Progress, *, people: bool
) -> FetchResult:
    """Let a robot fetch a can in each world. Raises GigabrainError when a process dies."""
    warm_up()
    runs: list[FetchRun] = []
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
            runs.append(await _fetch(seed, body, speed, seconds, Path(folder), people=people))
        show(in_words(runs[-1]))
    return FetchResult(body=body, speed=speed, people=people, runs=tuple(runs))


def in_words(run: FetchRun) -> str:
    """Return the result of one world as text."""
    off = "" if run.off_m is None else f", {run.off_m * 100:.0f} cm off"
    reason = f": {run.reason}" if run.reason else ""
    return (
        f"world {run.seed}: {run.outcome}{off}{reason}; {run.contacts} contacts, "
        f"{run.distance_m:.1f} m, {run.seconds:.0f} s"
    )


def draw(seed: int) -> FetchWorld:
    """Return the world of a seed."""
    random = np.random.default_rng(np.random.SeedSequence((seed, 1802)))
    half_x, half_y = LONG_M / 2, WIDE_M / 2
    places: list[tuple[Point, float]] = []

    def place(low: float, high: float, radius: float) -> Point:
        """Return a free place with x between `low` and `high` [m], and reserve it."""
        while True:
            x = float(random.uniform(low + radius + 0.35, high - radius - 0.35))
            y = float(random.uniform(-half_y + radius + 0.35, half_y - radius - 0.35))
            if all(math.dist((x, y), at) > GAP_M + radius + other for at, other in places):
                places.append(((x, y), radius))
                return x, y

    door = float(random.uniform(-half_y + 0.9, half_y - 0.9))
    places.append(((0.0, door), DOOR_M / 2))
    start, drop, can = place(-half_x, 0.0, 0.2), place(-half_x, 0.0, 0.3), place(0.0, half_x, 0.1)
    cartons = []
    for number in range(CARTONS):
        side, height = float(random.uniform(0.2, 0.4)), float(random.uniform(0.2, 0.5))
        low, high = (0.0, half_x) if number % 2 else (-half_x, 0.0)
        cartons.append((*place(low, high, side / 2), side, height))
    turn, heading = random.uniform(-math.pi, math.pi, 2).tolist()
    return FetchWorld(
        start=Pose(x=start[0], y=start[1], yaw=turn),
        can=can,
        drop=Pose(x=drop[0], y=drop[1], yaw=heading),
        cartons=tuple(cartons),
        door=door,
    )


def write(world: FetchWorld, folder: Path, *, people: bool) -> Path:
    """Write a world's files; return the path of the world file."""
    (folder / "can.xml").write_text(CAN.format(x=world.can[0], y=world.can[1]))
    half = WIDE_M / 2
    wall = {
        "from": [0.0, -half], "to": [0.0, half],
        "doors": [{"at": world.door + half, "width": DOOR_M}],
    }  # fmt: skip
    walk = [[-LONG_M / 2 + 0.6, world.door], [LONG_M / 2 - 0.6, world.door]]
    content = {
        "size": [LONG_M, WIDE_M],
        "start": [world.start.x, world.start.y, world.start.yaw],
        "model": "can.xml",
        "walls": [wall],
        "boxes": [
            {"at": [x, y], "size": [side, side, height], "material": "carton"}
            for x, y, side, height in world.cartons
        ],
        "people": [{"path": walk, "speed": WALK_M_S}] if people else [],
    }
    path = folder / "fetch.yaml"
    path.write_text(json.dumps(content), "utf-8")  # JSON is YAML
    return path


def fetch_mission(drop: Pose) -> str:
    """Return the mission that puts the can in front of a pose of the body, in the map."""
    return text_of(
        Mission(
            things={"can": Solid(label="can")},
            do=(
                Step(find="can"),
                Step(pick="can"),
                Step(posture="carry"),
                Step(goto=(drop.x, drop.y, drop.yaw)),
                Step(place=(AHEAD_M, 0.0)),
                Step(posture="home"),
            ),
        )
    )


class FetchDriver(CourseDriver):
    """Sends a robot the mission to bring the can, and records contacts and falls."""

    def __init__(
        self, bus: Bus, group: ProcessGroup, world: ClutteredWorld, seconds: float
    ) -> None:
        super().__init__(bus, group, world, seconds)
        self._scenes, self._sim_poses = bus.latest(SIM_SCENE), bus.latest(SIM_POSES)

    async def fetch(self, drop: Pose) -> str:
        """Bring the can to a pose in the world; return why that failed, empty on success."""
        await self.begin()
        in_map = compose(inverse(self.world_from_map), drop)
        try:
            mission = fetch_mission(in_map)
            task = await self.accepted(lambda: self.tasks.carry_out(mission, label="fetch"))
            ended = await self.while_running(self.tasks.result(task))
        except (Refused, BodyLost) as refusal:
            return f"refused: {refusal}"
        except Over as end:
            return str(end)
        return "" if ended.state == "succeeded" else ended.reason

    def can(self) -> tuple[Floats, float] | None:
        """Return the can's true position (3,) [m] and the cosine of its tilt; None if unknown."""
        scene, poses = self._scenes.current, self._sim_poses.current
        if scene is None or poses is None or poses.version != scene.version:
            return None
        return _pose_of(poses, scene.bodies.index("world/can") - 1)


def _pose_of(poses: SimPoses, row: int) -> tuple[Floats, float]:
    x, y, z, _, a, b, _ = np.frombuffer(poses.poses, "<f4").reshape(-1, 7)[row].tolist()
    return np.array([x, y, z]), 1.0 - 2.0 * (a * a + b * b)


async def _fetch(
    seed: int, body: str, speed: float, seconds: float, folder: Path, *, people: bool
) -> FetchRun:
    world = draw(seed)
    deployment = lock_stepped(body, write(world, folder, people=people), seed, speed)
    course = ClutteredWorld(seed, (), (), (), world.start, (), ())
    async with measured_robot(deployment, folder, START_TIMEOUT_S) as (group, bus):
        driver = FetchDriver(bus, group, course, seconds)
        reason = await driver.fetch(world.drop)
        report = await driver.look()
        found = driver.can()
    target = to_parent(world.drop, AHEAD_M, 0.0)
    run = FetchRun(
        seed=seed,
        outcome="not brought",
        reason=reason,
        contacts=int(report["contacts"]),
        seconds=round(driver.seconds, 1),
        distance_m=report["distance_m"],
        alone=int(report["lockstep_timeouts"]),
    )
    if found is None:
        return run
    place, upright = found
    off = round(math.dist(place[:2], target), 3)
    brought = not reason and off <= BROUGHT_M and upright > UPRIGHT
    outcome = "brought" if brought else "not brought"
    return msgspec.structs.replace(run, outcome=outcome, off_m=off)
