"""The benchmark of cluttered worlds: its worlds, its results, and its table."""

import itertools
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.sim.mjcf_world import is_floor
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.base import Pose
from gigabrain_zenoh.cli.bench_eyes import _clutter_table
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files
from gigabrain_zenoh.qa.bench.clutter import (
    ClutterCourse,
    ClutterResult,
    ClutterRun,
    Incident,
    earlier,
    in_words,
    seeds_of,
)
from gigabrain_zenoh.qa.bench.cluttered_worlds import (
    GOALS,
    HALF_M,
    KINDS,
    ClutteredWorld,
    FreeSpace,
    draw_cluttered,
    mjcf,
    write_world,
)
from gigabrain_zenoh.qa.bench.eyes_worlds import Part, Pit, distances

BODY = load_robot("turtlebot3_waffle").description()
WORLDS = [draw_cluttered(seed, BODY) for seed in (7, 8)]
LIDAR_PLANE_M = 0.155
RUN = ClutterRun(
    seed=3, cameras=True, reached=9, contacts=0, falls=0, min_clearance_m=0.06, distance_m=12.0,
    seconds=99.0, alone=0,
)  # fmt: skip


def test_worlds_repeat_and_differ_by_seed() -> None:
    assert draw_cluttered(7, BODY) == WORLDS[0]
    assert WORLDS[0] != WORLDS[1]


@pytest.mark.parametrize("world", WORLDS)
def test_the_body_fits_at_all_goals_and_at_the_start(world: ClutteredWorld) -> None:
    obstacles = [one.outline for one in world.parts if one.bottom < BODY.body_height]
    obstacles += [one.outline for one in world.pits]
    corner = max(math.hypot(x, y) for x, y in BODY.footprint)
    places = np.array([(world.start.x, world.start.y), *world.goals])
    assert len(places) == GOALS + 1
    assert (distances(obstacles, places) > corner + 0.1).all()
    assert (np.abs(places) < HALF_M - corner).all()


@pytest.mark.parametrize("world", WORLDS)
def test_many_things_are_not_in_the_plane_of_the_lidar(world: ClutteredWorld) -> None:
    unseen = {
        one.thing for one in world.parts
        if one.bottom < BODY.body_height and not one.bottom < LIDAR_PLANE_M < one.top
    }  # fmt: skip
    assert len(unseen) >= len(world.kinds) / 3
    assert world.pits


@pytest.mark.slow
def test_all_kinds_are_drawn() -> None:
    worlds = [draw_cluttered(seed, BODY) for seed in range(20, 26)]
    assert {kind for world in worlds for kind in world.kinds} == set(KINDS)


def test_a_way_leads_round_obstacles_and_not_through_a_narrow_gap() -> None:
    wall = Part(0, 0.0, -0.4, 0.05, HALF_M - 0.4, 0.05)  # 0.8 m of room at its northern end
    shelf = Part(1, 0.0, HALF_M - 0.4, 0.05, 0.4, 0.2, bottom=0.1)
    roof = Part(1, 0.0, HALF_M - 0.4, 0.05, 0.4, 0.6, bottom=0.5)
    narrowing = Pit(0.0, HALF_M - 0.65, 0.1, 0.15, 0.3)

    def way(parts: tuple[Part, ...], pits: tuple[Pit, ...] = ()) -> float:
        return float(FreeSpace(parts, pits, BODY).way((-1.0, -1.0), (1.0, -1.0)))

    assert way(()) == pytest.approx(2.0, abs=0.1)
    assert 5.0 < way((wall,)) < 7.5
    assert way((wall, roof)) == way((wall,))
    assert way((wall, shelf)) == math.inf
    assert way((wall,), (narrowing,)) == math.inf


def test_the_floor_has_holes_only_at_the_pits() -> None:
    pits = (Pit(0.2, 0.3, 0.3, 0.2, 0.25), Pit(-0.9, 0.35, 0.2, 0.4, 0.1))
    world = ClutteredWorld(0, (), (), pits, Pose(x=0.0, y=-1.0, yaw=0.0), (), ())
    model = mujoco.MjModel.from_xml_string(mjcf(world))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert all(is_floor(model, geom) for geom in range(model.ngeom))
    down, no_group = np.array([0.0, 0.0, -1.0]), None
    for x, y in itertools.product(np.arange(-2.0, 2.0, 0.1).round(2) + 0.013, repeat=2):
        away = mujoco.mj_ray(
            model, data, np.array([x, y, 1.0]), down, no_group, 1, -1, np.zeros(1, np.int32)
        )
        inside = [p for p in pits if abs(x - p.x) < p.half_x and abs(y - p.y) < p.half_y]
        assert away == pytest.approx(1.0 + (inside[0].depth if inside else 0.0), abs=1e-6)


def test_the_simulator_reads_the_world(tmp_path: Path) -> None:
    world = load_world(str(write_world(WORLDS[0], tmp_path)), 0)
    assert world.start_fixed
    assert (world.start.x, world.start.y) == (WORLDS[0].start.x, WORLDS[0].start.y)
    assert len(world.outlines) > 5
    assert world.half_x == pytest.approx(HALF_M)


def test_the_nearest_thing_is_named() -> None:
    world = ClutteredWorld(
        0, (Part(0, 1.0, 0.0, 0.1, 0.1, 0.1),), ("box",), (Pit(-1.0, 0.0, 0.1, 0.1, 0.1),),
        Pose(x=0.0, y=0.0, yaw=0.0), (), (),
    )  # fmt: skip
    assert world.name_near(0.7, 0.0) == "box"
    assert world.name_near(-0.7, 0.0) == "pit"
    assert world.name_near(0.0, HALF_M - 0.2) == "wall"


@pytest.mark.parametrize(
    ("text", "seeds"), [("4", (4,)), ("0-3", (0, 1, 2, 3)), ("7, 2-3,7", (7, 2, 3))]
)
def test_seeds_are_ranges_and_numbers(text: str, seeds: tuple[int, ...]) -> None:
    assert seeds_of(text) == seeds


@pytest.mark.parametrize("text", ["", "-3", "5-3", "a", "1-", "1,,2", "1.5"])
def test_other_seeds_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--seeds"):
        seeds_of(text)


def test_a_world_passes_only_without_harm_and_with_eight_goals() -> None:
    assert RUN.ok
    assert replace(RUN, reached=8).ok
    assert not replace(RUN, reached=7).ok
    assert not replace(RUN, contacts=1).ok
    assert not replace(RUN, falls=1).ok


def test_a_file_of_results_is_continued_only_for_the_same_course(tmp_path: Path) -> None:
    path, course = tmp_path / "clutter.json", ClutterCourse()
    assert earlier(None, course).runs == earlier(path, course).runs == ()
    result = ClutterResult(body=course.body, speed=3.0, seconds=120.0, runs=(RUN,))
    files.write_result(result, path)
    found = earlier(path, course)
    assert found == result
    assert found.has(3, cameras=True)
    assert not found.has(3, cameras=False)
    with pytest.raises(ConfigError, match="another file"):
        earlier(path, ClutterCourse(speed=2.0))
    path.write_text("{}")
    with pytest.raises(ConfigError, match="no results"):
        earlier(path, course)


def test_the_table_has_a_column_for_each_way_of_driving() -> None:
    hit = replace(RUN, cameras=False, contacts=1, reached=2)
    console = Console(width=80, record=True)
    console.print(
        _clutter_table(ClutterResult(body="b", speed=3.0, seconds=120.0, runs=(RUN, hit)))
    )
    lines = console.export_text().splitlines()
    assert any(
        "goals reached" in line and "9 of 10" in line and "2 of 10" in line for line in lines
    )
    assert all(len(line) <= 80 for line in lines)
    console.print(_clutter_table(ClutterResult(body="b", speed=3.0, seconds=120.0)))


def test_the_text_of_an_incident_names_kind_and_place() -> None:
    one = Incident(what="fall", near="pit", at=Pose(x=1.0, y=-0.5, yaw=0.0), seconds=12.34)
    text = in_words(replace(RUN, falls=1, incidents=(one,)))
    assert "fall" in text
    assert "(1.00, -0.50, 0.00)" in text
    assert "pit" in text
