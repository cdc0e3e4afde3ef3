"""`gigabrain bench objects`: compares a robot's remembered objects with the true ones in a room."""

import json
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec import Struct

from gigabrain_schemas.base import Pose
from gigabrain_schemas.objects import MapObject
from gigabrain_schemas.topics import OBJECT_MAP
from gigabrain_zenoh.geometry.pose import to_parent
from gigabrain_zenoh.navigation.global_planner import warm_up
from gigabrain_zenoh.qa.bench.clutter import START_TIMEOUT_S, CourseDriver, lock_stepped
from gigabrain_zenoh.qa.bench.cluttered_worlds import ClutteredWorld, Point
from gigabrain_zenoh.qa.robot_under_test import measured_robot
from gigabrain_zenoh.qa.train.looks import MAKERS, Geom, Look

CLASSES = ("cube", "ball", "cylinder", "can", "box")
HALF_M = 2.6  # half the room's width
THINGS, GOALS = 7, 8
GAP_M, GOAL_GAP_M, START_GAP_M = 0.7, 0.45, 0.8  # between things; from a goal, and from the start
SAME_M = 0.3  # largest distance of a remembered thing from the true one
COLOURS = ((0.75, 0.2, 0.15), (0.15, 0.35, 0.7), (0.9, 0.7, 0.2), (0.2, 0.55, 0.3), (0.8, 0.8, 0.8))
CARTON = (0.68, 0.5, 0.33)
GEOMS = ("box", "cylinder", "sphere", "capsule", "ellipsoid")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Placed:
    """A thing of the world."""

    look: Look
    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad]


class ObjectRun(Struct, frozen=True, kw_only=True):
    """The result of one world."""

    seed: int
    things: tuple[str, ...]  # classes
    found: tuple[bool, ...]  # for each, whether it is remembered with its class
    errors_m: tuple[float, ...]  # position errors of the found ones
    false: tuple[str, ...]  # classes of remembered things that do not exist
    goals: int  # number of reached goals
    contacts: int


class ObjectsResult(Struct, frozen=True, kw_only=True):
    """The results of all worlds."""

    body: str
    speed: float
    runs: tuple[ObjectRun, ...]


async def measure_objects(
    seeds: Sequence[int], body: str, speed: float, seconds: float, show: Progress
) -> ObjectsResult:
    """Drive a robot with cameras to eight places in each world, and judge its object map.

    Raises GigabrainError when a process dies.
    """
    warm_up()
    runs: list[ObjectRun] = []
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
            runs.append(await _drive(seed, body, speed, seconds, Path(folder)))
        show(in_words(runs[-1]))
    return ObjectsResult(body=body, speed=speed, runs=tuple(runs))


def in_words(run: ObjectRun) -> str:
    """Return the result of one world as text."""
    missed = [one for one, found in zip(run.things, run.found, strict=True) if not found]
    text = f"world {run.seed}: {sum(run.found)} of {len(run.found)} things"
    if run.errors_m:
        text += f", {100 * float(np.median(run.errors_m)):.1f} cm off"
    text += f"; missed {', '.join(missed)}" if missed else ""
    text += f"; not there {', '.join(run.false)}" if run.false else ""
    return f"{text}; {run.goals} of {GOALS} places, {run.contacts} contacts"


async def _drive(seed: int, body: str, speed: float, seconds: float, folder: Path) -> ObjectRun:
    placed, course = draw(seed)
    deployment = lock_stepped(body, write(course, placed, folder), seed, speed)
    async with measured_robot(deployment, folder, START_TIMEOUT_S) as (group, bus):
        objects = bus.latest(OBJECT_MAP)
        driver = CourseDriver(bus, group, course, seconds)
        await driver.drive()
        report = await driver.look()
        remembered = objects.current.objects if objects.current else ()
    found, errors, false = judged(placed, remembered, driver.world_from_map)
    return ObjectRun(
        seed=seed,
        things=tuple(one.look.label for one in placed),
        found=found,
        errors_m=errors,
        false=false,
        goals=driver.reached,
        contacts=int(report["contacts"]),
    )


def judged(
    placed: Sequence[Placed], remembered: Sequence[MapObject], world_from_map: Pose
) -> tuple[tuple[bool, ...], tuple[float, ...], tuple[str, ...]]:
    """Return for each thing whether it is found, the errors [m], and the false classes.

    `world_from_map` is the pose of the map in the world.
    """
    left = [(one.label, to_parent(world_from_map, one.x, one.y)) for one in remembered]
    found, errors = [], []
    for thing in placed:
        away = [
            (math.dist(at, (thing.x, thing.y)), number)
            for number, (label, at) in enumerate(left)
            if label == thing.look.label
        ]
        error, number = min(away, default=(math.inf, -1))
        found.append(error <= SAME_M)
        if found[-1]:
            errors.append(round(error, 4))
            left.pop(number)
    return tuple(found), tuple(errors), tuple(label for label, _ in left)


def draw(seed: int) -> tuple[tuple[Placed, ...], ClutteredWorld]:
    """Return the things in the world of a seed, and its start and goals."""
    random = np.random.default_rng(np.random.SeedSequence((seed, 1801)))
    start = Pose(x=0.0, y=0.0, yaw=float(random.uniform(-math.pi, math.pi)))
    placed: list[Placed] = []
    while len(placed) < THINGS:
        maker = MAKERS[CLASSES[len(placed) % len(CLASSES)]]
        look = maker[int(random.integers(len(maker)))](random, 0)
        x, y = random.uniform(-HALF_M + 0.5, HALF_M - 0.5, 2).tolist()
        free = math.hypot(x, y) > START_GAP_M + look.radius
        if free and _nearest_distance(x, y, placed) > GAP_M + look.radius:
            placed.append(Placed(look, x, y, float(random.uniform(-math.pi, math.pi))))
    goals: list[Point] = []
    while len(goals) < GOALS:
        x, y = random.uniform(-HALF_M + 0.5, HALF_M - 0.5, 2).tolist()
        if _nearest_distance(x, y, placed) > GOAL_GAP_M:
            goals.append((x, y))
    return tuple(placed), ClutteredWorld(seed, (), (), (), start, tuple(goals), ())


def _nearest_distance(x: float, y: float, placed: Sequence[Placed]) -> float:
    """Return the distance from a point to the nearest thing [m]."""
    away = [math.hypot(x - one.x, y - one.y) - one.look.radius for one in placed]
    return min(away, default=math.inf)


def write(course: ClutteredWorld, placed: Sequence[Placed], folder: Path) -> Path:
    """Write the world file and its model; return the path of the world file."""
    random = np.random.default_rng(course.seed)
    bodies = [_mjcf(number, one, random) for number, one in enumerate(placed)]
    model = f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>\n"
    (folder / "things.xml").write_text(model, "utf-8")
    path = folder / "objects.yaml"
    start = [course.start.x, course.start.y, course.start.yaw]
    world = {"size": [2 * HALF_M, 2 * HALF_M], "start": start, "model": "things.xml"}
    path.write_text(json.dumps(world), "utf-8")  # JSON is YAML
    return path


def _mjcf(number: int, one: Placed, random: np.random.Generator) -> str:
    paints = {part.paint: COLOURS[random.integers(len(COLOURS))] for part in one.look.parts}
    paints["carton"] = CARTON
    quat = f"{math.cos(one.yaw / 2):.6f} 0 0 {math.sin(one.yaw / 2):.6f}"
    geoms = "".join(_geoms(number, one.look.parts, paints))
    return (
        f'<body name="thing{number}" pos="{one.x:.4f} {one.y:.4f} 0" quat="{quat}">{geoms}</body>\n'
    )


def _geoms(
    number: int, parts: Sequence[Geom], paints: dict[str, tuple[float, float, float]]
) -> Iterator[str]:
    for count, part in enumerate(parts):
        assert part.kind in GEOMS, part.kind
        colour = " ".join(f"{one:.3f}" for one in part.fixed or paints[part.paint])
        size = " ".join(f"{one:.5f}" for one in part.size)
        at, turn = (" ".join(f"{one:.6f}" for one in values) for values in (part.at, part.turn))
        yield (
            f'<geom name="thing{number}part{count}" type="{part.kind}" size="{size}" '
            f'pos="{at}" quat="{turn}" rgba="{colour} 1"/>'
        )
