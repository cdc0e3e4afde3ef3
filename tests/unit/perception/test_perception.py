"""Perception: obstacles ahead, the nearest hits per sector, and blind lidars."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, SCAN, WORLD
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.perception.node import step
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import BOOT, LIDAR, WAFFLE, body, open_space, scan

NAN, INF = math.nan, math.inf
CONFIG = PerceptionConfig()
CONE_ALONE = PerceptionConfig(corridor=0.0)  # the strip is no longer than the body itself


def see(values: NDArray[np.floating], config: PerceptionConfig = CONFIG) -> WorldModel:
    return step(config, WAFFLE, scan(values))


def with_lidar(**changes: float | str) -> BodyDescription:
    return replace(WAFFLE, lidar=replace(LIDAR, **changes))


def test_open_space_is_free_all_round() -> None:
    assert see(open_space()) == WorldModel(
        scan_ok=True, obstacle_ahead=False, distance_ahead=None, sectors=(None,) * 12
    )


@pytest.mark.parametrize(
    ("degrees", "ahead"),
    [(0, True), (14, True), (15, True), (16, False), (345, True), (344, False), (180, False)],
)
def test_the_cone_ahead_reaches_15_degrees_to_either_side(degrees: int, ahead: bool) -> None:
    world = see(open_space(**{f"deg_{degrees}": 0.8}))
    assert world.obstacle_ahead is ahead
    assert world.distance_ahead == (pytest.approx(0.8) if ahead else None)


@pytest.mark.parametrize(("distance", "ahead"), [(0.999, True), (1.0, True), (1.001, False)])
def test_the_cone_ahead_reaches_one_metre(distance: float, ahead: bool) -> None:
    assert see(open_space(deg_0=distance)).obstacle_ahead is ahead


@pytest.mark.parametrize(("distance", "ahead"), [(0.099, False), (0.101, True)])
def test_hits_nearer_than_10_cm_are_the_lidars_own_housing(distance: float, ahead: bool) -> None:
    assert see(open_space(deg_0=distance)).obstacle_ahead is ahead


def test_the_nearest_of_several_hits_ahead_counts() -> None:
    world = see(open_space(deg_0=0.9, deg_350=0.6, deg_10=0.7, deg_90=0.3))
    assert world.distance_ahead == pytest.approx(0.6)


def test_a_single_beam_is_enough() -> None:
    values = np.full(360, 3.0)
    values[::2] = 2.9
    assert not see(values).obstacle_ahead
    values[357] = 0.95
    assert see(values).obstacle_ahead


@pytest.mark.parametrize(
    ("angle_min", "increment", "beam_ahead"),
    [
        (0.0, 1, 0),
        (-math.pi, 1, 180),
        (-math.pi / 2, 1, 90),
        (math.pi, -1, 180),
        (0.0, -1, 0),
        (-6 * math.pi, 1, 0),
        (math.radians(10), 1, 350),
    ],
)
def test_any_first_angle_and_either_direction_of_turn(
    angle_min: float, increment: int, beam_ahead: int
) -> None:
    for offset, ahead in ((0, True), (14, True), (-14, True), (17, False), (-17, False)):
        values = open_space()
        values[(beam_ahead + offset) % 360] = 0.9
        message = scan(values, angle_min=angle_min, angle_increment=math.radians(increment))
        assert step(CONE_ALONE, WAFFLE, message).obstacle_ahead is ahead, offset


def test_left_and_right_are_not_swapped_when_the_lidar_turns_clockwise() -> None:
    values = open_space(deg_90=2.0)
    assert see(values).sectors[3] == pytest.approx(2.0)  # 90 degrees to the left
    clockwise = scan(values, angle_increment=-math.radians(1))
    assert step(CONFIG, WAFFLE, clockwise).sectors[9] == pytest.approx(2.0)


def test_hits_of_a_lidar_behind_the_middle_are_nearer_to_the_body() -> None:
    world = step(CONFIG, with_lidar(x=-0.064), scan(open_space(deg_0=1.05)))
    assert world.obstacle_ahead
    assert world.distance_ahead == pytest.approx(0.986)
    assert not see(open_space(deg_0=1.05)).obstacle_ahead


def test_a_lidar_mounted_sideways_or_backwards_is_turned_straight() -> None:
    left = with_lidar(yaw=math.pi / 2)  # beam 0 looks to the left
    assert step(CONFIG, left, scan(open_space(deg_270=0.8))).obstacle_ahead
    assert not step(CONFIG, left, scan(open_space(deg_0=0.8))).obstacle_ahead
    backwards = with_lidar(yaw=math.pi)
    assert step(CONFIG, backwards, scan(open_space(deg_180=0.8))).obstacle_ahead


@pytest.mark.parametrize(
    ("x", "y", "ahead"),
    [
        (0.30, 0.28, True),  # the turning circle has 0.253 m, and 0.04 m of room
        (0.30, -0.28, True),
        (0.30, 0.31, False),
        (0.52, 0.28, True),  # the front of the body is at 0.075 m, the strip is 0.45 m long
        (0.54, 0.28, False),
        (-0.30, 0.20, False),
    ],
)
def test_the_strip_needed_to_drive_on_and_still_turn_counts_as_ahead(
    x: float, y: float, ahead: bool
) -> None:
    values = np.full(3600, INF)
    values[round(math.degrees(math.atan2(y, x)) * 10) % 3600] = math.hypot(x, y)
    message = scan(values)
    assert step(CONFIG, with_lidar(beams=3600), message).obstacle_ahead is ahead


def test_each_sector_has_its_nearest_hit_counter_clockwise_from_the_front() -> None:
    world = see(open_space(deg_0=3.0, deg_355=2.5, deg_30=1.5, deg_44=1.2, deg_180=2.0, deg_270=3))
    expected: list[float | None] = [None] * 12
    expected[0], expected[1], expected[6], expected[9] = 2.5, 1.2, 2.0, 3.0
    assert list(world.sectors) == [None if d is None else pytest.approx(d) for d in expected]


def test_the_back_belongs_to_one_sector_on_both_sides_of_the_seam() -> None:
    for degrees in (166, 179, 180, 181, 194):
        world = see(open_space(**{f"deg_{degrees}": 2.0}))
        assert [i for i, d in enumerate(world.sectors) if d is not None] == [6], degrees


@pytest.mark.parametrize("count", [4, 5, 7, 360])
def test_any_number_of_sectors_covers_the_whole_turn(count: int) -> None:
    values = np.full(360, 2.0) + np.arange(360) % 2 * 0.1
    world = see(values, PerceptionConfig(sectors=count))
    assert len(world.sectors) == count
    assert None not in world.sectors


def beam_by_beam(config: PerceptionConfig, body: BodyDescription, message: LaserScan) -> WorldModel:
    """Compute the same beam by beam."""
    lidar = body.lidar
    assert lidar
    ahead, sectors = [], [INF] * config.sectors
    reach = 0.075 + config.corridor
    for i, d in enumerate(np.frombuffer(message.ranges, "<f4").astype(float).tolist()):
        if not (config.ignore_below <= d <= message.range_max):
            continue
        angle = lidar.yaw + message.angle_min + i * message.angle_increment
        x, y = lidar.x + d * math.cos(angle), lidar.y + d * math.sin(angle)
        far, bearing = math.hypot(x, y), math.degrees(math.atan2(y, x))
        in_cone = abs(bearing) <= config.sector_deg / 2 + 1e-7 and far <= config.ahead + 1e-9
        in_strip = 0 < x <= reach and abs(y) <= math.hypot(0.2, 0.155) + config.turning_room
        if in_cone or in_strip:
            ahead.append(far)
        sector = math.floor((bearing + 1e-7) / (360 / config.sectors) + 0.5) % config.sectors
        sectors[sector] = min(sectors[sector], far)
    return WorldModel(
        scan_ok=True,
        obstacle_ahead=bool(ahead),
        distance_ahead=min(ahead, default=None),
        sectors=tuple(d if d < INF else None for d in sectors),
    )


@given(
    ranges=st.lists(
        st.one_of(st.floats(0.0, 4.0, width=32), st.sampled_from([NAN, INF, -INF, 0.1, 1.0])),
        min_size=24,
        max_size=24,
    ),
    angle_min=st.floats(-7.0, 7.0),
    direction=st.sampled_from([1, -1]),
    mount=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-4.0, 4.0)),
    config=st.builds(
        PerceptionConfig,
        sector_deg=st.floats(1.0, 360.0),
        ahead=st.floats(0.2, 3.0),
        corridor=st.floats(0.0, 1.0),
        sectors=st.integers(4, 32),
    ),
)
def test_the_result_matches_a_computation_beam_by_beam(
    ranges: list[float],
    angle_min: float,
    direction: int,
    mount: tuple[float, float, float],
    config: PerceptionConfig,
) -> None:
    x, y, yaw = mount
    lidar = replace(LIDAR, beams=24, x=x, y=y, yaw=yaw)
    increment = direction * 2 * math.pi / 24
    message = scan(np.array(ranges), angle_min=angle_min, angle_increment=increment)
    body = replace(WAFFLE, lidar=lidar)
    world, slow = step(config, body, message), beam_by_beam(config, body, message)
    if not world.scan_ok:
        return
    assert world.obstacle_ahead is slow.obstacle_ahead
    assert world.distance_ahead == pytest.approx(slow.distance_ahead)
    assert world.sectors == tuple(d if d is None else pytest.approx(d) for d in slow.sectors)


@given(st.binary(min_size=4, max_size=1440).map(lambda raw: raw[: len(raw) // 4 * 4]))
def test_any_bit_pattern_gives_a_world(raw: bytes) -> None:
    count = len(raw) // 4
    message = replace(scan(np.zeros(count)), ranges=raw)
    world = step(CONFIG, with_lidar(beams=count), message)
    assert world.distance_ahead is None or 0 <= world.distance_ahead < 10


async def test_each_scan_becomes_a_world_based_on_it() -> None:
    async with NodeBench(functools.partial(perception.run, CONFIG)) as bench:
        bench.send(BODY, body())
        bench.send(SCAN, scan(open_space(deg_0=0.8), tick=5))
        bench.send(SCAN, scan(open_space(), tick=10))
        first, second = bench.sent(WORLD)
    assert (first.boot, first.tick, first.basis, first.seq) == (BOOT, 5, 5, 1)
    assert first.obstacle_ahead
    assert (second.tick, second.basis, second.seq) == (10, 10, 2)
    assert not second.obstacle_ahead


async def test_without_a_body_no_world_is_published() -> None:
    async with NodeBench(functools.partial(perception.run, CONFIG)) as bench:
        bench.send(SCAN, scan(open_space(), tick=5))
        bench.send(BODY, body())
        for tick in (4, 7, 10):
            bench.send(
                SCAN, scan(open_space(), tick=tick, boot=8)
            )  # another boot, so the body is unknown
        assert bench.sent(WORLD) == []
        bench.send(BODY, body(boot=8))
        bench.send(SCAN, scan(open_space(), tick=15, boot=8))
        assert [world.basis for world in bench.sent(WORLD)] == [15]
