"""A late lidar without stamps is found by the turns of its scans, on a fake clock."""

import math
import random
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_S, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState, Thresholds
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.safety.latency import DataLatency, TurnDelay
from gigabrain_zenoh.testing.samples import LIDAR, WAFFLE, scan, state

BODY = replace(WAFFLE, thresholds=Thresholds(reaction_time=0.25))
SLOW_LIDAR = replace(WAFFLE, lidar=replace(LIDAR, rate_hz=5.0), thresholds=BODY.thresholds)
ANGLES = np.radians(np.arange(360.0))


def room(pose: Pose) -> NDArray[np.float64]:
    """Return the ranges of 360 beams [m] in a room of 6 m by 4 m. Its middle is (0.5, 0.3)."""
    angles = ANGLES + pose.yaw
    across, along = np.cos(angles), np.sin(angles)
    x = np.where(across > 0, 3.5 - pose.x, -2.5 - pose.x) / np.where(across == 0, 1e-9, across)
    y = np.where(along > 0, 2.3 - pose.y, -1.7 - pose.y) / np.where(along == 0, 1e-9, along)
    return np.minimum(np.abs(x), np.abs(y))


def silo(_: Pose) -> NDArray[np.float64]:
    """Return the ranges in a round room, equal in all directions."""
    return np.full(360, 2.0)


class Robot:
    """A robot that follows commands; its scans arrive `delay` ticks late."""

    def __init__(self, delay: int, body: BodyDescription = BODY) -> None:
        self.body, self.delay = body, delay
        assert body.lidar
        self.period = round(1 / (body.lidar.rate_hz * TICK_S))
        self.tick, self.rate = 0, 0.0
        self.poses = [Pose(x=0.0, y=0.0, yaw=0.0)] * 100
        self.history, self.late = PoseHistory(), DataLatency()
        self.scan: LaserScan | None = None
        self.chance, self.noise = random.Random(1), np.random.default_rng(1)
        self.world = room
        self.drive(60, 0.0)

    def drive(self, ticks: int, turning: float, speed: float = 0.0) -> list[str]:
        """Ramp to a rate of turn [rad/s] and keep it; return the codes of all causes."""
        found: list[str] = []
        for _ in range(ticks):
            self.tick += 1
            self.rate += max(-0.06, min(0.06, turning - self.rate))
            now = self.state(Velocity(linear_x=speed, angular_z=self.rate))
            if self.tick % self.period == 0:
                seen = self.world(self.poses[-1 - self.delay - self.period // 2])
                self.scan = scan(seen + self.noise.normal(0.0, 0.01, 360), self.tick)
                self.scan = replace(self.scan, basis=self.tick)
            self.history = self.history.then(now)
            self.late = self.late.then(self.body, now, self.scan, self.history, 1)
            found += [
                c.code
                for c in (*self.late.slow_causes(self.body), *self.late.stop_causes(self.body))
            ]
        return list(dict.fromkeys(found))

    def state(self, velocity: Velocity) -> RobotState:
        pose = self.poses[-1]
        yaw = pose.yaw + velocity.angular_z * TICK_S
        step = velocity.linear_x * TICK_S
        pose = Pose(x=pose.x + step * math.cos(yaw), y=pose.y + step * math.sin(yaw), yaw=yaw)
        self.poses.append(pose)
        measured = replace(pose, yaw=math.remainder(yaw + self.chance.gauss(0, 0.002), math.tau))
        return replace(
            state(self.tick), basis=self.tick, pose=measured, velocity=velocity, sent=velocity
        )


def test_a_lidar_100_ms_late_is_found_within_a_second_of_a_turn() -> None:
    for delay in (5, 6):
        robot = Robot(delay)
        assert robot.drive(50, 1.0) == ["lidar_late"]
    assert robot.drive(80, 0.0) == ["lidar_late"]
    assert robot.drive(60, 0.0) == []  # at rest the delay is forgotten


def test_a_lidar_that_becomes_late_is_found_when_the_turn_ends() -> None:
    robot = Robot(0)
    assert robot.drive(100, 1.0, 0.1) == []
    robot.delay = 5
    robot.drive(50, 1.0, 0.1)
    assert "lidar_late" in robot.drive(50, -0.5, 0.1)


@pytest.mark.long
@pytest.mark.parametrize("body", [BODY, SLOW_LIDAR])
def test_a_lidar_without_delay_is_not_late_on_any_drive(
    body: BodyDescription,
) -> None:
    robot, chance = Robot(0, body), random.Random(3)
    for _ in range(60):
        robot.delay = chance.choice((0, 0, 1))
        assert robot.drive(chance.randint(10, 80), chance.uniform(-1.8, 1.8), 0.05) == []


@pytest.mark.parametrize("delay", [0, 5])
def test_in_a_round_room_the_delay_stays_unknown(delay: int) -> None:
    robot = Robot(delay)
    robot.world = silo
    assert robot.drive(50, 1.0) == []
    assert robot.late.turns.ticks is None


def test_driving_straight_on_the_delay_stays_unknown() -> None:
    robot = Robot(5)
    assert robot.drive(200, 0.0, 0.2) == []
    assert robot.late.turns.ticks is None


Change = Callable[[NDArray[np.float64]], None]


def turned(change: Change, yaw: float) -> float | None:
    """Return the turn between two scans of a room, both changed by `change`; None if unknown."""
    delay, history = TurnDelay(), PoseHistory()
    for tick, seen in (
        (5, room(Pose(x=0.0, y=0.0, yaw=0.0))),
        (10, room(Pose(x=0.0, y=0.0, yaw=yaw))),
    ):
        change(seen)
        now = replace(state(tick), basis=tick)
        delay = delay.then(now, replace(scan(seen, tick), basis=tick), history, 5)
    return delay.turns[-1][2] if delay.turns else None


def unchanged(_: NDArray[np.float64]) -> None:
    pass


def gaps(seen: NDArray[np.float64]) -> None:
    seen[40:60], seen[100:110], seen[200:215] = np.nan, np.inf, -np.inf


@pytest.mark.parametrize(
    ("change", "yaw", "turn"),
    [
        (unchanged, 0.0, 0.0),
        (unchanged, 0.1, 0.09998960632440314),
        (unchanged, -0.3, -0.29999356532962007),
        (unchanged, 0.5, 0.49996078370780606),
        (unchanged, 0.7, None),  # farther than is searched
        (gaps, 0.1, 0.05676318957283547),
        (gaps, -0.3, -0.2839689727870426),
        (gaps, 0.5, None),
    ],
)
def test_the_turn_between_two_scans(change: Change, yaw: float, turn: float | None) -> None:
    assert turned(change, yaw) == turn
