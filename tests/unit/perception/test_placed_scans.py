"""Scans wait for the states of their ticks, so that perception can track obstacles."""

import functools

import numpy as np
import pytest

from gigabrain_schemas.base import Pose
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, SCAN, STATE, WORLD
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.geometry.pose import PlacedScans
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import body, open_space, scan, state

MAPPING = PerceptionConfig(mapping="slam")


class Handed:
    """A receiver of placed scans. It keeps the tick of each scan and the x of its pose."""

    def __init__(self) -> None:
        self.placed = PlacedScans(self._take, lambda scan: self.missed.append(scan.basis))
        self.all, self.missed = list[tuple[int, float | None]](), list[int]()

    def _take(self, of: LaserScan, pose: Pose | None) -> None:
        self.all.append((of.basis, pose.x if pose else None))

    def state(self, tick: int, x: float = 0.0, *, boot: int = 7) -> None:
        self.placed.state(state(tick, pose=(x, 0.0, 0.0), boot=boot))

    def scan(self, tick: int, *, boot: int = 7) -> None:
        self.placed.scan(scan(open_space(), tick, boot=boot))


def test_a_scan_is_passed_on_with_the_pose_of_its_tick() -> None:
    handed = Handed()
    handed.state(4, 0.4)
    handed.state(5, 0.5)
    handed.scan(4)
    assert handed.all == [(4, 0.4)]


def test_a_scan_waits_for_the_state_of_its_tick() -> None:
    handed = Handed()
    handed.scan(5)
    handed.state(4, 0.4)
    assert handed.all == []
    handed.state(5, 0.5)
    handed.state(6, 0.6)
    assert (handed.all, handed.missed) == ([(5, 0.5)], [])


def test_a_scan_from_the_future_waits_until_the_next_scan_replaces_it() -> None:
    handed = Handed()
    handed.state(5)
    handed.scan(5000)
    handed.scan(5)
    handed.state(6)
    assert (handed.all, handed.missed) == ([(5, 0.0)], [5000])


def test_a_scan_of_a_tick_long_ago_has_no_pose() -> None:
    handed = Handed()
    handed.state(5)
    handed.state(50)
    handed.scan(20)
    assert handed.all == [(20, None)]


def test_a_scan_of_another_start_of_the_driver_waits_for_its_state() -> None:
    handed = Handed()
    handed.state(5)
    handed.scan(1, boot=8)
    assert handed.all == []
    handed.state(1, 0.1, boot=8)
    assert handed.all == [(1, 0.1)]


def round_post(x: float, y: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return ranges to a post of 0.2 m radius in open space, and to a wall 3 m behind the robot."""
    angles = np.radians(np.arange(360.0))
    along = x * np.cos(angles) + y * np.sin(angles)
    square = 0.2**2 - x * x - y * y + along**2
    ranges = np.where((square > 0) & (along > 0), along - np.sqrt(np.maximum(square, 0)), np.inf)
    behind = np.abs(angles - np.pi) < 1.3
    return np.where(behind, -1.0 / np.cos(angles), ranges)


async def drive(config: PerceptionConfig) -> list[tuple[float, float, float]]:
    """Drive at 0.5 m/s past a person who approaches at 0.5 m/s; return the tracked obstacles."""
    async with NodeBench(functools.partial(perception.run, config)) as bench:
        await bench.ready()
        bench.send(BODY, body())
        for tick in range(1, 101):
            x = 0.01 * tick
            bench.send(STATE, state(tick, pose=(x, 0.0, 0.0)))
            if tick % 5 == 0:
                bench.send(SCAN, scan(round_post(3.5 - 2 * x, 0.4), tick))
        worlds = bench.sent(WORLD)
    assert len(worlds) == 20
    assert [world.basis for world in worlds] == list(range(5, 101, 5))
    return [(o.x, o.velocity_x, o.radius) for o in worlds[-1].obstacles]


async def test_perception_tracks_obstacles_while_mapping() -> None:
    (found,) = await drive(MAPPING)
    assert found == pytest.approx((2.5, -0.5, 0.2), abs=0.08)


async def test_perception_tracks_nothing_without_mapping() -> None:
    assert await drive(PerceptionConfig()) == []
