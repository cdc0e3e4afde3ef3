"""Ground truth of a run from the physics, for reports and tests, never for the robot."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim import STEP_NS
from gigabrain_drivers.sim.mjcf_world import UPRIGHT, is_floor
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.world import Footprint, Pose

NEW_CONTACT_STEPS = 500_000_000 // STEP_NS  # after this pause, a contact counts as new
CLEARANCE_STEPS = 100_000_000 // STEP_NS
MEASURED = [  # types whose sizes along x and y can be read
    mujoco.mjtGeom.mjGEOM_BOX.value, mujoco.mjtGeom.mjGEOM_CYLINDER.value,
    mujoco.mjtGeom.mjGEOM_CAPSULE.value, mujoco.mjtGeom.mjGEOM_SPHERE.value,
]  # fmt: skip
FALL_TILT = math.cos(math.radians(12))  # cosine of the largest tilt of a body that stands
MAX_CLEARANCE_M = 10.0  # larger clearances are reported as this


class Truth:
    """Contacts, clearance and path of the robot. Call `update` once a step.

    contacts: how often the robot, without its hand, touched anything but the floor. Sliding along
    a thing is one contact; touching it again after half a second is another.
    touching: in contact in the newest step.
    min_clearance_m: the least distance from the robot's outline to anything, sampled at 10 Hz,
    0 in contact. falls: how often the robot tipped over, or a part of it sank below the floor of
    its start, sampled at 10 Hz. distance_m: the length of the base's path.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._base = model.body(f"{ROBOT}base").id
        self.fixed = model.body_jntnum[self._base] == 0  # its base cannot move
        if not self.fixed:
            self._place = model.joint(f"{ROBOT}free").qposadr[0]
            self._velocity = model.joint(f"{ROBOT}free").dofadr[0]
        is_robot = model.body_rootid[model.geom_bodyid] == self._base
        may_touch = np.isin(model.geom_bodyid, _hand(model))
        self._must_not_touch = set(np.flatnonzero(is_robot & ~may_touch).tolist())
        floor = np.array([is_floor(model, geom) for geom in range(model.ngeom)])
        self._may_be_obstacle = ~is_robot & ~floor
        self._hull = [
            geom for geom in range(model.ngeom) if model.geom(geom).name.startswith(f"{ROBOT}hull_")
        ]
        self._last_touch: dict[int, int] = {}
        self._steps = 0
        self._parts = np.flatnonzero(is_robot)
        self.contacts, self.touching = 0, False
        self.falls, self._fallen = 0, False
        self.min_clearance_m, self.distance_m = MAX_CLEARANCE_M, 0.0
        mujoco.mj_forward(model, data)
        self.find_obstacles()
        self.footprint = self._measure_footprint()
        self._reach = math.hypot(
            max(self.footprint.front, -self.footprint.rear), self.footprint.half_width
        )
        self._position = self.pose()
        self._touch()
        self._clear()

    def restore(
        self, *, contacts: int, falls: int, min_clearance_m: float, distance_m: float
    ) -> None:
        """Continue earlier counts, from the robot's present place."""
        self._position = self.pose()
        self._touch()  # a contact at the start is not counted
        self.contacts, self.falls = contacts, falls
        self.min_clearance_m, self.distance_m = min_clearance_m, distance_m

    def find_obstacles(self) -> None:
        """Update the obstacles after a change of the model."""
        model = self._model
        self._obstacles = np.flatnonzero(self._may_be_obstacle & (model.geom_contype != 0))
        self._obstacle_geoms = set(self._obstacles.tolist())
        self._half_sizes = _half_sizes(model, self._obstacles)
        upright = np.abs(self._data.geom_xmat[self._obstacles, 8]) > UPRIGHT
        boxes = np.isin(model.geom_type[self._obstacles], MEASURED)
        others = ~(upright & boxes)  # of an MJCF world
        self._half_sizes[others] = model.geom_rbound[self._obstacles[others], None]

    def distance_to(self, geom: int) -> float:
        """Return the distance from the robot's outline to a geom [m], at most 1; 0 if it touches.

        Positions in the data must be up to date.
        """
        gaps = (
            mujoco.mj_geomDistance(self._model, self._data, hull, geom, 1.0, None)
            for hull in self._hull
        )
        return max(min(gaps, default=1.0), 0.0)

    def pose(self) -> Pose:
        """Return the pose of the base in the world."""
        if self.fixed:
            x, y, _ = self._data.xpos[self._base].tolist()
            a, b, c, d = self._data.xquat[self._base].tolist()
        else:
            place = self._place
            x, y, _, a, b, c, d = self._data.qpos[place : place + 7].tolist()
        return Pose(x, y, math.atan2(2 * (a * d + b * c), 1 - 2 * (c * c + d * d)))

    def speed(self) -> tuple[float, float]:
        """(forward [m/s], turning [rad/s]) of the base."""
        if self.fixed:
            return 0.0, 0.0
        x, y, _, _, _, turning = self._data.qvel[self._velocity : self._velocity + 6].tolist()
        yaw = self.pose().yaw
        return math.cos(yaw) * x + math.sin(yaw) * y, turning

    def update(self) -> None:
        """Add the newest step."""
        self._steps += 1
        pose = self.pose()
        self.distance_m += math.hypot(pose.x - self._position.x, pose.y - self._position.y)
        self._position = pose
        self._touch()
        if self._steps % CLEARANCE_STEPS == 0:
            self._clear()
            self._fall()

    def _touch(self) -> None:
        """Count contacts between the robot and obstacles that begin in this step."""
        touched = {
            thing
            for pair in self._data.contact.geom.tolist()
            for thing, part in (pair, pair[::-1])  # things of an MJCF world touch each other, too
            if thing in self._obstacle_geoms and part in self._must_not_touch
        }
        self.touching = bool(touched)
        if touched:
            self.min_clearance_m = 0.0
        for thing in touched:
            if self._steps - self._last_touch.get(thing, -NEW_CONTACT_STEPS) >= NEW_CONTACT_STEPS:
                self.contacts += 1
            self._last_touch[thing] = self._steps

    @property
    def tipped(self) -> bool:
        """True while the base is tilted too far to stand."""
        return bool(self._data.xmat[self._base, 8] < FALL_TILT)

    def _fall(self) -> None:
        """Count the start of a fall."""
        fallen = bool(self.tipped or self._data.geom_xpos[self._parts, 2].min() < 0.0)
        self.falls += fallen and not self._fallen
        self._fallen = fallen

    def _clear(self) -> None:
        """Measure exactly those obstacles that may be nearer than any before."""
        for thing in self._obstacles[self._lower_bounds() < self.min_clearance_m]:
            for hull in self._hull:
                limit = self.min_clearance_m
                gap = mujoco.mj_geomDistance(self._model, self._data, hull, thing, limit, None)
                self.min_clearance_m = max(min(gap, limit), 0.0)

    def _lower_bounds(self) -> NDArray[np.float64]:
        """Return a lower bound of each obstacle's distance [m], from boxes and a circle."""
        things = self._obstacles
        offset = self._data.xpos[self._base, :2] - self._data.geom_xpos[things, :2]
        axes = self._data.geom_xmat[things].reshape(-1, 3, 3)[:, :2, :2]
        beside = np.abs(np.einsum("nij,ni->nj", axes, offset)) - self._half_sizes
        beside = np.maximum(beside, 0.0)
        return np.asarray(np.hypot(beside[:, 0], beside[:, 1]) - self._reach)

    def _measure_footprint(self) -> Footprint:
        """Return the rectangle round the hull in the base's frame."""
        model, boxes = self._model, [_half_sizes(self._model, [geom])[0] for geom in self._hull]
        middles = [model.geom_pos[geom] for geom in self._hull]
        pairs = list(zip(middles, boxes, strict=True))
        front = max(float(middle[0] + half[0]) for middle, half in pairs)
        rear = min(float(middle[0] - half[0]) for middle, half in pairs)
        return Footprint(front, rear, max(float(abs(m[1]) + half[1]) for m, half in pairs))


def _hand(model: mujoco.MjModel) -> list[int]:
    """Return the bodies of the gripper's pads."""
    pads = "pad_fixed", "pad_moving"  # with a prefix, where the arm stands on a base
    names = [str(model.geom(geom).name) for geom in range(model.ngeom)]
    mine = [name.startswith(ROBOT) and name.endswith(pads) for name in names]
    geoms = [geom for geom, is_mine in enumerate(mine) if is_mine]
    return [int(model.geom_bodyid[geom]) for geom in geoms]


def _half_sizes(model: mujoco.MjModel, geoms: NDArray[np.int64] | list[int]) -> NDArray[np.float64]:
    """Return half the size of each upright geom along its own x and y (n, 2) [m]."""
    size = model.geom_size[geoms][:, :2].copy()
    round_ones = model.geom_type[geoms] != mujoco.mjtGeom.mjGEOM_BOX.value
    size[round_ones, 1] = size[round_ones, 0]
    return np.asarray(size, np.float64)
