"""Finds collisions of an arm in a posture: with itself, its base, a floor, things, or its load."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.manipulation.arm_kinematics import (
    ArmKinematics,
    Frame,
    PostureSetter,
    unusable,
)

MARGIN_M = 0.005
DISTANCE_CUTOFF_M = 0.1
CLEARANCE_CUTOFF_M = 0.012
MIN_SWEEP_M = 0.001  # shorter parts of a line are not divided; the margin may be short by this
LINK_RADIUS_M = 0.03  # of links and tools, round the line from joint to joint
HELD = "held"  # name of the held thing's body
SIZES = {"box": 3, "cylinder": 2, "sphere": 1, "floor": 0}
BASE_FRAME = Frame(position=np.zeros(3), axes=np.eye(3))
MIN_SIZE_M, MAX_SIZE_M = 1e-4, 100.0
GEOMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "floor": mujoco.mjtGeom.mjGEOM_PLANE,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Thing:
    """A solid: an obstacle, a keep-out box, a floor, or an object to pick up.

    Sizes [m] are: for a box its lengths along x, y and z; for a cylinder its radius and its length
    along z; for a sphere its radius. A floor is the half-space below its position along z.
    """

    name: str
    kind: Literal["box", "cylinder", "sphere", "floor"]
    size: tuple[float, ...] = ()
    position: Floats = field(default_factory=lambda: np.zeros(3))  # (3,) [m] of its middle
    axes: Floats = field(default_factory=lambda: np.eye(3))  # (3, 3), a rotation

    def __post_init__(self) -> None:
        numbers = (*self.size, *self.position, *self.axes.flat)
        if not all(math.isfinite(number) for number in numbers):
            raise ConfigError(f"{self.name}: size and place have to be finite")
        if len(self.size) != SIZES[self.kind]:
            raise ConfigError(f"{self.name}: a {self.kind} has {SIZES[self.kind]} sizes")
        if not all(MIN_SIZE_M <= size <= MAX_SIZE_M for size in self.size):
            raise ConfigError(f"{self.name}: expected sizes of {MIN_SIZE_M} to {MAX_SIZE_M:g} m")

    @property
    def half(self) -> Floats:
        """Half its lengths along its own axes (3,) [m]."""
        if self.kind == "cylinder":
            radius, length = self.size
            return np.array([radius, radius, length / 2])
        return np.resize(np.array(self.size) / (2 if self.kind == "box" else 1), 3)


def turned(yaw: float) -> Floats:
    """Return the axes (3, 3) of a frame that is turned by `yaw` [rad] about z."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """The smallest distance of an arm's parts from the solids that they must not touch."""

    distance: float  # [m], below 0 where they overlap; the cutoff if nothing is nearer
    pair: tuple[str, str] | None = None  # names of the nearest two; None beyond the cutoff


class CollisionChecker:
    """An arm among things, perhaps with a held one. Not for two threads at once.

    Contacts between joined links do not count, nor those between the hand and the held thing.
    Things are fixed: make another checker when they have moved.
    """

    def __init__(
        self,
        arm: ArmKinematics,
        things: Sequence[Thing] = (),
        *,
        held: Thing | None = None,
        margin: float = MARGIN_M,
        ignore: Sequence[tuple[str, str]] = (),
        gripper: float | None = None,
    ) -> None:
        """Build the model.

        Args:
            arm: The arm.
            things: Obstacles, in the frame of the arm's base.
            held: A thing in the frame of the tool, fixed to it.
            margin: Distance below which two solids count as touching [m].
            ignore: Names of things (or "held") and of bodies of the arm that may touch.
            gripper: Position of the gripper's joint [rad] or [m]; otherwise as in the model.

        Raises:
            ConfigError: Two things have one name, or the model cannot be used.
        """
        self.arm, self.margin, self.gripper = arm, margin, gripper
        spec = arm.spec()
        for geom in spec.geoms:  # geoms with any contact bits collide with all others
            geom.contype = geom.conaffinity = int(bool(geom.contype or geom.conaffinity))
        for thing in things:
            _add_thing(spec, spec.worldbody, thing, thing.name, BASE_FRAME)
        if held:
            _add_thing(spec, spec.site(arm.tool).parent, held, HELD, arm.tool_frame())
        added = {HELD, *(thing.name for thing in things)}
        self._model = _compile(spec, [*arm.neighbours, *ignore])
        self._data = mujoco.MjData(self._model)
        self._set = PostureSetter(self._model, arm)
        beyond = float(np.linalg.norm(np.abs(held.position) + held.half)) if held else 0.0
        self._levers = arm.levers(LINK_RADIUS_M + beyond)
        self._names = [_geom_name(self._model, geom, added) for geom in range(self._model.ngeom)]

    def touches(self, posture: Floats) -> str:
        """Return the names of two that touch within the margin, as text; empty if none do."""
        self._find_contacts(posture, self.margin)
        distance, pair = self._overlap() or self._nearest(self.margin)
        return " and ".join(pair) if pair and distance < self.margin else ""

    def is_free(self, posture: Floats) -> bool:
        """Return whether nothing touches anything within the margin."""
        return not self.touches(posture)

    def room(self, posture: Floats, cutoff: float = CLEARANCE_CUTOFF_M) -> float:
        """Return a lower bound of the clearance [m].

        It is exact up to the margin.
        """
        self._find_contacts(posture, cutoff)
        if not self._data.ncon:
            return cutoff
        room = float(self._data.contact.dist.min())
        return self._nearest(self.margin)[0] if 0.0 < room <= self.margin else room

    def sweep(self, start: Floats, goal: Floats) -> float:
        """Return an upper bound of any part's motion along a straight line of postures [m]."""
        return float(np.abs(goal - start) @ self._levers)

    def is_line_free(self, start: Floats, goal: Floats, share: float = 1.0) -> bool:
        """Return whether nothing is within a share of the margin between two postures.

        The line is divided until each part is shorter than the room around its middle, so that no
        contact is missed between two checked postures.
        """
        parts = [(0.0, 1.0)]
        whole = self.sweep(start, goal)
        while parts:
            begin, end = parts.pop(0)
            middle, half = (begin + end) / 2, whole * (end - begin) / 2
            room = self.room(start + (goal - start) * middle) - share * self.margin
            if room <= 0.0:
                return False
            if half > max(room, MIN_SWEEP_M):
                parts += [(begin, middle), (middle, end)]
        return True

    def clearance(self, posture: Floats, cutoff: float = DISTANCE_CUTOFF_M) -> Clearance:
        """Return the smallest distance, if it is below `cutoff` [m]."""
        self._find_contacts(posture, cutoff)
        distance, pair = self._nearest(cutoff)
        return Clearance(distance=distance, pair=pair)

    def _overlap(self) -> tuple[float, tuple[str, str]] | None:
        """Return the deepest overlap: its distance [m], below 0, and names; None without one."""
        contacts = self._data.contact
        if not self._data.ncon or contacts.dist.min() >= 0.0:
            return None
        deepest = contacts.dist.argmin()
        one, other = contacts.geom[deepest]
        return float(contacts.dist[deepest]), (self._names[one], self._names[other])

    def _nearest(self, cutoff: float) -> tuple[float, tuple[str, str] | None]:
        """Return the smallest distance [m] among contacts that may be nearer than `cutoff`.

        MuJoCo reports contacts of boxes that do not touch as nearer than they are.
        """
        contacts = self._data.contact
        nearest, found, ends = cutoff, None, np.zeros(6)
        if not self._data.ncon:
            return nearest, found
        pairs = {(int(one), int(other)) for one, other in contacts.geom[contacts.dist < cutoff]}
        for one, other in sorted(pairs):
            distance = mujoco.mj_geomDistance(self._model, self._data, one, other, cutoff, ends)
            if distance < nearest:
                nearest, found = float(distance), (self._names[one], self._names[other])
        return nearest, found

    def _find_contacts(self, posture: Floats, margin: float) -> None:
        """Find all contacts nearer than `margin` [m]."""
        if self._model.geom_margin[0] != margin:
            self._model.geom_margin[:] = self._model.body_margin[:] = margin
        self._set(self._data, posture, self.gripper)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)


def _add_thing(
    spec: mujoco.MjSpec, parent: mujoco.MjsBody, thing: Thing, name: str, within: Frame
) -> None:
    """Add a thing to `parent`; its pose is in the frame `within` of that body."""
    if spec.body(name):
        raise ConfigError(f"two things, or a thing and a part of the arm, are called {name!r}")
    quaternion, size = np.empty(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (within.axes @ thing.axes).ravel())
    if thing.kind == "box":
        size = thing.half
    elif thing.kind == "floor":
        size[2] = 1.0
    else:
        size[:2] = thing.half[0], thing.half[2]
    body = parent.add_body(name=name, pos=within.place(thing.position), quat=quaternion)
    body.add_geom(type=GEOMS[thing.kind], size=size, contype=1, conaffinity=1)


def _compile(spec: mujoco.MjSpec, apart: Sequence[tuple[str, str]]) -> mujoco.MjModel:
    """Compile, with pairs of bodies that may touch. Raises ConfigError."""
    names = [body.name for body in spec.bodies]
    for pair in apart:
        for name in pair:
            if name not in names:
                raise unknown("thing or body of the arm", name, names)
        spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
    try:
        return spec.compile()
    except ValueError as error:
        raise unusable(error) from None


def _geom_name(model: mujoco.MjModel, geom: int, added: Collection[str]) -> str:
    body = str(model.body(model.geom_bodyid[geom]).name)
    return body if body in added else str(model.geom(geom).name) or body
