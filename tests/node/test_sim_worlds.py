"""Worlds: names, clear starts, layouts without traps, and walking persons."""

import itertools
import math

import mujoco
import pytest

from gigabrain_drivers.sim.scene import Person, world_spec
from gigabrain_drivers.sim.world import (
    Box,
    ClosedPath,
    Cylinder,
    Footprint,
    Pose,
    WalkingPath,
    clearance,
)
from gigabrain_drivers.sim.worlds import load_world, world_names
from gigabrain_zenoh.errors import UnknownName

SOME_WORLDS = ("arena", "house", "warehouse", "random:0", "random:7")


def test_the_worlds_are_listed_with_a_line_each() -> None:
    names = world_names()
    assert list(names) == [
        "arena",
        "house",
        "kitchen",
        "playroom",
        "table",
        "warehouse",
        "random:SEED",
        "FILE",
    ]
    assert all(text and "\n" not in text for text in names.values())


def test_a_mistyped_world_suggests_the_right_one() -> None:
    with pytest.raises(UnknownName, match="no world 'werehouse'; did you mean 'warehouse'"):
        load_world("werehouse", 0)


@pytest.mark.parametrize("name", ["random:abc", "random:", "random:-1", "random:1.5"])
def test_a_random_world_without_a_whole_number_is_refused(name: str) -> None:
    with pytest.raises(UnknownName, match="random:SEED needs a whole number"):
        load_world(name, 0)


@pytest.mark.parametrize("name", SOME_WORLDS)
def test_every_start_is_60_cm_clear_and_inside(name: str) -> None:
    for seed in range(20):
        world = load_world(name, seed)
        x, y, yaw = world.start
        assert clearance(world.everything(), x, y) >= 0.6
        assert abs(x) <= world.half_x - 0.6
        assert abs(y) <= world.half_y - 0.6
        assert -math.pi <= yaw <= math.pi


def test_the_seed_alone_decides_layout_and_start() -> None:
    assert load_world("random:3", 1) == load_world("random:3", 1)
    assert load_world("random:3", 1).shapes == load_world("random:3", 2).shapes
    assert load_world("random:3", 1).start != load_world("random:3", 2).start
    assert load_world("random:3", 1).shapes != load_world("random:4", 1).shapes


@pytest.mark.parametrize("seed", range(6))
def test_no_gap_in_a_random_world_is_a_trap(seed: int) -> None:
    world = load_world(f"random:{seed}", 0)
    assert 10 <= len(world.shapes) <= 14
    assert all(gap < 0.2 or gap >= 1.1 for gap in _gaps(f"random:{seed}"))


def test_no_gap_in_arena_and_warehouse_is_a_trap() -> None:
    assert min(gap for gap in _gaps("arena") if gap >= 0.2) >= 1.1
    assert min(gap for gap in _gaps("warehouse") if gap >= 0.2) >= 1.1


def _gaps(name: str) -> list[float]:
    """Return the distances between all pairs of solid things [m], by MuJoCo."""
    model = world_spec(load_world(name, 0)).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    things = [
        geom
        for geom in range(model.ngeom)
        if model.geom_contype[geom] and model.geom(geom).name not in ("floor", "person")
    ]
    pairs = itertools.combinations(things, 2)
    return [mujoco.mj_geomDistance(model, data, one, two, 3.0, None) for one, two in pairs]


@pytest.mark.parametrize("name", SOME_WORLDS)
def test_shapes_reach_the_floor_or_hang_above_robots_and_rise_above_lidars(name: str) -> None:
    world = load_world(name, 0)
    for shape in world.everything():
        assert shape.bottom == 0 or shape.bottom >= 0.25
        assert shape.bottom + shape.height >= 0.25


def test_distances_to_shapes_are_those_of_plane_geometry() -> None:
    assert Box(1, 0, 0.5, 0.25, 1).distance(0, 0) == 0.5
    assert Box(1, 0, 0.5, 0.25, 1, yaw=math.pi / 2).distance(0, 0) == 0.75
    assert Box(0, 0, 1, 1, 1).distance(4, 5) == 5.0
    assert Box(0, 0, 1, 1, 1).distance(0.9, 0.9) == 0.0
    assert Cylinder(3, 4, 1, 1).distance(0, 0) == 4.0


def test_the_footprint_turns_with_the_robot() -> None:
    footprint = Footprint(front=0.1, rear=-0.3, half_width=0.2)
    assert footprint.distance(Pose(0, 0, 0), 1.1, 0) == pytest.approx(1.0)
    assert footprint.distance(Pose(0, 0, math.pi), 1.1, 0) == pytest.approx(0.8)
    assert footprint.distance(Pose(1, 1, math.pi / 2), 1.05, 1.05) == 0.0


def test_a_closed_path_is_walked_by_arc_length_and_wraps() -> None:
    path = ClosedPath(((0, 0), (2, 0), (2, 1), (0, 1)))
    assert path.length == 6.0
    assert path.at(2.5) == pytest.approx((2, 0.5, math.pi / 2))
    assert path.at(6.5) == pytest.approx((0.5, 0, 0))


def test_a_person_walks_80_cm_per_second() -> None:
    person = Person(WalkingPath(((0, 0), (10, 0), (10, 1), (0, 1)), start=0.0))
    for _ in range(100):
        person.advance(lambda x, y: 5.0)
    assert person.pose == pytest.approx((0.8, 0, 0))


def test_a_person_stops_half_a_metre_before_the_robot_until_it_is_gone() -> None:
    person = Person(WalkingPath(((0, 0), (10, 0), (10, 1), (0, 1)), start=0.0))
    for _ in range(1000):
        person.advance(lambda x, y: math.hypot(x - 3.0, y))
    assert 3.0 - person.pose.x - 0.25 == pytest.approx(0.5, abs=0.009)
    assert 3.0 - person.pose.x - 0.25 >= 0.5
    for _ in range(100):
        person.advance(lambda x, y: 5.0)
    assert person.pose.x > 3.0


def test_a_person_may_walk_away_from_a_robot_that_is_too_close() -> None:
    person = Person(WalkingPath(((0, 0), (10, 0), (10, 1), (0, 1)), start=1.0))
    for _ in range(100):
        person.advance(lambda x, y: math.hypot(x - 0.6, y))
    assert person.pose.x == pytest.approx(1.8)


def test_each_stop_of_a_person_for_the_robot_counts_once() -> None:
    person = Person(WalkingPath(((0, 0), (10, 0), (10, 1), (0, 1)), start=0.0))
    for _ in range(100):
        person.advance(lambda x, y: max(0.0, 1.0 - x))
    assert person.stood == 1
    for _ in range(200):
        person.advance(lambda x, y: 9.0)
    for _ in range(100):
        person.advance(lambda x, y: 0.6 - 0.01 * x)
    assert person.stood == 2
