"""The worlds of BARN and DynaBARN, and one trial in them."""

import json
import math
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.navigation.local_planner import Goal
from gigabrain_zenoh.qa.bench.plant import (
    FIELD_OF_VIEW_RAD,
    JACKAL,
    LIDAR,
    Conditions,
    JackalBody,
    KinematicJackal,
)

Floats = NDArray[np.float64]

FASTEST = 2.0  # [m/s], which the optimal time goes by
DYNAMIC_LENGTH = 20.0  # [m], of every path in DynaBARN
PATH_CELL, PATH_X, PATH_Y = 0.15, -4.575, 5.075  # [m], from a cell of the path to the world


class MovingDisc(NamedTuple):
    """A disc on its way between key frames, over and over."""

    duration: float  # [s]
    keys: Floats  # (k, 3): time [s], x, y [m]
    radius: float  # [m]


class BarnWorld(NamedTuple):
    """One world."""

    number: int  # in the original set
    posts: Floats  # (n, 3): x, y, radius [m]
    movers: tuple[MovingDisc, ...]
    start: tuple[float, float, float]  # x, y [m], yaw [rad]
    goal: tuple[float, float]  # [m]
    length: float  # [m], of the reference path

    def discs(self, at: float) -> Floats:
        """All obstacles at a time [s]: (n, 3), x, y, radius [m]."""
        if not self.movers:
            return self.posts
        rows = [(*_position(mover, at), mover.radius) for mover in self.movers]
        return np.concatenate([self.posts, np.array(rows).reshape(-1, 3)])


def _position(mover: MovingDisc, at: float) -> tuple[float, float]:
    times, xs, ys = mover.keys.T
    now = at % mover.duration
    return float(np.interp(now, times, xs)), float(np.interp(now, times, ys))


def read_worlds(file: Path, dynamic: bool) -> list[BarnWorld]:
    """The worlds in `file`. Raises ConfigError for what is no such file."""
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
    for index, mine, path in zip(data["index"].tolist(), posts, cells, strict=True):
        points = np.vstack([start[:2], path * PATH_CELL + (PATH_X, PATH_Y), goal])
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        worlds.append(BarnWorld(index, mine, (), start, goal, length))
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
    """Those whose numbers are in `only`, separated by commas; all where that is empty."""
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


TICK_S = TICK_NS / 1e9
SCAN_TICKS = 2  # from scan to scan
MAX_TRIAL_S = 100.0
REACHED_M, BEGUN_M = 1.0, 0.1  # [m], from the goal and from the start
APART_S = 7.3  # between the times at which trials of a moving world begin
SEED = 1000


class BarnTrial(Struct, frozen=True, kw_only=True):
    """How one trial ended."""

    world: int
    trial: int
    result: str  # success, collision or timeout
    seconds: float  # since it left the start
    least_clearance: float  # [m], over all ticks
    score: float  # by the rules of 2024 and later, 0.5 at most
    cycles_ms: tuple[float, ...]  # of planning, as long as this thread worked


class BarnCourse:
    """A trial under way. The same arguments and commands give the same readings."""

    def __init__(self, world: BarnWorld, trial: int, conditions: Conditions) -> None:
        self._world, self._trial = world, trial
        self._body = body_in(world, conditions, SEED * world.number + trial)
        self._least, self._begun = math.inf, 0
        self.tick, self.result = 0, ""
        self._discs = world.posts

    @property
    def goal(self) -> Goal:
        """As the robot knows it: where its odometry begins, there is its origin."""
        x, y, yaw = self._world.start
        dx, dy = self._world.goal[0] - x, self._world.goal[1] - y
        cosine, sine = math.cos(yaw), math.sin(yaw)
        return Goal(x=cosine * dx + sine * dy, y=cosine * dy - sine * dx)

    def look(self) -> None:
        """A tick begins: judge how it stands."""
        self.tick += 1
        body, world = self._body, self._world
        self._discs = world.discs(APART_S * self._trial + self.tick * TICK_S)
        self._least = min(self._least, body.clearance(self._discs))
        if not self._begun and math.dist((body.x, body.y), world.start[:2]) > BEGUN_M:
            self._begun = self.tick
        if self._least <= 0.0:
            self.result = "collision"
        elif math.dist((body.x, body.y), world.goal) < REACHED_M:
            self.result = "success"
        elif self._seconds > MAX_TRIAL_S:
            self.result = "timeout"

    def state(self) -> RobotState:
        """What the body measures of itself."""
        return RobotState(
            robot_type=JACKAL.robot_type, pose=self._body.odometry, velocity=self._body.velocity
        )

    def scan(self) -> LaserScan | None:
        """What its lidar sees; None in ticks without a scan."""
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
        """To the next tick with a command."""
        self._body.tick(velocity)

    def ended(self, cycles_ms: tuple[float, ...] = ()) -> BarnTrial:
        """What came of it."""
        best = self._world.length / 2.0
        clipped = min(max(self._seconds, 2 * best), 8 * best)
        return BarnTrial(
            world=self._world.number,
            trial=self._trial,
            result=self.result,
            seconds=self._seconds,
            least_clearance=self._least,
            score=(self.result == "success") * best / clipped,
            cycles_ms=cycles_ms,
        )

    @property
    def _seconds(self) -> float:
        return (self.tick - self._begun) * TICK_S


def body_in(world: BarnWorld, conditions: Conditions, seed: int) -> JackalBody:
    """A MujocoJackal at the start of a world. Raises ConfigError where there is no simulator."""
    if not conditions.physics:
        return KinematicJackal(conditions, world.start, seed)
    try:
        from gigabrain_zenoh.qa.bench.jackal import MujocoJackal
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the plant mujoco needs {error.name}: pip install 'gigabrain-zenoh[sim]'"
        ) from None
    return MujocoJackal(conditions, world.start, world.posts, seed)
