"""Worlds by name, and the safe place in each where a run with a given seed starts."""

import math
from collections.abc import Callable
from dataclasses import replace

from gigabrain_drivers.sim.geometry import ClosedPath, Pose, clearance
from gigabrain_drivers.sim.random_world import random_world
from gigabrain_drivers.sim.rooms import arena, house, warehouse
from gigabrain_drivers.sim.streams import Stream, generator
from gigabrain_drivers.sim.world import World
from gigabrain_zenoh.errors import UnknownName, unknown

__all__ = ["World", "load_world", "world_names"]

START_CLEAR_M = 0.6  # from the robot's origin to anything that stands
PERSON_CLEAR_M = 1.5  # from the robot's origin to the person's middle
RANDOM = "random:"
DRAWN: dict[str, Callable[[], World]] = {"arena": arena, "house": house, "warehouse": warehouse}


def world_names() -> dict[str, str]:
    """One line about each world, by name."""
    names = {name: build().description for name, build in DRAWN.items()}
    return {**names, f"{RANDOM}SEED": random_world(0).description}


def load_world(name: str, seed: int) -> World:
    """The world, with the start poses that `seed` (>= 0) gives. Raises UnknownName."""
    return _with_start(_build(name), seed)


def _build(name: str) -> World:
    if name in DRAWN:
        return DRAWN[name]()
    if not name.startswith(RANDOM):
        raise unknown("world", name, [*DRAWN, f"{RANDOM}SEED"])
    layout = name.removeprefix(RANDOM)
    if not (layout.isascii() and layout.isdigit()):
        raise UnknownName(f"no world {name!r}; random:SEED wants a whole number, as in random:7")
    return random_world(int(layout))


def _with_start(world: World, seed: int) -> World:
    """Draw the robot's pose until it is clear of everything, and the person's place."""
    random, shapes = generator(seed, Stream.START), world.everything()
    person_start = float(random.uniform(0, 1))
    person = None
    if world.path:
        path = ClosedPath(world.path)
        person_start *= path.length
        person = path.at(person_start)
    while True:
        x = float(random.uniform(-world.half_x, world.half_x))
        y = float(random.uniform(-world.half_y, world.half_y))
        yaw = float(random.uniform(-math.pi, math.pi))
        far = person is None or math.hypot(x - person.x, y - person.y) >= PERSON_CLEAR_M
        if far and clearance(shapes, x, y) >= START_CLEAR_M:
            return replace(world, start=Pose(x, y, yaw), person_start=person_start)
