"""A Jackal among posts: a plant that answers late and slowly, slips, drifts and sees with noise.

It knows the truth, which the robot never hears of.
"""

import math
from collections import deque
from typing import Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_NS, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Lidar, Thresholds
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.kernels.jit import kernel

Floats = NDArray[np.float64]

TICK_S = TICK_NS / 1e9
SUBSTEPS = 4  # of a tick
ACCELERATION, ANGULAR_ACCELERATION = 5.0, 20.0  # [m/s2], [rad/s2], what the floor takes
LENGTH_M, WIDTH_M = 0.458, 0.416  # [m], of chassis and wheels
FIELD_OF_VIEW_RAD = math.radians(270.0)

LIDAR = Lidar(beams=720, rate_hz=25, range_min=0.1, range_max=10.0, x=0.055)
JACKAL = BodyDescription(
    robot_type="jackal",
    drive_type="differential",
    footprint=(
        (LENGTH_M / 2, WIDTH_M / 2),
        (-LENGTH_M / 2, WIDTH_M / 2),
        (-LENGTH_M / 2, -WIDTH_M / 2),
        (LENGTH_M / 2, -WIDTH_M / 2),
    ),
    max_linear_speed=2.0,
    max_angular_speed=3.0,
    max_linear_acceleration=ACCELERATION,
    max_linear_deceleration=ACCELERATION,
    max_angular_acceleration=ANGULAR_ACCELERATION,
    lidar=LIDAR,
    # from a scan to its brake: till the next, a tick on the bus, the hard plant's delay and most of
    # its lag, of which a body that brakes from a low speed feels the less; and told to stop at
    # 2 m/s in a turn it goes on for 0.65 s until delay and lag are over
    thresholds=Thresholds(reaction_time=0.26, follow_sustain=0.5),
)


class Conditions(Struct, frozen=True, kw_only=True):
    """How hard it is made."""

    delay: float = 0.1  # [s], before a command has any effect
    lag: float = 0.15  # [s], time constant
    slip: float = 0.6  # the least share of the yaw rate that the floor lets through
    drift: float = 0.02  # of the odometry, of the way and of the turns
    noise: float = 0.03  # [m], standard deviation of a range
    dropouts: float = 0.1  # share of the beams that see nothing
    physics: bool = False  # MuJoCo's: what slips, and how quickly it speeds up, follows from it


HARD = Conditions()
MUJOCO = Conditions(slip=1.0, physics=True)
IDEAL = Conditions(delay=0.0, lag=0.0, slip=1.0, drift=0.0, noise=0.01, dropouts=0.0)


class JackalBody(Protocol):
    """One trial's body, in whatever world."""

    x: float  # [m], the truth
    y: float  # [m]
    yaw: float  # [rad]
    odometry: Pose

    @property
    def velocity(self) -> Velocity:
        """As measured."""
        ...

    def tick(self, command: Velocity) -> None:
        """20 ms with `command`."""
        ...

    def scan(self, lidar: Lidar, discs: Floats) -> NDArray[np.float32]:
        """One turn of the lidar among `discs` (n, 3): (beams,) [m], inf where nothing is."""
        ...

    def clearance(self, discs: Floats) -> float:
        """How far it is from the nearest of `discs`, exactly [m]; 0 or less in contact."""
        ...


class KinematicJackal:
    """One trial's body, by kinematics alone."""

    def __init__(
        self, conditions: Conditions, start: tuple[float, float, float], seed: int
    ) -> None:
        self._random = np.random.default_rng(seed)
        self._conditions = conditions
        self._gain = float(self._random.uniform(conditions.slip, 1.0))
        way, turn = self._random.uniform(-conditions.drift, conditions.drift, 2).tolist()
        self._way, self._turn = 1.0 + way, 1.0 + turn
        waits = round(conditions.delay / TICK_S * SUBSTEPS)
        self._queue = deque([ZERO] * waits)
        self.x, self.y, self.yaw = start  # the truth
        self.v = self.w = 0.0
        self.odometry = Pose(x=0.0, y=0.0, yaw=0.0)

    @property
    def velocity(self) -> Velocity:
        """As measured."""
        return Velocity(linear_x=self.v * self._way, angular_z=self.w * self._turn)

    def tick(self, command: Velocity) -> None:
        """20 ms with `command`."""
        for _ in range(SUBSTEPS):
            self._queue.append(command)
            self._substep(self._queue.popleft(), TICK_S / SUBSTEPS)

    def _substep(self, command: Velocity, dt: float) -> None:
        lag = self._conditions.lag
        share = 1.0 - math.exp(-dt / lag) if lag > 0 else 1.0
        most, turning = ACCELERATION * dt, ANGULAR_ACCELERATION * dt
        change = share * (command.linear_x - self.v)
        self.v += max(-most, min(most, change))
        change = share * (self._gain * command.angular_z - self.w)
        self.w += max(-turning, min(turning, change))
        middle = self.yaw + 0.5 * self.w * dt
        self.x += self.v * math.cos(middle) * dt
        self.y += self.v * math.sin(middle) * dt
        self.yaw = math.remainder(self.yaw + self.w * dt, math.tau)
        seen, way = self.odometry, self.v * self._way * dt
        middle = seen.yaw + 0.5 * self.w * self._turn * dt
        self.odometry = Pose(
            x=seen.x + way * math.cos(middle),
            y=seen.y + way * math.sin(middle),
            yaw=math.remainder(seen.yaw + self.w * self._turn * dt, math.tau),
        )

    def scan(self, lidar: Lidar, discs: Floats) -> NDArray[np.float32]:
        """One turn of the lidar among `discs` (n, 3): (beams,) [m], inf where nothing is."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        eye = self.x + cosine * lidar.x, self.y + sine * lidar.x
        ranges = np.full(lidar.beams, np.inf)
        _cast(eye, self.yaw, FIELD_OF_VIEW_RAD, discs, ranges)
        ranges += self._random.normal(0.0, self._conditions.noise, lidar.beams)
        lost = self._random.random(lidar.beams) < self._conditions.dropouts
        ranges[lost | (ranges > lidar.range_max)] = np.inf
        seen: NDArray[np.float32] = np.maximum(ranges, lidar.range_min).astype(np.float32)
        return seen

    def clearance(self, discs: Floats) -> float:
        """How far the body is from the nearest of `discs`, exactly [m]; 0 or less in contact."""
        return clearance(self, discs)


def clearance(body: JackalBody, discs: Floats) -> float:
    """How far a body is from the nearest of `discs`, exactly [m]; 0 or less in contact."""
    dx, dy = discs[:, 0] - body.x, discs[:, 1] - body.y
    cosine, sine = math.cos(body.yaw), math.sin(body.yaw)
    corners = np.array(JACKAL.footprint)
    here = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=1)
    return float((_to_polygon(corners, here) - discs[:, 2]).min(initial=np.inf))


def _to_polygon(corners: Floats, points: Floats) -> Floats:
    """Distances [m] of `points` (n, 2) from a convex polygon, counter-clockwise; 0 inside it."""
    along = np.roll(corners, -1, axis=0) - corners
    off = points[:, None, :] - corners
    share = np.clip((off * along).sum(-1) / (along * along).sum(-1), 0.0, 1.0)
    away: Floats = np.linalg.norm(off - share[..., None] * along, axis=-1).min(axis=1)
    inside = (along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0] > 0).all(axis=1)
    away[inside] = 0.0
    return away


@kernel
def _cast(eye: tuple[float, float], yaw: float, view: float, discs: Floats, ranges: Floats) -> None:
    """The nearest disc along each beam, over `view` [rad] from right to left."""
    beams = ranges.shape[0]
    step = view / (beams - 1)
    for d in range(discs.shape[0]):
        dx, dy, r = discs[d, 0] - eye[0], discs[d, 1] - eye[1], discs[d, 2]
        away = math.hypot(dx, dy)
        if away <= r:
            continue
        bearing = math.atan2(dy, dx) - yaw + 0.5 * view
        bearing -= math.tau * math.floor(bearing / math.tau)
        half = math.asin(r / away)
        for turn in range(-1, 1):
            middle = bearing + turn * math.tau
            first = max(0, math.ceil((middle - half) / step))
            last = min(beams - 1, math.floor((middle + half) / step))
            for k in range(first, last + 1):
                across = away * math.sin(k * step - middle)
                along = away * math.cos(k * step - middle)
                reach = along - math.sqrt(max(0.0, r * r - across * across))
                ranges[k] = min(ranges[k], reach)
