"""One trial of BARN: a Jackal among its world's obstacles, and how it fares.

Who drives it hears of nothing but scans, odometry and the measured speed.
"""

import math

from msgspec import Struct

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.navigation.moment import Goal
from gigabrain_zenoh.qa.bench.barn_worlds import World
from gigabrain_zenoh.qa.bench.plant import FIELD_OF_VIEW, JACKAL, LIDAR, Body, Conditions, Plant

TICK_S = TICK_NS / 1e9
SCAN_TICKS = 2  # from scan to scan
LIMIT_S = 100.0
REACHED_M, BEGUN_M = 1.0, 0.1  # [m], from the goal and from the start
APART_S = 7.3  # between the times at which trials of a moving world begin
SEED = 1000


class Trial(Struct, frozen=True, kw_only=True):
    """How one trial ended."""

    world: int
    trial: int
    result: str  # success, collision or timeout
    seconds: float  # since it left the start
    least_clearance: float  # [m], over all ticks
    score: float  # by the rules of 2024 and later, 0.5 at most
    cycles_ms: tuple[float, ...]  # of planning, as long as this thread worked


class Course:
    """A trial under way. The same arguments and commands give the same readings."""

    def __init__(self, world: World, trial: int, conditions: Conditions) -> None:
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
        elif self._seconds > LIMIT_S:
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
            angle_min=-FIELD_OF_VIEW / 2,
            angle_increment=FIELD_OF_VIEW / (LIDAR.beams - 1),
            range_min=LIDAR.range_min,
            range_max=LIDAR.range_max,
            ranges=ranges_bytes(self._body.scan(LIDAR, self._discs)),
        )

    def advance(self, velocity: Velocity) -> None:
        """To the next tick with a command."""
        self._body.tick(velocity)

    def ended(self, cycles_ms: tuple[float, ...] = ()) -> Trial:
        """What came of it."""
        best = self._world.length / 2.0
        clipped = min(max(self._seconds, 2 * best), 8 * best)
        return Trial(
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


def body_in(world: World, conditions: Conditions, seed: int) -> Body:
    """A Jackal at the start of a world. Raises ConfigError where there is no simulator."""
    if not conditions.physics:
        return Plant(conditions, world.start, seed)
    try:
        from gigabrain_zenoh.qa.bench.jackal import Jackal
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the plant mujoco needs {error.name}: pip install 'gigabrain-zenoh[sim]'"
        ) from None
    return Jackal(conditions, world.start, world.posts, seed)
