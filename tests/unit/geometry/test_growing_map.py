"""A growing map closes loops, survives a kidnapped robot, and continues after it was saved."""

import numpy as np
import pytest

from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.geometry.se2 import between, compose
from gigabrain_zenoh.host.threads import ScheduledWorker
from gigabrain_zenoh.mapping.slam_map import SlamMap
from tests.unit.mapping.houses import HALL, HOUSE, PATIENCE_S, Rooms, Walker, at, error, grown

START = (1.0, 2.5)
ROUND = ((3.0, 3.0), (5.5, 3.0), (6.5, 4.8), (6.5, 1.8), (5.0, 3.0), (3.0, 4.5), (1.2, 3.8), START)
HALL_ROUND = (
    (3.0, 3.0), (6.5, 3.0), (8.0, 1.5), (11.0, 3.2), (13.5, 3.0), (13.0, 1.2), (14.5, 1.0),
    (14.5, 3.5), (12.5, 4.5), (8.0, 4.8), (5.0, 3.0), (3.0, 3.0), (1.5, 3.5), (3.0, 4.0),
    (3.0, 3.0), (8.0, 3.0),
)  # fmt: skip


def in_map(walker: Walker) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return between(at(*START), walker.pose)


@pytest.fixture(scope="module")
def toured() -> tuple[SlamMap, Walker]:
    return grown(Rooms(HOUSE), START, *ROUND, *ROUND[:3])


@pytest.mark.long
def test_after_a_tour_the_robot_is_localized_and_the_house_is_mapped(
    toured: tuple[SlamMap, Walker],
) -> None:
    chart, walker = toured
    place = walker.look()
    assert place.localized
    assert error(place, in_map(walker)) < 0.04
    assert chart.report()["loops"] > 0
    saved, _ = chart.to_save()
    area = np.count_nonzero(saved.cells[saved.cells >= 0] < 40) * 0.05**2
    assert area == pytest.approx(8 * 6 - 1.5 * 1.4 - 1.8 * 0.7 - 0.16, abs=2.5)


def test_where_people_walked_the_map_is_free() -> None:
    rooms = Rooms(HOUSE)
    chart = SlamMap(PATIENCE_S)
    for k in range(120):
        x = 1.0 + 0.02 * k
        chart.step(rooms.view(at(*START, 0), [(x, 3.4, x, 3.7), (x, 3.4, x + 0.3, 3.4)]),
                   at(0, 0), np.eye(3) * 1e-6)  # fmt: skip
    for _ in range(40):
        chart.step(rooms.view(at(*START, 0)), at(0, 0), np.eye(3) * 1e-6)
    saved, _ = chart.to_save()
    left, low = (
        (v - o) / 0.05 for v, o in zip((0.2, 0.8), (saved.origin_x, saved.origin_y), strict=True)
    )
    inside = saved.cells[int(low) : int(low) + 10, int(left) : int(left) + 40]
    assert inside.max() < 40


@pytest.mark.long
def test_a_robot_that_is_carried_away_is_relocalized_and_the_map_stays_intact() -> None:
    chart, walker = grown(Rooms(HOUSE), START, *ROUND)
    before = chart.to_save()[0]
    walker.pose = at(6.0, 4.5, 100)
    chart.lose("the odometry has jumped")
    assert not walker.look().localized
    with pytest.raises(Refused, match="not saved: the robot is not localized"):
        chart.to_save()
    place = walker.look(20)
    assert place.localized
    assert error(place, in_map(walker)) < 0.05
    assert walker.go((6.5, 1.8)).localized
    after = chart.to_save()[0]
    free = (before.cells >= 0) & (before.cells < 40)
    assert after.cells.shape == before.cells.shape
    assert np.count_nonzero(after.cells[free] > 60) < 0.01 * np.count_nonzero(free)


@pytest.mark.long
def test_a_move_that_odometry_misses_is_detected_after_3_scans() -> None:
    chart, walker = grown(Rooms(HOUSE), START, *ROUND)
    before = chart.to_save()[0]
    walker.pose = at(6.0, 4.5, 100)
    assert [walker.look().localized for _ in range(3)] == [True, True, False]
    with pytest.raises(Refused, match="the scans do not fit the robot's place in the map"):
        chart.to_save()
    assert chart.grid().cells == before.cells.tobytes()
    place = walker.look(20)
    assert place.localized
    assert error(place, in_map(walker)) < 0.05


@pytest.mark.long
def test_a_saved_map_can_be_continued(toured: tuple[SlamMap, Walker]) -> None:
    chart, walker = toured
    _, arrays = chart.to_save()
    again = Walker(Rooms(HOUSE, seed=3), SlamMap.thaw(arrays, PATIENCE_S), walker.pose)
    assert not again.look().localized
    place = again.look(30)
    assert place.localized
    assert error(place, in_map(again)) < 0.05
    place = again.go((5.0, 3.0), (3.0, 3.0))
    assert error(place, in_map(again)) < 0.05


def test_a_kept_map_continues_at_the_next_scan(toured: tuple[SlamMap, Walker]) -> None:
    chart, walker = toured
    still = chart.still()
    assert still.pose is not None
    chart = SlamMap.thaw(still.freeze(), PATIENCE_S, last=still.pose)
    again = Walker(Rooms(HOUSE, seed=3), chart, walker.pose)
    place = again.look()
    assert place.localized
    assert error(place, in_map(again)) < 0.05


@pytest.mark.long
def test_a_robot_that_was_carried_away_before_a_restart_is_searched_for(
    toured: tuple[SlamMap, Walker],
) -> None:
    chart, _ = toured
    still = chart.still()
    chart = SlamMap.thaw(still.freeze(), PATIENCE_S, last=still.pose)
    again = Walker(Rooms(HOUSE, seed=3), chart, at(6.0, 4.5, 100))
    assert not again.look().localized
    place = again.look(30)
    assert place.localized
    assert error(place, in_map(again)) < 0.05


@pytest.mark.parametrize("missing", ["poses", "sweep_hits", "link_ends"])
def test_inconsistent_arrays_are_refused(missing: str, toured: tuple[SlamMap, Walker]) -> None:
    arrays = dict(toured[0].to_save()[1])
    short = {**arrays, missing: arrays[missing][:-1]}
    for bad in (short, {name: values for name, values in arrays.items() if name != missing}):
        with pytest.raises(ConfigError, match="no pose graph: "):
            SlamMap.thaw(bad)


@pytest.mark.parametrize("name", ["points", "sweep_hits", "sweep_free", "sweep_sensor"])
def test_points_out_of_every_lidars_range_are_refused(
    name: str, toured: tuple[SlamMap, Walker]
) -> None:
    """Drawing a beam of 1e9 m would take minutes."""
    arrays = dict(toured[0].to_save()[1])
    far = arrays[name].copy()
    far[0] = 1e9
    with pytest.raises(ConfigError, match="no pose graph: "):
        SlamMap.thaw({**arrays, name: far})


@pytest.mark.long
def test_the_same_drive_gives_the_same_map_bit_for_bit() -> None:
    maps = [grown(Rooms(HOUSE), START, *ROUND)[0].to_save()[0] for _ in range(2)]
    assert np.array_equal(maps[0].cells, maps[1].cells)


def test_background_work_is_applied_at_its_scheduled_scan() -> None:
    background, taken = ScheduledWorker(PATIENCE_S), []
    background.start(lambda: lambda: taken.append("now"), 3)
    for scan in range(1, 5):
        background.at_scan()
        assert taken == (["now"] if scan >= 3 else [])
    assert background.idle
    background.close()


def test_an_error_of_background_work_is_raised_at_its_scan() -> None:
    background = ScheduledWorker(PATIENCE_S)

    def fail() -> None:
        raise ValueError("broken")

    background.start(fail, 1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="broken"):
        background.at_scan()
    background.close()


@pytest.mark.slow
def test_people_around_the_robot_do_not_move_it_to_the_other_end_of_a_hall() -> None:
    """In a hall that looks the same from both ends, only odometry tells them apart."""
    rooms = Rooms(HALL)
    chart, walker = grown(rooms, (3.0, 3.0), *HALL_ROUND)
    assert error(walker.look(), between(at(3.0, 3.0), walker.pose)) < 0.1
    walker.go((11.0, 3.2))
    left, low = walker.pose[:2] - (1.2, 0.4)
    people = [(left, low, left + 2.4, low), (left, low, left, low - 0.5)]
    crowded = [
        chart.step(rooms.view(walker.pose, people), at(0, 0), np.eye(3) * 1e-6) for _ in range(12)
    ]
    assert not crowded[-1].localized
    place = walker.look(25)
    assert place.localized
    assert error(place, between(at(3.0, 3.0), walker.pose)) < 0.1


@pytest.mark.slow
def test_a_bumped_robot_is_found_nearby_although_the_hall_has_a_similar_place() -> None:
    _, walker = grown(Rooms(HALL), (3.0, 3.0), *HALL_ROUND)
    walker.go((11.0, 3.2))
    walker.pose = compose(walker.pose, at(0.3, 0.1, 35))
    assert not walker.look(3).localized
    place = walker.look(25)
    assert place.localized
    assert error(place, between(at(3.0, 3.0), walker.pose)) < 0.1
