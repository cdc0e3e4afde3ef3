"""The worlds of BARN and DynaBARN, a Jackal in them, and one trial.

The Jackal reacts late and slowly, slips, drifts, and its lidar is noisy. The robot never sees the
true pose.
"""

import abc
import json
import math
from collections import deque
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats, ranges_bytes
from gigabrain_schemas.base import TICK_S, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Lidar, RobotState, Thresholds
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.geometry.pose import to_frame
from gigabrain_zenoh.kernels.jit import kernel

SUBSTEPS = 4  # per tick
ACCELERATION, ANGULAR_ACCELERATION = 5.0, 20.0  # [m/s2], [rad/s2], by the floor's friction
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
    # reaction_time: until the next scan, one tick on the bus, the hard plant's delay, and most of
    # its lag, which matters less at low speed. A stop from 2 m/s in a turn begins after at most
    # 0.65 s. response: the hard plant's delay and lag.
    thresholds=Thresholds(reaction_time=0.26, follow_sustain=0.5, response=0.25),
)


DYNAMIC_LENGTH = 20.0  # [m], of each path in DynaBARN
PATH_CELL, PATH_X, PATH_Y = 0.15, -4.575, 5.075  # [m], size and origin of a path's cells
SCAN_TICKS = 2  # between scans
MAX_TRIAL_S = 100.0
REACHED_M, BEGUN_M = 1.0, 0.1  # distance from the goal, and from the start
TRIAL_OFFSET_S = 7.3  # of a moving world's time, from trial to trial
SEED = 1000


class Conditions(Struct, frozen=True, kw_only=True):
    """Faults of the plant."""

    delay: float = 0.1  # [s], until a command has an effect
    lag: float = 0.15  # [s], time constant
    slip: float = 0.6  # smallest share of the commanded yaw rate that may be reached
    drift: float = 0.02  # largest relative error of odometry, in distance and in angle
    noise: float = 0.03  # [m], standard deviation of a range
    dropouts: float = 0.1  # share of the beams without a reading
    physics: bool = False  # with MuJoCo, which determines slip and acceleration


HARD = Conditions()
MUJOCO = Conditions(slip=1.0, physics=True)
IDEAL = Conditions(delay=0.0, lag=0.0, slip=1.0, drift=0.0, noise=0.01, dropouts=0.0)


class JackalBody(abc.ABC):
    """The body of one trial: commands take effect late, odometry drifts."""

    def __init__(
        self, conditions: Conditions, start: tuple[float, float, float], random: np.random.Generator
    ) -> None:
        self._random, self._conditions = random, conditions
        linear, angular = random.uniform(-conditions.drift, conditions.drift, 2).tolist()
        self._linear_scale, self._angular_scale = 1.0 + linear, 1.0 + angular
        self._queue = deque([ZERO] * round(conditions.delay / TICK_S * SUBSTEPS))
        self.x, self.y, self.yaw = start  # the true pose [m, m, rad]
        self.odometry = Pose(x=0.0, y=0.0, yaw=0.0)

    @property
    @abc.abstractmethod
    def velocity(self) -> Velocity:
        """The velocity, as measured."""

    def tick(self, command: Velocity) -> None:
        """Drive for 20 ms with `command`."""
        for _ in range(SUBSTEPS):
            self._queue.append(command)
            self._substep(self._queue.popleft(), TICK_S / SUBSTEPS)

    @abc.abstractmethod
    def _substep(self, command: Velocity, dt: float) -> None: ...

    @abc.abstractmethod
    def scan(self, lidar: Lidar, discs: Floats) -> NDArray[np.float32]:
        """Return a scan among `discs` (n, 3): (beams,) [m], inf where nothing is hit."""

    def _lag_share(self, dt: float) -> float:
        """Return the share of a change of speed that happens within `dt` [s]."""
        lag = self._conditions.lag
        return 1.0 - math.exp(-dt / lag) if lag > 0 else 1.0

    def clearance(self, discs: Floats) -> float:
        """Return the exact distance from the nearest of `discs` [m]; 0 or less in contact."""
        dx, dy = discs[:, 0] - self.x, discs[:, 1] - self.y
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        corners = np.array(JACKAL.footprint)
        here = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=1)
        return float((_to_polygon(corners, here) - discs[:, 2]).min(initial=np.inf))


class KinematicJackal(JackalBody):
    """A body without physics: it follows its kinematics."""

    def __init__(
        self, conditions: Conditions, start: tuple[float, float, float], seed: int
    ) -> None:
        random = np.random.default_rng(seed)
        self._gain = float(random.uniform(conditions.slip, 1.0))
        super().__init__(conditions, start, random)
        self.v = self.w = 0.0

    @property
    def velocity(self) -> Velocity:
        """The velocity, as measured."""
        return Velocity(
            linear_x=self.v * self._linear_scale, angular_z=self.w * self._angular_scale
        )

    def _substep(self, command: Velocity, dt: float) -> None:
        share = self._lag_share(dt)
        max_change, max_angular_change = ACCELERATION * dt, ANGULAR_ACCELERATION * dt
        change = share * (command.linear_x - self.v)
        self.v += max(-max_change, min(max_change, change))
        change = share * (self._gain * command.angular_z - self.w)
        self.w += max(-max_angular_change, min(max_angular_change, change))
        middle = self.yaw + 0.5 * self.w * dt
        self.x += self.v * math.cos(middle) * dt
        self.y += self.v * math.sin(middle) * dt
        self.yaw = math.remainder(self.yaw + self.w * dt, math.tau)
        before, distance = self.odometry, self.v * self._linear_scale * dt
        turn = self.w * self._angular_scale * dt
        middle = before.yaw + 0.5 * turn
        self.odometry = Pose(
            x=before.x + distance * math.cos(middle),
            y=before.y + distance * math.sin(middle),
            yaw=math.remainder(before.yaw + turn, math.tau),
        )

    def scan(self, lidar: Lidar, discs: Floats) -> NDArray[np.float32]:
        """Return a scan among `discs` (n, 3): (beams,) [m], inf where nothing is hit."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        eye = self.x + cosine * lidar.x, self.y + sine * lidar.x
        ranges = np.full(lidar.beams, np.inf)
        _cast(eye, self.yaw, FIELD_OF_VIEW_RAD, discs, ranges)
        ranges += self._random.normal(0.0, self._conditions.noise, lidar.beams)
        lost = self._random.random(lidar.beams) < self._conditions.dropouts
        ranges[lost | (ranges > lidar.range_max)] = np.inf
        seen: NDArray[np.float32] = np.maximum(ranges, lidar.range_min).astype(np.float32)
        return seen


def _to_polygon(corners: Floats, points: Floats) -> Floats:
    """Return the distances [m] of `points` (n, 2) from a convex polygon; 0 inside."""
    along = np.roll(corners, -1, axis=0) - corners
    off = points[:, None, :] - corners
    share = np.clip((off * along).sum(-1) / (along * along).sum(-1), 0.0, 1.0)
    away: Floats = np.linalg.norm(off - share[..., None] * along, axis=-1).min(axis=1)
    inside = (along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0] > 0).all(axis=1)
    away[inside] = 0.0
    return away


@kernel
def _cast(eye: tuple[float, float], yaw: float, view: float, discs: Floats, ranges: Floats) -> None:
    """Shorten `ranges` to the nearest disc per beam, over `view` [rad] from right to left."""
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


class MovingDisc(NamedTuple):
    """A disc that moves between key frames, in a loop."""

    duration: float  # [s]
    keys: Floats  # (k, 3): time [s], x, y [m]
    radius: float  # [m]


class BarnWorld(NamedTuple):
    """One world: obstacles, start and goal."""

    number: int  # in the original set
    posts: Floats  # (n, 3): x, y, radius [m]
    movers: tuple[MovingDisc, ...]
    start: tuple[float, float, float]  # x, y [m], yaw [rad]
    goal: tuple[float, float]  # [m]
    length: float  # [m], of the reference path

    def discs(self, at: float) -> Floats:
        """Return all obstacles at a time [s]: (n, 3), x, y, radius [m]."""
        if not self.movers:
            return self.posts
        rows = [(*_position(mover, at), mover.radius) for mover in self.movers]
        return np.concatenate([self.posts, np.array(rows).reshape(-1, 3)])


def _position(mover: MovingDisc, at: float) -> tuple[float, float]:
    times, xs, ys = mover.keys.T
    now = at % mover.duration
    return float(np.interp(now, times, xs)), float(np.interp(now, times, ys))


def read_worlds(file: Path, dynamic: bool) -> list[BarnWorld]:
    """Return the worlds in `file`. Raises ConfigError."""
    try:
        return _read_dynamic(file) if dynamic else _read_static(file)
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, EOFError) as error:
        kind = "DynaBARN worlds (JSON)" if dynamic else "BARN worlds (npz)"
        raise ConfigError(f"{file}: expected {kind}: {error}") from None


def _read_static(file: Path) -> list[BarnWorld]:
    data = np.load(file, allow_pickle=False)
    meta = json.loads(str(data["meta"]))
    start = cast("tuple[float, float, float]", tuple(map(float, meta["start"])))
    goal = float(meta["goal"][0]), float(meta["goal"][1])
    posts = np.split(data["cyl"].astype(np.float64), np.cumsum(data["n_cyl"])[:-1])
    cells = np.split(data["path_cells"], np.cumsum(data["n_path"])[:-1])
    worlds = []
    for index, own_posts, path in zip(data["index"].tolist(), posts, cells, strict=True):
        points = np.vstack([start[:2], path * PATH_CELL + (PATH_X, PATH_Y), goal])
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        worlds.append(BarnWorld(index, own_posts, (), start, goal, length))
    return worlds


def _read_dynamic(file: Path) -> list[BarnWorld]:
    data = json.loads(file.read_bytes())
    radius = float(data["meta"]["radius"])
    movers = {
        name: MovingDisc(float(duration), np.array(keys, dtype=np.float64).reshape(-1, 3), radius)
        for name, (duration, keys) in data["plugins"].items()
    }
    start, goal = (11.0, 0.0, 3.14), (-9.0, 0.0)
    none = np.empty((0, 3))
    return [
        BarnWorld(index, none, tuple(movers[name] for name in names), start, goal, DYNAMIC_LENGTH)
        for index, names in zip(data["index"], data["worlds"], strict=True)
    ]


def choose_worlds(worlds: list[BarnWorld], only: str) -> list[BarnWorld]:
    """Return the worlds whose numbers are in `only`, separated by commas; all if it is empty."""
    if not only:
        return worlds
    known = {world.number: world for world in worlds}
    try:
        return [known[int(number)] for number in only.split(",")]
    except ValueError:
        raise ConfigError(f"--only: expected numbers like 1,7, got {only!r}") from None
    except KeyError as error:
        some = f"it has {len(known)}, from {min(known)} to {max(known)}"
        raise ConfigError(f"--only: no world {error} in the file; {some}") from None


class BarnTrial(Struct, frozen=True, kw_only=True):
    """The result of one trial."""

    world: int
    trial: int
    result: str  # success, collision or timeout
    seconds: float  # since the robot left the start
    least_clearance: float  # [m], over all ticks
    score: float  # by the rules of 2024 and later, 0.5 at most
    cycles_ms: tuple[float, ...]  # CPU time of each plan


class BarnCourse:
    """A running trial. Equal arguments and commands give equal readings."""

    def __init__(self, world: BarnWorld, trial: int, conditions: Conditions) -> None:
        self._world, self._trial = world, trial
        self._body = body_in(world, conditions, SEED * world.number + trial)
        self._least_clearance, self._begun = math.inf, 0
        self.tick, self.result = 0, ""
        self._discs = world.posts

    @property
    def goal(self) -> Goal:
        """The goal in the frame of odometry, whose origin is the start [m]."""
        x, y, yaw = self._world.start
        goal_x, goal_y = to_frame(Pose(x=x, y=y, yaw=yaw), *self._world.goal)
        return Goal(x=goal_x, y=goal_y)

    def judge(self) -> None:
        """Begin a tick, and judge the trial."""
        self.tick += 1
        body, world = self._body, self._world
        self._discs = world.discs(TRIAL_OFFSET_S * self._trial + self.tick * TICK_S)
        self._least_clearance = min(self._least_clearance, body.clearance(self._discs))
        if not self._begun and math.dist((body.x, body.y), world.start[:2]) > BEGUN_M:
            self._begun = self.tick
        if self._least_clearance <= 0.0:
            self.result = "collision"
        elif math.dist((body.x, body.y), world.goal) < REACHED_M:
            self.result = "success"
        elif self._seconds > MAX_TRIAL_S:
            self.result = "timeout"

    def state(self) -> RobotState:
        """Return the body's state as it measures it, with drift."""
        return RobotState(
            robot_type=JACKAL.robot_type, pose=self._body.odometry, velocity=self._body.velocity
        )

    def scan(self) -> LaserScan | None:
        """Return the lidar's scan; None in ticks without one."""
        if self.tick % SCAN_TICKS:
            return None
        return LaserScan(
            angle_min=-FIELD_OF_VIEW_RAD / 2,
            angle_increment=FIELD_OF_VIEW_RAD / (LIDAR.beams - 1),
            range_min=LIDAR.range_min,
            range_max=LIDAR.range_max,
            ranges=ranges_bytes(self._body.scan(LIDAR, self._discs)),
        )

    def advance(self, velocity: Velocity) -> None:
        """Drive for a tick with a command."""
        self._body.tick(velocity)

    def ended(self, cycles_ms: tuple[float, ...] = ()) -> BarnTrial:
        """Return the result."""
        best_s = self._world.length / 2.0
        clipped_s = min(max(self._seconds, 2 * best_s), 8 * best_s)
        return BarnTrial(
            world=self._world.number,
            trial=self._trial,
            result=self.result,
            seconds=self._seconds,
            least_clearance=self._least_clearance,
            score=(self.result == "success") * best_s / clipped_s,
            cycles_ms=cycles_ms,
        )

    @property
    def _seconds(self) -> float:
        return (self.tick - self._begun) * TICK_S


def body_in(world: BarnWorld, conditions: Conditions, seed: int) -> JackalBody:
    """Return the Jackal at the start of a world. Raises ConfigError if MuJoCo is missing."""
    if not conditions.physics:
        return KinematicJackal(conditions, world.start, seed)
    try:
        from gigabrain_zenoh.qa.bench.jackal import MujocoJackal
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the plant mujoco needs {error.name}: pip install 'gigabrain-zenoh[sim]'"
        ) from None
    return MujocoJackal(conditions, world.start, world.posts, seed)
