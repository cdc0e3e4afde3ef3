"""The SLAM benchmark: relations, refused logs, and recorded logs."""

import os
from pathlib import Path

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.se2 import compose
from gigabrain_zenoh.qa.bench.slam_logs import (
    LaserLog,
    crispness,
    errors,
    judge_log,
    load,
    map_log,
    relations,
    total,
)

DATA = os.environ.get("GIGABRAIN_DATA")


def circles(scans: int = 120, radius: float = 8.0) -> Floats:
    """Return the poses (n, 3) of two laps of a circle."""
    turned = np.linspace(0, 4 * np.pi, scans, endpoint=False)
    ahead = turned + np.pi / 2
    return np.column_stack((radius * np.cos(turned), radius * np.sin(turned), ahead))


def log(reference: Floats) -> LaserLog:
    return LaserLog("circles", np.ones((len(reference), 180)), reference, reference)


@pytest.mark.long
def test_relations_are_close_in_space_and_distant_in_time() -> None:
    reference = circles()
    pairs = relations(log(reference))
    first, second = pairs.T
    assert len(pairs) == 426
    assert (second - first).min() > 30
    assert np.hypot(*(reference[first] - reference[second])[:, :2].T).max() < 3.0
    assert relations(log(circles(8000))).shape == (2000, 2)


def test_a_map_in_another_frame_has_no_error_and_a_bent_one_has() -> None:
    one = log(circles())
    pairs = relations(one)
    elsewhere = compose(np.array((5.0, -3.0, 1.0)), one.reference)
    assert errors(one, elsewhere, pairs).mean_m == pytest.approx(0.0, abs=1e-9)
    second_lap = (np.arange(120) >= 60)[:, None] * (0.3, 0.0, 0.0)
    bent = errors(one, one.reference + second_lap, pairs[pairs[:, 1] >= 60])
    assert bent.mean_m == pytest.approx(0.3, abs=0.01)
    assert bent.mean_deg == pytest.approx(0.0, abs=1e-9)


def wall_from(poses: Floats) -> LaserLog:
    """Return the log of a wall along y = 2.03 m, from `poses` (n, 3) that look along x."""
    angles = np.radians(-90.0 + np.arange(180))
    ahead = (angles > 0.3) & (angles < 1.5)
    ranges = np.where(ahead, (2.03 - poses[:, 1:2]) / np.sin(np.where(ahead, angles, 1.0)), 50.0)
    return LaserLog("wall", ranges, poses, poses)


def test_a_wall_that_is_drawn_twice_fills_twice_the_cells() -> None:
    along = np.column_stack((np.linspace(0, 20, 100), np.zeros(100), np.zeros(100)))
    one = wall_from(np.concatenate((along, along)))
    assert crispness(one, one.reference) == 1.0
    apart = one.reference + (np.arange(200) >= 100)[:, None] * (0.0, 0.5, 0.0)
    assert crispness(one, apart) == pytest.approx(2.0, abs=0.1)


def test_crispness_does_not_depend_on_the_frame_of_the_poses() -> None:
    along = np.column_stack((np.linspace(0, 20, 100), np.zeros(100), np.zeros(100)))
    one = wall_from(along)
    elsewhere = compose(np.array((5.0, -3.0, 1.0)), one.reference)
    assert crispness(one, elsewhere) == pytest.approx(1.0, abs=0.01)


def test_a_log_without_a_place_passed_twice_is_refused() -> None:
    straight = np.column_stack((np.arange(100.0), np.zeros(100), np.zeros(100)))
    with pytest.raises(ConfigError, match="circles: no place is passed twice"):
        relations(log(straight))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"ref": None}, "no ref; expected ranges, ref, odom"),
        ({"ref": np.zeros((4, 3))}, r"ref: expected poses of shape \(5, 3\)"),
        ({"odom": np.full((5, 3), np.nan)}, "odom holds data other than numbers"),
        ({"ranges": np.zeros(5, np.uint16)}, "ranges: expected whole centimetres"),
        ({"ranges": np.zeros((5, 180))}, "ranges: expected whole centimetres"),
    ],
)
def test_a_wrong_log_is_refused_in_one_line(
    tmp_path: Path, change: dict[str, Floats | None], complaint: str
) -> None:
    arrays = {
        "ranges": np.zeros((5, 180), np.uint16),
        "ref": np.zeros((5, 3)),
        "odom": np.zeros((5, 3)),
        **change,
    }
    path = tmp_path / "log.npz"
    np.savez(path, **{name: rows for name, rows in arrays.items() if rows is not None})
    with pytest.raises(ConfigError, match=complaint) as refused:
        load(path)
    assert str(refused.value).startswith(f"{path}: ")


def test_a_cut_log_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    np.savez(path, ranges=np.zeros((50, 180), np.uint16), ref=np.zeros((50, 3)))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ConfigError, match="cut or damaged: "):
        load(path)
    with pytest.raises(ConfigError, match="No such file"):
        load(tmp_path / "nope.npz")


@pytest.mark.slow
@pytest.mark.skipif(not DATA, reason="GIGABRAIN_DATA does not name the folder of laser logs")
def test_edmonton_is_mapped_within_7_cm_of_its_reference() -> None:
    recorded = load(Path(str(DATA)) / "slam" / "edmonton.npz")
    scans: list[None] = []
    result = judge_log(recorded, map_log(recorded, lambda: scans.append(None)))
    assert len(scans) == result.scans == 340
    assert result.graph.mean_m < 0.07
    assert result.graph.mean_deg < 1.0
    assert result.breaks == 0
    assert total([result]).mean_m == result.graph.mean_m


@pytest.mark.slow
@pytest.mark.skipif(not DATA, reason="GIGABRAIN_DATA does not name the folder of laser logs")
def test_freiburg_is_mapped_where_its_odometry_has_the_wrong_sign() -> None:
    """Uses every fourth scan. The robot partly drives backwards, but odometry has forwards."""
    dense = load(Path(str(DATA)) / "slam" / "freiburg-079.npz")
    thin = LaserLog("thin", *(a[:2000:4] for a in (dense.ranges, dense.reference, dense.odometry)))
    result = judge_log(thin, map_log(thin, lambda: None))
    assert result.graph.mean_m < 0.07
    assert result.breaks == 0


@pytest.mark.slow
@pytest.mark.skipif(not DATA, reason="GIGABRAIN_DATA does not name the folder of laser logs")
def test_long_corridors_do_not_cross() -> None:
    """After 600 m without a loop, the estimated pose is 16 m off."""
    recorded = load(Path(str(DATA)) / "slam" / "infinite-corridor.npz")
    result = judge_log(recorded, map_log(recorded, lambda: None))
    assert result.crispness < 1.0
    assert result.breaks == 0


@pytest.mark.slow
@pytest.mark.skipif(not DATA, reason="GIGABRAIN_DATA does not name the folder of laser logs")
def test_leaves_and_slopes_do_not_break_a_map_outdoors() -> None:
    """Scans without a match once broke it eight times, and gtsam raised an error at scan 976."""
    whole = load(Path(str(DATA)) / "slam" / "freiburg-campus.npz")
    part = LaserLog("part", *(a[:1000] for a in (whole.ranges, whole.reference, whole.odometry)))
    assert judge_log(part, map_log(part, lambda: None)).breaks == 0
