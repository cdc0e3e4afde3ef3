"""Things and people added to a running simulated world, as spare bodies of its model."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from msgspec.structs import replace

from gigabrain_drivers.sim.scene import (
    PERSON_GAP_M,
    SPARE,
    SPARE_PEOPLE,
    SPARE_THINGS,
    UNUSED_M,
    Person,
    yaw_quaternion,
)
from gigabrain_drivers.sim.truth import Truth
from gigabrain_drivers.sim.world import ClosedPath, Colour, Pose, WalkingPath, World
from gigabrain_drivers.sim.world_file import MATERIALS
from gigabrain_schemas.sim import Thing
from gigabrain_zenoh.errors import Refused, listed

MIN_GAP_M = 0.02  # between the robot's outline and a new thing
MARGIN_M = 1.0  # things may stand this far outside the floor
COLOURS = {"box": MATERIALS["orange"], "cylinder": MATERIALS["teal"]}
FIGURE = tuple(MATERIALS[name] for name in ("blue", "skin", "dark_wood"))
HIDDEN: Colour = (0.0, 0.0, 0.0)
MIN_WALK_M = 0.2


@dataclass(frozen=True)
class Used:
    """A spare body in use."""

    thing: Thing
    body: int


class Things:
    """All added things. Use it in the physics thread, between two steps.

    `walk(body, person)` makes a body walk like `person`; None stops it.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        world: World,
        truth: Truth,
        walk: Callable[[int, Person | None], None],
    ) -> None:
        self._model, self._data, self._world, self._truth = model, data, world, truth
        self._walk = walk
        self._used: dict[str, Used] = {}
        self._free = {
            "thing": [model.body(f"{SPARE}thing{n}").id for n in range(SPARE_THINGS)],
            "person": [model.body(f"{SPARE}person{n}").id for n in range(SPARE_PEOPLE)],
        }
        self.version = 0  # counts changes

    def all(self) -> tuple[Thing, ...]:
        """Return all things, at the places where they were added."""
        return tuple(used.thing for used in self._used.values())

    def bodies(self) -> dict[int, str]:
        """Return the names of things by body id."""
        return {used.body: name for name, used in self._used.items()}

    def add(self, thing: Thing) -> Thing:
        """Add a thing; return it with its name. Raises Refused."""
        thing = replace(thing, name=self._name(thing))
        self._check_place(thing)
        spare = self._spares(thing)
        if not spare:
            raise Refused(
                f"no {thing.kind} is left; remove something with `gigabrain world remove`"
            )
        body = spare[0]
        self._show(body, thing)
        gap = self._gap(body)
        needed = PERSON_GAP_M if thing.kind == "person" else MIN_GAP_M
        if gap < needed:
            self._hide(body)
            raise Refused(
                f"the robot is in the way at ({thing.x:.2f}, {thing.y:.2f}): {gap:.2f} m from it; "
                f"expected at least {needed:g} m"
            )
        self._use(spare.pop(0), thing)
        return thing

    def restore(self, things: Iterable[Thing]) -> None:
        """Add things of an earlier simulation, at any distance from the robot."""
        for thing in things:
            body = self._spares(thing).pop(0)
            self._show(body, thing)
            self._use(body, thing)

    def _use(self, body: int, thing: Thing) -> None:
        self._used[thing.name] = Used(thing, body)
        if thing.kind == "person" and thing.path:
            self._walk(body, Person(WalkingPath(((thing.x, thing.y), *thing.path), thing.speed)))
        self._changed()

    def _spares(self, thing: Thing) -> list[int]:
        """Return the unused bodies for things of this kind."""
        return self._free["person" if thing.kind == "person" else "thing"]

    def remove(self, name: str) -> Thing:
        """Remove a thing. Raises Refused listing the existing ones."""
        if name not in self._used:
            raise Refused(f"no object {name!r} was added; known: {listed(self._used)}")
        used = self._used.pop(name)
        self._walk(used.body, None)
        self._hide(used.body)
        self._spares(used.thing).append(used.body)
        self._changed()
        return used.thing

    def _changed(self) -> None:
        self.version += 1
        mujoco.mj_kinematics(self._model, self._data)
        self._truth.find_obstacles()

    def _name(self, thing: Thing) -> str:
        if thing.name in self._used:
            raise Refused(f"there is a {thing.name!r} already; choose another name")
        numbers = range(1, SPARE_THINGS + SPARE_PEOPLE + 2)
        free = (name for n in numbers if (name := f"{thing.kind}{n}") not in self._used)
        return thing.name or next(free)

    def _check_place(self, thing: Thing) -> None:
        world = self._world
        (middle_x, middle_y), points = world.middle, ((thing.x, thing.y), *thing.path)
        reach_x, reach_y = world.half_x + MARGIN_M, world.half_y + MARGIN_M
        for x, y in points:
            if abs(x - middle_x) > reach_x or abs(y - middle_y) > reach_y:
                raise Refused(
                    f"({x:.2f}, {y:.2f}) is outside the world; expected x from "
                    f"{middle_x - reach_x:.1f} to {middle_x + reach_x:.1f} and y from "
                    f"{middle_y - reach_y:.1f} to {middle_y + reach_y:.1f}"
                )
        if thing.path and ClosedPath(points).length < MIN_WALK_M:
            raise Refused(f"the way of the person is shorter than {MIN_WALK_M:g} m")

    def _gap(self, body: int) -> float:
        """Return the distance from the robot to a newly placed body [m]."""
        mujoco.mj_kinematics(self._model, self._data)
        return self._truth.distance_to(int(self._model.body_geomadr[body]))

    def _show(self, body: int, thing: Thing) -> None:
        """Place a spare body, and set its size and colour; make it solid."""
        model, place = self._model, int(self._model.body_mocapid[body])
        geoms = self._geoms(body)
        person = thing.kind == "person"
        half = [value / 2 for value in thing.size]
        self._data.mocap_pos[place] = thing.x, thing.y, 0.0 if person else half[2]
        heading = thing.yaw
        if person and thing.path:
            to_x, to_y = thing.path[0]
            heading = math.atan2(to_y - thing.y, to_x - thing.x)
        self._data.mocap_quat[place] = yaw_quaternion(Pose(thing.x, thing.y, heading))
        if person:
            for geom, colour in zip(geoms, FIGURE, strict=True):
                model.geom_rgba[geom] = (*colour, 1.0)
        else:
            kind = mujoco.mjtGeom.mjGEOM_BOX
            if thing.kind == "cylinder":
                kind = mujoco.mjtGeom.mjGEOM_CYLINDER
                half[1] = half[0]
            self._resize(body, geoms[0], kind, half)
            model.geom_rgba[geoms[0]] = (*COLOURS[thing.kind], 1.0)
        self._set_solid(body, geoms[0], True)

    def _resize(self, body: int, geom: int, kind: mujoco.mjtGeom, half: list[float]) -> None:
        """Change type and size, and the values that MuJoCo computed from them."""
        model = self._model
        model.geom_type[geom] = kind
        round_one = kind == mujoco.mjtGeom.mjGEOM_CYLINDER
        model.geom_size[geom] = (half[0], half[2], 0.0) if round_one else half
        across = half[0] if round_one else math.hypot(half[0], half[1])
        model.geom_rbound[geom] = math.hypot(across, half[2])
        bounds = np.array([0.0, 0.0, 0.0, *half])
        model.geom_aabb[geom] = bounds
        model.bvh_aabb[model.body_bvhadr[body]] = bounds

    def _hide(self, body: int) -> None:
        """Make a body spare again: invisible and without contacts."""
        geoms = self._geoms(body)
        for geom in geoms:
            self._model.geom_rgba[geom] = (*HIDDEN, 0.0)
        if len(geoms) == 1:
            self._resize(body, geoms[0], mujoco.mjtGeom.mjGEOM_BOX, [UNUSED_M] * 3)
        self._set_solid(body, geoms[0], False)
        self._data.mocap_pos[self._model.body_mocapid[body]] = (*self._world.middle, 0.0)

    def _set_solid(self, body: int, geom: int, solid: bool) -> None:
        model = self._model
        model.geom_contype[geom] = model.geom_conaffinity[geom] = int(solid)
        model.body_contype[body] = model.body_conaffinity[body] = int(solid)

    def _geoms(self, body: int) -> list[int]:
        first = int(self._model.body_geomadr[body])
        return list(range(first, first + int(self._model.body_geomnum[body])))
