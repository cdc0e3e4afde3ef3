"""Mapping while driving: loop closures, drift, breaks, and continuing after a restart."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import IDENTITY, between, compose
from gigabrain_zenoh.mapping.front_end import MIN_POINTS
from gigabrain_zenoh.mapping.keyframes import Scan
from gigabrain_zenoh.mapping.slam import Estimate, Slam
from tests.unit.mapping.rooms import Lidar, Walls, box, dead_reckoned, drifting, line

# a corridor around a block, with pillars on both sides so that no two parts are similar
BLOCK = np.array(
    [
        *box(-1, -1, 12, 10), *box(1, 1, 8, 6),
        *box(2.3, -1, 0.3, 0.4), *box(6.1, 0.7, 0.5, 0.3), *box(10.6, 2.2, 0.4, 0.3),
        *box(8.7, 4.9, 0.3, 0.5), *box(7.2, 8.5, 0.4, 0.5), *box(3.4, 7.0, 0.6, 0.2),
        *box(-1, 5.2, 0.3, 0.6), *box(0.8, 2.9, 0.2, 0.4),
    ]
)  # fmt: skip

NOISE = np.diag((0.003, 0.003, 0.001)) ** 2  # covariance of good odometry from scan to scan


def lap() -> Floats:
    """Poses once around the block and a bit farther; the robot faces its direction of travel."""
    corners = np.array([(0, 0), (10, 0), (10, 8), (0, 8), (0, 0), (4, 0)], float)
    legs = []
    for start, end in pairwise(corners):
        yaw = np.arctan2(*(end - start)[::-1])
        legs.append(line(np.append(start, yaw), np.append(end, yaw), 0.25))
    return np.concatenate(legs)


def feed(slam: Slam, scans: list[Scan], steps: Floats) -> list[Estimate]:
    """Add each scan after its odometry step, and close loops after each."""
    estimates = []
    for scan, step in zip(scans, steps, strict=True):
        estimates.append(slam.add(scan, step))
        close(slam)
    return estimates


def close(slam: Slam) -> None:
    while slam.behind:
        correction = slam.close_loops()
        if correction:
            slam.apply(correction)


def look(walls: Walls, poses: Floats, lidar: Lidar) -> list[Scan]:
    return [lidar.scan(walls, pose) for pose in poses]


def stepped(poses: Floats, turn: float, scale: float) -> Floats:
    return np.concatenate((IDENTITY[None], drifting(poses, turn, scale)))


@dataclass(frozen=True)
class Drive:
    """A lap as measured by the lidar and by bad odometry."""

    poses: Floats
    scans: list[Scan]
    steps: Floats


@pytest.fixture(scope="module")
def drive() -> Drive:
    poses = lap()
    scans = look(BLOCK, poses, Lidar(180, reach=6.0))
    return Drive(poses, scans, stepped(poses, turn=0.02, scale=1.05))


@pytest.fixture(scope="module")
def mapped(drive: Drive) -> tuple[Slam, list[Estimate]]:
    slam = Slam()
    return slam, feed(slam, drive.scans, drive.steps)


def test_a_loop_closure_corrects_the_drift_of_the_odometry(
    drive: Drive, mapped: tuple[Slam, list[Estimate]]
) -> None:
    slam, estimates = mapped
    reckoned = dead_reckoned(drive.poses[0], drive.steps)
    assert np.hypot(*(reckoned - drive.poses[-1])[:2]) > 2.0
    corrected = [compose(slam.poses[e.keyframe], e.relative) for e in estimates]
    assert np.hypot(*(np.array(corrected) - drive.poses)[:, :2].T).max() < 0.10
    assert np.degrees(np.abs(estimates[-1].pose - drive.poses[-1])[2]) < 0.5
    assert slam.revision > 0
    assert {e.kind for e in estimates} == {"matched"}
    assert not estimates[-1].lost


def test_matches_and_map_do_not_depend_on_when_loops_are_closed(
    drive: Drive, mapped: tuple[Slam, list[Estimate]]
) -> None:
    at_once, _ = mapped
    later = Slam()
    for scan, step in zip(drive.scans, drive.steps, strict=True):
        later.add(scan, step)
    close(later)
    assert later.smooth.tolist() == at_once.smooth.tolist()
    assert later.poses.tolist() == at_once.poses.tolist()


def test_a_correction_also_moves_the_keyframes_added_since(drive: Drive) -> None:
    slam = Slam()
    correction = None
    for scan, step in zip(drive.scans, drive.steps, strict=True):
        slam.add(scan, step)
        while slam.behind and correction is None:
            correction = slam.close_loops()
    assert correction is not None
    known, before = len(correction.poses), slam.poses
    assert len(before) > known
    seen = between(before[-1], slam.pose)
    slam.apply(correction)
    assert slam.poses[:known].tolist() == correction.poses.tolist()
    assert between(slam.poses[known - 1], slam.poses[-1]) == pytest.approx(
        between(before[known - 1], before[-1]), abs=1e-9
    )
    assert slam.poses[-1] != pytest.approx(before[-1], abs=1e-3)
    assert between(slam.poses[-1], slam.pose) == pytest.approx(seen, abs=1e-9)


@pytest.mark.parametrize(("reach", "uprights"), [(1.5, 0), (2.5, 8)])
def test_an_aisle_is_not_confused_with_a_similar_one(reach: float, uprights: int) -> None:
    racks = [wall for k in range(3) for wall in box(1.6 * k, 0, 0.4, 8)]
    for k in range(uprights):
        racks += [wall for x in (0.4, 1.5, 2.0, 3.1) for wall in box(x, k + 0.3, 0.1, 0.1)]
    lidar = Lidar(180, reach)
    up = line(np.array((1.0, -1.0, 0.0)), np.array((1.0, 9.0, 0.0)), 0.1)
    over = line(up[-1], np.array((2.6, 9.0, 0.0)), 0.1)
    down = line(over[-1], np.array((2.6, 0.5, 0.0)), 0.1)
    poses = np.concatenate((up, over, down))
    scans = look(np.array(racks), poses, lidar)
    slam = Slam(pose=poses[0])
    estimates = feed(slam, scans, stepped(poses, turn=0.002, scale=1.0))
    assert estimates[-1].pose == pytest.approx(poses[-1], abs=0.3)


def passed_by(noise: Floats | None) -> float:
    """Return the error [m] along a bare aisle while a crate moves beside the robot; + is ahead."""
    poses = line(np.array((0.0, 0.0, 0.0)), np.array((2.0, 0.0, 0.0)), 0.025)
    lidar, slam = Lidar(180, reach=4.0), Slam()
    steps = stepped(poses, 0.0, 1.0)
    for at, (pose, step) in enumerate(zip(poses, steps, strict=True)):
        aisle = np.array([*box(-20, -0.8, 40, 1.6), *box(1.0 + 0.008 * at, 0.3, 0.4, 0.3)])
        found = slam.add(lidar.scan(aisle, pose), step, noise)
    return float(found.pose[0] - poses[-1, 0])


def test_good_odometry_keeps_the_position_in_an_aisle_with_only_moving_landmarks() -> None:
    assert abs(passed_by(NOISE)) < 0.06
    assert abs(passed_by(None)) > 0.2


def test_wheel_slip_is_corrected_even_if_odometry_reports_low_noise() -> None:
    lidar, slam = Lidar(180, reach=6.0), Slam()
    for _ in range(20):
        found = slam.add(lidar.scan(BLOCK, IDENTITY), np.array((0.03, 0.0, 0.0)), NOISE)
    assert found.pose == pytest.approx(IDENTITY, abs=0.05)


@pytest.mark.parametrize("turn", [0.1, 0.15, 0.2])
def test_similar_doors_are_not_confused_if_little_of_a_scan_is_known(
    turn: float,
) -> None:
    # backwards, 2 m per scan, with a lidar that faces ahead; odometry overestimates each turn
    doors: list[tuple[float, float, float, float]] = []
    for x, y, deep in [(2.0 * k + off, y, 1.35 * y) for k in range(18)
                       for off, y in ((-4.0, 1.0), (-3.4, -1.0))]:  # fmt: skip
        doors += [(x, y, x, deep), (x, deep, x + 0.9, deep), (x + 0.9, deep, x + 0.9, y)]
        doors += [(x + 0.9, y, x + 2.0, y)]
    lidar = Lidar(180, reach=25.0)
    lidar.angles = lidar.angles / 2 - np.pi / 2
    poses = line(np.array((28.0, 0.0, 0.0)), np.array((4.0, 0.0, 0.0)), 2.0)
    poses[:, 2] = 0.0
    steps = [IDENTITY] + [np.array((-2.0, -0.1, turn))] * (len(poses) - 1)
    slam = Slam(pose=poses[0])
    estimates = feed(slam, look(np.array(doors), poses, lidar), np.array(steps))
    assert {estimate.kind for estimate in estimates} == {"matched"}
    assert estimates[-1].pose == pytest.approx(poses[-1], abs=0.1)  # the next door is 2 m away


def test_a_slow_robot_keeps_one_scan_in_ten() -> None:
    poses = line(np.array((0.0, 0.0, 0.0)), np.array((8.0, 0.0, 0.0)), 0.02)
    slam = Slam()
    estimates = feed(slam, look(BLOCK, poses, Lidar(180)), stepped(poses, 0.0, 1.0))
    assert 35 <= len(slam.keyframes) <= 40
    assert estimates[-1].pose == pytest.approx(poses[-1], abs=0.03)


def test_noise_on_two_walls_does_not_turn_the_robot() -> None:
    corridor = np.array([(-40.0, 1.0, 140.0, 1.0), (-40.0, -1.0, 140.0, -1.0)])
    poses = line(np.zeros(3), np.array((100.0, 0.0, 0.0)), 0.5)
    turns = []
    for seed in range(2):
        lidar = Lidar(180, reach=25.0, noise=0.02, seed=seed)
        lidar.angles = lidar.angles / 2 - np.pi / 2  # ahead
        slam = Slam()
        feed(slam, look(corridor, poses, lidar), stepped(poses, 0.0, 1.0))
        turns.append(np.degrees(slam.smooth[2]))
    assert np.abs(turns) == pytest.approx(
        0.0, abs=1.5
    )  # a robot that is turned: 5 degrees and more


def test_a_robot_that_is_carried_away_is_lost_until_it_is_relocated() -> None:
    poses = lap()[:60]
    lidar = Lidar(180, reach=6.0)
    slam = Slam()
    feed(slam, look(BLOCK, poses, lidar), stepped(poses, 0.0, 1.0))
    hall = np.array([*box(47, 46, 7, 12), *box(48, 49, 1.0, 0.5), *box(52.3, 53, 0.5, 1.5)])
    elsewhere = line(np.array((50.0, 50.0, 0.4)), np.array((51.0, 50.5, 0.4)), 0.05)
    carried = feed(slam, look(hall, elsewhere, lidar), stepped(elsewhere, 0.0, 1.0))
    kinds = [estimate.kind for estimate in carried]
    assert kinds[0] == "odometry"
    assert kinds.count("broken") == 1
    assert carried[-1].lost
    home = poses[20]
    slam.relocate(np.add(home, (0.1, -0.05, 0.03)))
    found = slam.add(lidar.scan(BLOCK, home), IDENTITY)
    assert (found.kind, found.lost) == ("matched", False)
    assert found.pose == pytest.approx(home, abs=0.03)


def test_scans_that_do_not_fit_each_other_do_not_break_the_map() -> None:
    poses = lap()[:40]
    random = np.random.default_rng(4)
    scans = look(BLOCK, poses, Lidar(180, reach=6.0))
    for at in range(20, 25):  # leaves in the wind
        away, bearing = random.uniform(1, 6, 150), np.sort(random.uniform(-np.pi, np.pi, 150))
        scans[at] = Scan.of(np.column_stack((away * np.cos(bearing), away * np.sin(bearing))))
    slam = Slam()
    estimates = feed(slam, scans, stepped(poses, 0.0, 1.0))
    assert {estimate.kind for estimate in estimates[20:25]} == {"odometry"}
    assert not any(estimate.lost for estimate in estimates)
    assert estimates[-1].pose == pytest.approx(poses[-1], abs=0.05)


def test_a_jump_of_the_odometry_is_corrected_by_the_scan() -> None:
    poses = lap()[:30]
    lidar = Lidar(180, reach=6.0)
    slam = Slam()
    feed(slam, look(BLOCK, poses, lidar), stepped(poses, 0.0, 1.0))
    jumped = slam.add(lidar.scan(BLOCK, poses[-1]), np.array((7.0, 3.0, 2.0)))
    assert jumped.kind == "recovered"
    assert jumped.pose == pytest.approx(poses[-1], abs=0.03)
    with pytest.raises(ValueError, match="odometry: expected finite numbers"):
        slam.add(lidar.scan(BLOCK, poses[-1]), np.array((np.nan, 0.0, 0.0)))


def test_without_hits_the_odometry_is_used_and_the_covariance_grows() -> None:
    poses = line(np.array((0.0, 0.0, 0.0)), np.array((4.0, 0.0, 0.0)), 0.1)
    lidar = Lidar(180)
    slam = Slam()
    feed(slam, look(BLOCK, poses[:5], lidar), stepped(poses[:5], 0.0, 1.0))
    few = Scan.of(np.ones((MIN_POINTS - 1, 2)))
    blind = feed(slam, [few] * 30, np.tile((0.1, 0.0, 0.0), (30, 1)))
    assert {estimate.kind for estimate in blind} == {"odometry"}
    assert blind[-1].pose == pytest.approx((3.4, 0.0, 0.0), abs=0.02)
    assert blind[-1].covariance[0, 0] > 10 * blind[0].covariance[0, 0]


def test_a_thawed_map_continues_like_one_that_was_never_frozen(
    drive: Drive, mapped: tuple[Slam, list[Estimate]]
) -> None:
    whole, _ = mapped
    half = len(drive.poses) // 2
    begun = Slam()
    feed(begun, drive.scans[:half], drive.steps[:half])
    thawed = Slam.thaw(begun.freeze())
    assert thawed.poses.tolist() == begun.poses.tolist()
    feed(thawed, drive.scans[half:], drive.steps[half:])
    assert thawed.poses == pytest.approx(whole.poses, abs=0.01)
    again = Slam.thaw(whole.freeze())
    assert again.poses.tolist() == whole.poses.tolist()
    assert again.behind == 0


def test_inconsistent_arrays_are_refused() -> None:
    slam = Slam()
    feed(slam, look(BLOCK, lap()[:6], Lidar(90)), stepped(lap()[:6], 0.0, 1.0))
    frozen = slam.freeze()
    with pytest.raises(ValueError, match="6 keyframes, but 5 poses"):
        Slam.thaw({**frozen, "poses": frozen["poses"][:-1]})
    with pytest.raises(ValueError, match="points, got"):
        Slam.thaw({**frozen, "points": frozen["points"][:-1]})
    with pytest.raises(ValueError, match="link: joins keyframes that do not exist, of 6"):
        Slam.thaw({**frozen, "link_ends": frozen["link_ends"] - 1})
    with pytest.raises(ValueError, match="link: expected positive definite covariances"):
        Slam.thaw({**frozen, "link_covariance": np.zeros((6, 3, 3))})
    with pytest.raises(ValueError, match="front of shape"):
        Slam.thaw({**frozen, "front": np.zeros(2)})
    with pytest.raises(KeyError):
        Slam.thaw({name: rows for name, rows in frozen.items() if name != "travel"})
