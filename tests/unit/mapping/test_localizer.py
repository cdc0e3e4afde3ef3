"""Localization in a saved map: global search, tracking, kidnapping, places that look alike."""

import numpy as np
import pytest

from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.mapping.global_localization import Candidate, search
from gigabrain_zenoh.mapping.likelihood_field import field_of, fit, is_self_similar
from gigabrain_zenoh.mapping.localizer import Localizer
from gigabrain_zenoh.mapping.static_map import StaticMap
from tests.unit.mapping.houses import (
    BEAMS,
    CORRIDOR,
    HALL,
    HOUSE,
    NICHE,
    PATIENCE_S,
    Rooms,
    Walker,
    at,
    drawn,
    error,
)

CUPBOARD = [(1, 5), (2, 5)]  # in the hall
VIEWPOINTS = [
    at(x, y, 10) for x in (1.0, 2.0, 3.0, 5.0, 6.0, 7.0) for y in (1.0, 2.0, 3.0, 4.0, 5.0)
]


@pytest.fixture(scope="module")
def house() -> SavedMap:
    return drawn(Rooms(HOUSE), *(pose for pose in VIEWPOINTS if (pose[:2] != (1.0, 5.0)).any()))


@pytest.fixture(scope="module")
def corridor() -> SavedMap:
    walls = [*CORRIDOR, *NICHE]
    return drawn(Rooms(walls), *(at(x, y) for x in range(1, 16) for y in (0.7, 2.3)))


def walker(saved: SavedMap, walls: list[tuple[float, float, float, float]], x: float, y: float,
           degrees: float = 0.0) -> Walker:  # fmt: skip
    return Walker(Rooms(walls), StaticMap(saved, PATIENCE_S), at(x, y, degrees))


def test_a_scan_is_fitted_to_its_place(house: SavedMap) -> None:
    field = field_of(house.cells, house.resolution, (house.origin_x, house.origin_y))
    view = Rooms(HOUSE).view(at(3.0, 2.5, 30))
    weak_prior = np.eye(3) * 1e-3
    found = fit(field, view.beams, at(3.12, 2.41, 35), weak_prior)
    assert found.pose[:2] == pytest.approx((3.0, 2.5), abs=0.02)
    assert np.degrees(found.pose[2]) == pytest.approx(30, abs=0.5)
    assert found.score > 0.9
    elsewhere = fit(field, view.beams, at(6, 4), weak_prior)
    assert elsewhere.score < 0.45


@pytest.mark.long
@pytest.mark.parametrize(
    "pose", [at(1.0, 1.0, 77), at(3.3, 5.2, -140), at(5.5, 1.5, 180), at(7.2, 4.4, -12)]
)
def test_one_scan_is_localized_in_the_whole_house(pose: object, house: SavedMap) -> None:
    assert isinstance(pose, np.ndarray)
    field = field_of(house.cells, house.resolution, (house.origin_x, house.origin_y))
    view = Rooms(HOUSE).view(pose)
    best = search(field, view.beams)[0]
    assert best.pose[:2] == pytest.approx(pose[:2], abs=0.04)
    assert np.cos(best.pose[2] - pose[2]) == pytest.approx(1.0, abs=2e-4)  # 1 degree


def test_an_empty_scan_or_map_gives_no_place(house: SavedMap) -> None:
    field = field_of(house.cells, house.resolution, (house.origin_x, house.origin_y))
    view = Rooms([(50, 50, 51, 51)]).view(at(0, 0))
    assert len(view.scan.free) == BEAMS
    assert search(field, view.beams) == []
    unknown = field_of(np.full((50, 50), -1, np.int8), 0.05, (0.0, 0.0))
    seen = Rooms(HOUSE).view(at(3.0, 2.5))
    assert search(unknown, seen.beams) == []


@pytest.mark.long
def test_a_robot_is_localized_without_a_prior_and_tracked_to_3_cm(house: SavedMap) -> None:
    robot = walker(house, HOUSE, 3.0, 2.0, 45)
    assert not robot.look().localized
    assert robot.look(14).localized
    for x, y in ((3.0, 4.0), (5.0, 3.0), (6.5, 1.8), (6.5, 5.0)):
        place = robot.go((x, y))
        assert place.localized
        assert error(place, robot.pose) < 0.03
    assert np.sqrt(place.covariance.diagonal()).max() < 0.03


@pytest.mark.long
def test_a_robot_that_is_carried_off_is_lost_within_5_scans_and_found_again(
    house: SavedMap,
) -> None:
    robot = walker(house, HOUSE, 3.0, 2.0)
    assert robot.look(15).localized
    robot.pose = at(6.5, 4.8, 120)
    lost = [robot.look() for _ in range(5)]
    assert not lost[-1].localized
    assert lost[-1].why == "the scans do not fit the robot's place in the map"
    place = robot.look(15)
    assert place.localized
    assert error(place, robot.pose) < 0.03


@pytest.mark.long
def test_a_robot_is_not_localized_while_two_places_look_alike(corridor: SavedMap) -> None:
    walls = [*CORRIDOR, *NICHE]
    robot = walker(corridor, walls, 1.5, 0.7)
    place = robot.look(30)
    assert not place.localized
    assert place.why == "2 places match the scans"
    assert not robot.go((2.5, 0.7)).localized  # nor from there
    place = robot.go((7.5, 0.8))
    assert place.localized
    assert error(place, robot.pose) < 0.05


def hall(reach: int) -> SavedMap:
    """Return the map of the hall, seen from x up to `reach` [m]; the right end is unknown."""
    places = [(x, y) for x in range(1, reach + 1) for y in (1, 3, 5) if (x, y) not in CUPBOARD]
    return drawn(Rooms(HALL), *(at(x, y) for x, y in places))


def x_positions(found: list[Candidate]) -> list[float]:
    """Return the x of the candidates [m], rounded to 10 cm."""
    return [round(float(one.pose[0]), 1) for one in found]


@pytest.mark.long
@pytest.mark.parametrize("x", [11.0, 11.5])
def test_a_fully_mapped_place_is_not_preferred_to_a_half_mapped_one(x: float) -> None:
    robot = walker(hall(9), HALL, x, 3.0)
    place = robot.look(16)
    assert not place.localized
    assert place.why == "2 places match the scans"


@pytest.mark.long
@pytest.mark.parametrize(  # [m], mapped part of the hall
    "reach", [9, pytest.param(15, marks=pytest.mark.qa)]
)
def test_in_a_symmetric_hall_a_robot_is_not_localized_wrongly(reach: int) -> None:
    saved, rooms = hall(reach), Rooms(HALL)
    for k, x in enumerate((4.8, 6.5, 8.0, 9.2, 10.5, 11.0, 11.4, 11.8)):
        robot = Walker(rooms, StaticMap(saved, PATIENCE_S), at(x, 2.8, 50 * k))
        places = [robot.look(16), robot.go((8.5, 2.8)), robot.go((8.0, 2.0))]
        wrong = [place for place in places if place.localized and error(place, robot.pose) > 0.3]
        assert not wrong, x
        assert places[-1].localized or places[-1].why.endswith(" places match the scans")


def test_a_symmetric_hall_is_similar_to_itself_turned_by_180_degrees() -> None:
    half = hall(9)
    field = field_of(half.cells, half.resolution, (half.origin_x, half.origin_y))
    assert is_self_similar(field, at(16.0, 6.0, 180))
    assert not is_self_similar(field, at(15.0, 6.0, 180))
    assert not is_self_similar(field, at(-3.5, 0.0))  # only its long walls match
    assert not is_self_similar(field, at(-20.0, 0.0))  # no overlap


@pytest.mark.long
def test_the_last_known_pose_is_among_the_places_if_it_explains_the_scan() -> None:
    saved, view = hall(8), Rooms(HALL).view(at(12.0, 3.0))  # little of the view is mapped
    field = field_of(saved.cells, saved.resolution, (saved.origin_x, saved.origin_y))
    scan = view.beams
    assert x_positions(search(field, scan)) == [
        4.0,
        11.4,
    ]  # the other end of the hall, and the next wall
    assert x_positions(search(field, scan, at(12.0, 3.0))) == [4.0, 11.4, 11.9]
    assert x_positions(search(field, scan, at(3.0, 3.0))) == [4.0, 11.4]


@pytest.mark.long
def test_in_open_space_odometry_is_used_until_it_is_too_uncertain(house: SavedMap) -> None:
    robot = walker(house, HOUSE, 3.0, 2.0)
    assert robot.look(15).localized
    robot.rooms = Rooms([(50, 50, 51, 51)])
    robot.pose = at(3.0, 2.0)
    places = [robot.look(1, at(0.1, 0.0)) for _ in range(2000)]
    assert places[50].localized
    deviations = [np.sqrt(place.covariance[0, 0]) for place in places[:50]]
    assert deviations == sorted(deviations)
    assert not places[-1].localized


def test_beams_that_pass_through_a_wall_lower_the_score(house: SavedMap) -> None:
    field = field_of(house.cells, house.resolution, (house.origin_x, house.origin_y))
    view = Rooms(HOUSE).view(at(3.0, 2.5))
    weak_prior = np.eye(3)
    here = fit(field, view.beams, at(3.0, 2.5), weak_prior)
    long = np.array([[5.0, -1.5]] * len(view.scan.points), np.float32)  # through the inner wall
    through = fit(field, view.beams._replace(free=long), at(3.0, 2.5), weak_prior)
    assert here.score - through.score == pytest.approx(0.5, abs=0.06)


def test_two_candidates_that_merge_still_count_as_odometrys_place() -> None:
    rooms = Rooms(HALL)
    saved = drawn(rooms, *(at(x, y) for x in range(1, 16) for y in (1.0, 3.0, 5.0)))
    field = field_of(saved.cells, saved.resolution, (saved.origin_x, saved.origin_y))
    localizer = Localizer(field)
    results = ((11.16, 3.2, 0.0, 0.9), (10.84, 3.2, 0.0, 0.8), (5.0, 2.8, 180.0, 0.85))
    candidates = [Candidate(at(x, y, turn), score) for x, y, turn, score in results]
    localizer.found(candidates, at(0, 0), last=at(10.7, 3.2))
    for _ in range(5):
        place = localizer.step(rooms.view(at(11.0, 3.2)), at(0, 0), np.eye(3) * 1e-6)
    assert place.localized
    assert error(place, at(11.0, 3.2)) < 0.05
