"""Worlds by name or file: shipped ones, random layouts, and users' own.

In shipped worlds, passages are at least 1.1 m wide (doors 1.0 m) and there are no other gaps. So
a robot that looks only a metre ahead and turns right can roam for ever.
"""

import math
import re
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from gigabrain_drivers.sim.map_world import map_world
from gigabrain_drivers.sim.world import (
    WALL_HEIGHT,
    Box,
    ClosedPath,
    Cylinder,
    Pose,
    Shape,
    Stream,
    World,
    clearance,
    generator,
)
from gigabrain_drivers.sim.world_file import errors_at, read_world
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config.loading import beside, names_file
from gigabrain_zenoh.errors import ConfigError, UnknownName, unknown

RANDOM_HALF_M = 3.5
PASSAGE_M = 1.15  # least gap between obstacles
MAX_FREE, MAX_BY_WALL = 8, 5  # obstacles
MIN_OBSTACLES = 10
LAYOUT_ATTEMPTS = 400  # for one layout
OBSTACLE_MATERIALS = ("orange", "teal", "yellow", "blue", "green", "clay")
Placed = tuple[Shape, float]  # a shape, and the radius of its outer circle [m]
START_CLEARANCE_M = 0.6  # from the robot's origin to any obstacle
PERSON_CLEARANCE_M = 1.5  # from the robot's origin to a person's middle
MIN_ATTEMPTS, MAX_DISTANCE_CHECKS = 300, 400_000  # for a start
RANDOM = "random:"


def random_world(seed: int) -> World:
    """Return 10 to 13 obstacles in 7 x 7 m, with no gap or at least 1.15 m between them."""
    random = generator(seed, Stream.LAYOUT)
    placed = _layout(random)
    while len(placed) < MIN_OBSTACLES:
        placed = _layout(random)
    return World(
        name=f"random:{seed}",
        description="10 to 13 obstacles in 7 x 7 m, drawn from SEED",
        half_x=RANDOM_HALF_M,
        half_y=RANDOM_HALF_M,
        floor=((0.56, 0.60, 0.55), (0.52, 0.56, 0.51)),
        shapes=tuple(shape for shape, _ in placed),
    )


def _layout(random: np.random.Generator) -> list[Placed]:
    """Place obstacles until all attempts are used; those at the walls first."""
    placed: list[Placed] = []
    for attempt in range(LAYOUT_ATTEMPTS):
        by_wall = attempt < LAYOUT_ATTEMPTS // 4
        if len(placed) >= (MAX_BY_WALL if by_wall else MAX_BY_WALL + MAX_FREE):
            continue
        shape, radius = _by_wall(random) if by_wall else _free(random)
        if all(_gap(shape, radius, *other) >= PASSAGE_M for other in placed):
            placed.append((shape, radius))
    return placed


def _gap(shape: Shape, radius: float, other: Shape, other_radius: float) -> float:
    """Return a lower bound of the gap between two shapes [m], from their outer circles."""
    return math.hypot(shape.x - other.x, shape.y - other.y) - radius - other_radius


def _free(random: np.random.Generator) -> Placed:
    """Return a pillar or a box at any yaw, with a passage round it."""
    size, height = float(random.uniform(0.12, 0.22)), float(random.uniform(0.4, 0.8))
    material = str(random.choice(OBSTACLE_MATERIALS))
    reach = RANDOM_HALF_M - PASSAGE_M - 0.22 * math.sqrt(2)
    x, y = (float(value) for value in random.uniform(-reach, reach, 2))
    if random.random() < 0.5:
        return Cylinder(x, y, size, height, material), size
    yaw = float(random.uniform(0, math.pi / 2))
    return Box(x, y, size, size, height, material, yaw), size * math.sqrt(2)


def _by_wall(random: np.random.Generator) -> Placed:
    """Return a cupboard with its back to one of the walls, not in a corner."""
    width, depth = (float(value) for value in random.uniform((0.25, 0.15), (0.45, 0.25)))
    height, material = float(random.uniform(0.5, 0.9)), str(random.choice(OBSTACLE_MATERIALS))
    reach = RANDOM_HALF_M - PASSAGE_M - width
    along, off = float(random.uniform(-reach, reach)), RANDOM_HALF_M - depth
    radius = math.hypot(width, depth)
    side = int(random.integers(4))
    sign = 1.0 if side < 2 else -1.0
    if side % 2:
        return Box(along, sign * off, width, depth, height, material), radius
    return Box(sign * off, along, depth, width, height, material), radius


SHIPPED = Path(str(resources.files("gigabrain_drivers") / "sim" / "shipped_worlds"))
# files in SHIPPED
NAMED_WORLDS = ("arena", "house", "kitchen", "playroom", "table", "warehouse")


def world_names() -> dict[str, str]:
    """Return a description of one line for each world, by name."""
    names = {name: read_world(shipped_world(name)).description for name in NAMED_WORLDS}
    return {
        **names,
        f"{RANDOM}SEED": random_world(0).description,
        "FILE": "a world file (YAML), a model (MJCF), or a map of ROS (YAML with PNG or PGM)",
    }


def shipped_world(name: str) -> Path:
    """Return the file of one of NAMED_WORLDS."""
    return SHIPPED / f"{name}.yaml"


def mission_file(name: str, folder: Path) -> str:
    """Return the file of a mission: a shipped one, or one in the robot's folder `folder`.

    Raises UnknownName.
    """
    if names_file(name):
        return beside(name, folder)
    known = {path.stem: path for path in (SHIPPED / "missions").glob("*.yaml")}
    if name not in known:
        raise unknown("mission", name, known)
    return str(known[name])


def load_world(name: str, seed: int) -> World:
    """Return the world of a name or a file, with start poses drawn from `seed` (>= 0).

    Raises UnknownName, and ConfigError with the file and the line.
    """
    return _with_start(_build(name), seed)


def _build(name: str) -> World:
    if name in NAMED_WORLDS:
        return read_world(shipped_world(name))
    if names_file(name):
        return _of_file(Path(name))
    if not name.startswith(RANDOM):
        raise unknown("world", name, [*NAMED_WORLDS, f"{RANDOM}SEED"])
    layout = name.removeprefix(RANDOM)
    if not (layout.isascii() and layout.isdigit()):
        text = f"no world {name!r}; random:SEED needs a whole number, as in random:7"
        raise UnknownName(text, value=name)
    return random_world(int(layout))


def _of_file(path: Path) -> World:
    """Return the world of a world file, a ROS map or an MJCF model. Raises ConfigError."""
    if path.suffix in (".png", ".pgm"):
        about = path.with_suffix(".yaml")
        if not about.exists():
            raise ConfigError(
                f"{path}: the image of a map; expected {about.name} beside it, with its "
                "resolution and origin"
            )
        return map_world(about, WALL_HEIGHT)
    if path.suffix in (".xml", ".mjcf"):
        return _with_model(World(
            name=path.stem, description=f"the model {path.name}", half_x=0.0, half_y=0.0,
            shapes=(), outer_walls=False, model=path, file=path,
        ))  # fmt: skip
    if re.search(r"^image\s*:", config.read(path), re.MULTILINE):
        return map_world(path, WALL_HEIGHT)
    world = read_world(path)
    if not world.model:
        return world
    with errors_at(path, ("model",), "model"):
        return _with_model(world)


def _with_model(world: World) -> World:
    from gigabrain_drivers.sim.mjcf_world import measured  # needs MuJoCo

    return measured(world)


def _with_start(world: World, seed: int) -> World:
    """Draw people's places, and the robot's pose until it is clear of everything."""
    random, shapes = generator(seed, Stream.START), world.obstacles()
    share = float(random.uniform(0, 1))  # of the first path; drawn even without paths
    people, places = [], []
    for walk in world.people:
        path = ClosedPath(walk.corners)
        people.append(replace(walk, start=share * path.length))
        places.append(path.at(share * path.length))
        share = float(random.uniform(0, 1)) if len(people) < len(world.people) else 0.0
    world = replace(world, people=tuple(people))
    if world.start_fixed:
        _check_start(world)
        return world
    for _ in range(max(MIN_ATTEMPTS, MAX_DISTANCE_CHECKS // max(1, len(shapes)))):
        x, y = _any_place(world, random)
        yaw = float(random.uniform(-math.pi, math.pi))
        far = all(math.hypot(x - one.x, y - one.y) >= PERSON_CLEARANCE_M for one in places)
        if far and clearance(shapes, x, y) >= START_CLEARANCE_M:
            return replace(world, start=Pose(x, y, yaw))
    raise ConfigError(
        f"{world.start_place()}: found no place for the robot {START_CLEARANCE_M:g} m from "
        "everything; name one with `start: [x, y, yaw]` in a world file, or make room"
    )


def _check_start(world: World) -> None:
    """Raise ConfigError where the robot would start outside the outer walls."""
    x, y, (east, north) = world.start.x, world.start.y, world.middle
    inside = abs(x - east) < world.half_x and abs(y - north) < world.half_y
    if world.outer_walls and not inside:
        raise ConfigError(
            f"{world.start_place()}: the robot starts outside its walls, at ({x:g}, {y:g}); "
            f"expected a `start` with x from {east - world.half_x:g} to {east + world.half_x:g}, "
            f"and y from {north - world.half_y:g} to {north + world.half_y:g}"
        )


def _any_place(world: World, random: np.random.Generator) -> tuple[float, float]:
    if world.free is not None:
        x, y = world.free[int(random.integers(len(world.free)))].tolist()
        return x, y
    x = float(random.uniform(-world.half_x, world.half_x))
    y = float(random.uniform(-world.half_y, world.half_y))
    return world.middle[0] + x, world.middle[1] + y
