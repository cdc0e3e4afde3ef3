"""Costs of cameras: the difference between two robots, without rendering."""

import os
from collections.abc import Iterator

import pytest
from msgspec.structs import replace

from gigabrain_schemas.brain import CameraStatus, WorldModel
from gigabrain_schemas.topics import DEPTH, WORLD
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh import codec
from gigabrain_zenoh.qa.bench.camera_cost import (
    CameraCost,
    Latencies,
    RobotCost,
    cameras_table,
    pss_of,
)
from gigabrain_zenoh.testing.in_memory import Net

COST = CameraCost(
    body="waffle",
    world="arena",
    seconds=10.0,
    without=RobotCost(cpu={"perception": 0.01}, pss_bytes={"perception": 30_000_000}),
    cameras=RobotCost(
        cpu={"perception": 0.11, "camera": 0.13},
        pss_bytes={"perception": 40_000_000, "camera": 100_000_000},
    ),
    rendering_cpu=0.08,
    latency_ms=(40.0, 20.0, 30.0),
)


def test_the_added_cost_is_the_difference_without_rendering() -> None:
    assert COST.added_cpu == pytest.approx(0.15)
    assert COST.added_pss_bytes == 110_000_000


def test_the_table_has_every_process_and_works_without_latencies() -> None:
    def cells(cost: CameraCost) -> Iterator[str]:
        for column in cameras_table(cost).columns:
            yield from (str(cell) for cell in column.cells)

    assert {"camera", "110 MB", "p50 30.0", "p99 40.0"} <= set(cells(COST))
    assert "p50 0.0" in cells(replace(COST, latency_ms=()))


def test_the_memory_of_this_process_is_plausible() -> None:
    assert 1_000_000 < pss_of(os.getpid()) < 10_000_000_000


async def test_each_exposure_of_a_camera_is_timed_once() -> None:
    net = Net()
    latencies = Latencies(net.bus("bench"))
    planes = (b"", b"", b"", b"")
    picture = DepthImage(frame_id="front", height=16, width=16, planes=planes)
    status = CameraStatus(name="front", ok=True, exposure=5)
    world = WorldModel(scan_ok=True, obstacle_ahead=False, cameras=(status,))
    taken = replace(picture, basis=5, stamp_ns=net.clock.unix_ns())
    net.network.deliver(DEPTH.at("front"), codec.encode(taken))
    await net.clock.advance(30_000_000)
    for _ in range(2):
        net.network.deliver(WORLD.key, codec.encode(world))
    assert latencies.ms == [pytest.approx(30.0)]
