"""A hint is a rough pose of the robot; a scan confirms, refines or contradicts it."""

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.mapping.likelihood_field import LikelihoodField, field_of
from gigabrain_zenoh.mapping.pose_hint import PoseHint, explained
from gigabrain_zenoh.mapping.static_map import StaticMap
from tests.unit.mapping.houses import (
    CORRIDOR,
    HOUSE,
    NICHE,
    PATIENCE_S,
    Rooms,
    Walker,
    at,
    drawn,
    error,
    grown,
)

HINT_COVARIANCE = np.diag((0.2, 0.2, 0.2)) ** 2


def field(saved: SavedMap) -> LikelihoodField:
    return field_of(saved.cells, saved.resolution, (saved.origin_x, saved.origin_y))


@pytest.fixture(scope="module")
def house() -> SavedMap:
    return drawn(Rooms(HOUSE), *(at(x, y) for x in (2.0, 3.0, 5.0, 6.5) for y in (2.0, 4.0)))


@pytest.fixture(scope="module")
def corridor() -> SavedMap:
    walls = [*CORRIDOR, *NICHE]
    return drawn(Rooms(walls), *(at(x, y) for x in range(1, 16) for y in (0.7, 2.3)))


@pytest.mark.parametrize("offset", [at(0.3, -0.25, 12), at(-0.3, 0.1, -20), at(0, 0, 0)])
def test_a_rough_pose_becomes_an_exact_one(offset: Floats, house: SavedMap) -> None:
    view = Rooms(HOUSE).view(at(3.0, 2.5, 30))
    found = explained(
        field(house), view.beams, PoseHint(at(3.0, 2.5, 30) + offset, HINT_COVARIANCE)
    )
    assert found[0].pose == pytest.approx(at(3.0, 2.5, 30), abs=0.03)
    assert found[0].score > 0.9


def test_a_hint_without_a_heading_finds_the_heading(house: SavedMap) -> None:
    view = Rooms(HOUSE).view(at(6.0, 3.0, -130))
    any_heading = np.diag((0.25, 0.25, np.pi / 2)) ** 2
    found = explained(field(house), view.beams, PoseHint(at(6.2, 2.8, 0), any_heading))
    best = found[0].pose
    assert best[:2] == pytest.approx((6.0, 3.0), abs=0.03)
    assert np.cos(best[2] - np.radians(-130)) == pytest.approx(1.0, abs=1e-3)


def test_a_hint_gives_no_pose_where_the_scan_does_not_fit(house: SavedMap) -> None:
    view = Rooms(HOUSE).view(at(3.0, 2.5, 30))
    assert explained(field(house), view.beams, PoseHint(at(6.5, 3.0, 30), HINT_COVARIANCE)) == []
    empty = Rooms([(50, 50, 51, 51)]).view(at(0, 0))
    assert explained(field(house), empty.beams, PoseHint(at(3.0, 2.5, 30), HINT_COVARIANCE)) == []
    far_off = PoseHint(at(1e5, -1e5, 0), np.diag((1e3, 1e3, 3.0)) ** 2)
    assert explained(field(house), view.beams, far_off) == []


@pytest.mark.long
@pytest.mark.parametrize("x", [1.5, 14.5])
def test_a_hint_selects_one_of_two_places_that_look_alike(x: float, corridor: SavedMap) -> None:
    robot = Walker(
        Rooms([*CORRIDOR, *NICHE]),
        StaticMap(corridor, PATIENCE_S),
        at(x, 0.7 if x < 8 else 2.3, 0.0 if x < 8 else 180.0),
    )
    place = robot.look(20)
    assert place.why == "2 places match the scans"
    robot.chart.suggest(PoseHint(robot.pose + at(0.2, 0.1, 8), HINT_COVARIANCE))
    place = robot.look(4)  # 0.4 s
    assert place.localized
    assert error(place, robot.pose) < 0.05


def test_a_hint_localizes_a_robot_after_its_start_at_once(house: SavedMap) -> None:
    robot = Walker(Rooms(HOUSE), StaticMap(house, PATIENCE_S), at(3.0, 4.0, 50))
    robot.chart.suggest(PoseHint(at(3.15, 3.9, 40), HINT_COVARIANCE))
    places = [robot.look() for _ in range(3)]
    assert places[-1].localized
    assert error(places[-1], robot.pose) < 0.03


@pytest.mark.long
def test_a_localized_robot_ignores_a_wrong_hint(house: SavedMap) -> None:
    robot = Walker(Rooms(HOUSE), StaticMap(house, PATIENCE_S), at(3.0, 4.0, 50))
    assert robot.look(16).localized
    for _ in range(20):
        robot.chart.suggest(PoseHint(at(6.0, 3.0, 10), HINT_COVARIANCE))
        place = robot.look()
        assert place.localized
        assert error(place, robot.pose) < 0.03


@pytest.mark.long
def test_a_growing_map_uses_a_hint_after_the_robot_was_carried_off() -> None:
    chart, robot = grown(Rooms(HOUSE), (2.0, 2.0), (3.5, 3.0), (6.0, 3.0), (6.5, 2.0))
    robot.pose = at(3.0, 3.5, 100)
    chart.lose("the driver has restarted")
    map_pose = robot.pose - at(2.0, 2.0)  # the map's origin is the start
    hint = PoseHint(map_pose + at(0.2, -0.1, 5), HINT_COVARIANCE)
    found = False
    for _ in range(4):
        chart.suggest(hint)
        found = robot.look().localized
    assert found
    assert error(robot.look(), map_pose) < 0.05
    chart.close()
