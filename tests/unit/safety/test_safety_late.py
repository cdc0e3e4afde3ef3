"""Late data are reported, and slow or stop the body within a second, on a fake clock."""

import random

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus, Thresholds
from gigabrain_zenoh.geometry.limits import clamp, limits_of
from gigabrain_zenoh.testing.samples import DRIVING
from tests.unit.safety.patrol import BODY, Patrol

REST = Velocity()
STOPPING = GateStatus(mode="stopping", commander="control")
QUICK = replace(BODY, thresholds=Thresholds(reaction_time=0.22, response=0.06))
STEP, TURN_STEP = 0.02, 0.06  # of speed in a tick


class Follower(Patrol):
    """A body that follows commands `delay` ticks late, with some noise."""

    def __init__(self, delay: int = 3) -> None:
        super().__init__(QUICK)
        self.delay, self.noise = delay, 0.004
        self.commanded = [REST] * 100
        self.go(40)
        self.chance = random.Random(1)

    def drive(
        self, ticks: int, to: Velocity, gate: GateStatus = DRIVING, age_ms: float = 10.0
    ) -> list[str]:
        """Ramp to a speed and keep it; return the codes of all causes."""
        found: list[str] = []
        for _ in range(ticks):
            now, to = self.commanded[-1], clamp(to, limits_of(QUICK), self.verdict.caps)
            commanded = Velocity(
                linear_x=_towards(now.linear_x, to.linear_x, STEP),
                angular_z=_towards(now.angular_z, to.angular_z, TURN_STEP),
            )
            self.commanded.append(commanded)
            then = self.commanded[-1 - self.delay]
            moves = Velocity(
                linear_x=then.linear_x + self.chance.gauss(0.0, self.noise),
                angular_z=then.angular_z + self.chance.gauss(0.0, 4 * self.noise),
            )
            found += self.go(commanded=commanded, moves=moves, gate=gate, age_ms=age_ms)
        return list(dict.fromkeys(found))

    @property
    def texts(self) -> list[str]:
        return [cause.text for cause in self.verdict.causes]


def _towards(now: float, to: float, step: float) -> float:
    return max(now - step, min(now + step, to))


FAST, TURN = Velocity(linear_x=0.26), Velocity(linear_x=0.1, angular_z=1.0)


def test_a_lidar_with_stamps_100_ms_late_halves_the_speed() -> None:
    patrol = Patrol(QUICK)
    patrol.go(50)
    assert patrol.ticks_until("lidar_late", 50, scan_late_ms=100.0) == 10
    assert patrol.verdict.verdict == "slow"
    assert patrol.verdict.caps.forward == 0.13
    text = "the lidar's data are late, by 100 ms; half speed"
    assert [cause.text for cause in patrol.verdict.causes] == [text]
    assert patrol.go() == []


def test_a_body_with_stamps_100_ms_late_halves_the_speed() -> None:
    patrol = Patrol(QUICK)
    patrol.go(50)
    assert patrol.ticks_until("body_late", 50, late_ms=100.0) == 10
    assert patrol.verdict.caps.rotation == 0.91
    assert patrol.go() == []


@pytest.mark.parametrize("which", ["late_ms", "scan_late_ms"])
def test_data_later_than_the_reaction_time_stop_the_body(which: str) -> None:
    patrol = Patrol(QUICK)
    patrol.go(50)
    patrol.go(9, **{which: 240.0})  # type: ignore[arg-type]
    assert patrol.verdict.verdict == "ok"
    patrol.go(1, **{which: 240.0})  # type: ignore[arg-type]
    assert patrol.verdict.verdict == "stop"
    assert not patrol.verdict.causes[0].latching


def test_the_delay_of_a_busy_machine_is_no_cause() -> None:
    patrol = Patrol(QUICK)
    assert patrol.go(100, late_ms=40.0, scan_late_ms=40.0) == []


def test_without_stamps_a_line_100_ms_late_is_found_within_a_second_of_motion() -> None:
    for to in (FAST, TURN):
        body = Follower(delay=8)
        assert body.drive(50, to) == ["body_late"]
        assert body.texts == ["the body's data are late, by 100 ms; half speed"]


def test_a_line_that_becomes_late_is_found_within_a_second_of_a_change_of_speed() -> None:
    body = Follower()
    assert body.drive(100, FAST) == []
    body.delay = 8
    assert body.drive(100, FAST) == []  # a constant speed shows no delay
    assert body.drive(50, TURN) == ["body_late"]
    body.delay = 3
    body.drive(50, FAST)
    assert body.drive(50, TURN) == []


def test_at_constant_speed_a_silence_casts_doubt() -> None:
    body = Follower()
    assert body.drive(100, FAST) == []
    for age_ms in (30.0, 50.0, 70.0, 90.0):
        body.drive(1, FAST, age_ms=age_ms)
    assert body.texts == ["the body was silent for 90 ms, and may be late; half speed"]
    body.delay = 8
    assert body.drive(50, FAST) == ["body_late"]
    assert body.texts == ["the body's data are late, by 100 ms; half speed"]


def test_speeds_measured_before_a_silence_are_forgotten() -> None:
    body = Follower()
    body.drive(60, REST)
    assert body.drive(25, FAST) == []
    for age_ms in (30.0, 50.0, 70.0, 90.0):
        body.drive(1, FAST, age_ms=age_ms)
    body.delay = 8
    for _ in range(100):
        assert body.drive(1, FAST) == ["body_late"]
    assert body.texts == ["the body's data are late, by 100 ms; half speed"]


def test_the_doubt_about_a_body_below_half_speed_lasts_5_s() -> None:
    body, slow = Follower(), Velocity(linear_x=0.1)
    assert body.drive(100, slow) == []
    body.drive(1, slow, age_ms=90.0)
    assert body.drive(249, slow) == ["body_late"]
    assert body.drive(100, slow) == []


def test_the_silence_of_a_body_with_a_clock_casts_no_doubt() -> None:
    patrol = Patrol(QUICK)
    patrol.go(50)
    assert patrol.go(1, age_ms=90.0, late_ms=0.0) == []
    assert patrol.go(1, age_ms=90.0) == ["body_late"]


def test_the_doubt_ends_once_the_speeds_show_no_delay() -> None:
    body = Follower()
    assert body.drive(100, FAST) == []
    for age_ms in (30.0, 50.0, 70.0, 90.0):
        body.drive(1, FAST, age_ms=age_ms)
    assert body.drive(50, FAST) == ["body_late"]
    assert body.drive(100, FAST) == []


def test_jitter_of_a_line_casts_no_doubt() -> None:
    body, chance = Follower(), random.Random(4)
    assert body.drive(100, FAST) == []
    for _ in range(200):
        assert body.drive(1, FAST, age_ms=chance.uniform(0.0, 60.0)) == []


@pytest.mark.long
@pytest.mark.parametrize("changes", [25, pytest.param(100, marks=pytest.mark.qa)])
@pytest.mark.parametrize("delay", [0, 1, 3, 5])
def test_a_body_with_a_normal_delay_is_not_late(delay: int, changes: int) -> None:
    body, chance = Follower(delay), random.Random(2)
    for _ in range(changes):
        to = Velocity(linear_x=chance.uniform(-0.26, 0.26), angular_z=chance.uniform(-1.0, 1.0))
        body.delay = max(0, delay - chance.randint(0, 1))
        assert body.drive(chance.randint(5, 80), to) == []


def test_the_delay_is_forgotten_at_rest() -> None:
    body = Follower(delay=8)
    assert body.drive(50, FAST) == ["body_late"]
    body.drive(50, REST)
    assert "body_late" in body.codes
    body.delay = 3
    body.drive(60, REST)
    assert body.codes == []


@pytest.mark.long
@pytest.mark.parametrize("delay", [10, 15, 20, 25])
def test_a_late_line_causes_no_runaway(delay: int) -> None:
    """After a stop from full speed, late states still report motion."""
    body = Follower(delay)
    for _ in range(5):
        found = body.drive(60, Velocity(linear_x=0.26))
        found += body.drive(80, REST, gate=STOPPING)
        assert "body_late" in found
        assert not {"runaway", "not_following"} & set(found)
