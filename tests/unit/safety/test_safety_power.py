"""Battery and motors: low charge, heat, sags and missing values."""

import pytest

from gigabrain_schemas.body import Battery, Joint
from tests.unit.safety.patrol import Patrol


def charge(percentage: float, voltage: float = 11.0) -> Battery:
    return Battery(voltage=voltage, percentage=percentage)


def motors(*degrees: float | None) -> tuple[Joint, ...]:
    return tuple(
        Joint(name=f"motor_{i}", position=0.0, temperature=t) for i, t in enumerate(degrees)
    )


@pytest.mark.parametrize(
    ("percentage", "warned"),
    [
        (16.0, []),
        (15.0, ["battery_low"]),
        (8.0, ["battery_low"]),
        (7.0, ["battery_return"]),
        (6.0, ["battery_return"]),
    ],
)
def test_a_low_battery_is_a_warning_after_two_seconds(percentage: float, warned: list[str]) -> None:
    patrol = Patrol()
    patrol.go(99, battery=charge(percentage))
    assert patrol.warnings == []
    patrol.go(battery=charge(percentage))
    assert (patrol.warnings, patrol.codes) == (warned, [])


@pytest.mark.parametrize(("percentage", "stopped"), [(6.0, []), (5.0, ["battery_empty"])])
def test_an_empty_battery_stops_the_body_after_two_seconds(
    percentage: float, stopped: list[str]
) -> None:
    patrol = Patrol()
    assert patrol.go(99, battery=charge(percentage)) == []
    assert patrol.go(battery=charge(percentage)) == stopped
    assert [cause.latching for cause in patrol.verdict.causes] == [True] * len(stopped)


@pytest.mark.parametrize("ticks", [10, 12])
def test_short_sags_of_a_starting_motor_are_ignored(ticks: int) -> None:
    patrol = Patrol()
    for _ in range(20):
        assert patrol.go(ticks, battery=charge(1.0, 6.0)) == []
        assert patrol.go(25 - ticks, battery=charge(60.0)) == []
        assert patrol.warnings == []


def test_a_sag_of_less_than_two_seconds_is_ignored() -> None:
    patrol = Patrol()
    patrol.go(50, battery=charge(60.0))
    assert patrol.go(110, battery=charge(1.0)) == []
    assert patrol.go(50, battery=charge(60.0)) == []
    assert patrol.warnings == []


def test_spikes_upwards_do_not_hide_an_empty_battery() -> None:
    patrol = Patrol()
    for _ in range(12):
        patrol.go(15, battery=charge(3.0))
        patrol.go(5, battery=charge(40.0))
    assert "battery_empty" in patrol.codes


def test_a_battery_near_a_threshold_does_not_flicker() -> None:
    patrol = Patrol()
    patrol.go(100, battery=charge(15.0))
    patrol.go(300, battery=charge(16.5))
    assert patrol.warnings == ["battery_low"]
    patrol.go(300, battery=charge(17.5))
    assert patrol.warnings == []


def test_a_battery_that_is_no_longer_measured_stops_the_body_after_two_seconds() -> None:
    patrol = Patrol()
    patrol.go(5, battery=charge(60.0))
    assert patrol.go(99) == []
    assert patrol.go() == ["battery_unknown"]
    assert patrol.go(battery=charge(60.0)) == []


def test_a_battery_that_loses_its_voltage_counts_as_not_measured() -> None:
    patrol = Patrol()
    patrol.go(5, battery=charge(60.0))
    assert patrol.go(100, battery=charge(60.0, voltage=0.0)) == ["battery_unknown"]
    other = Patrol()  # it reports percentages only
    assert other.go(200, battery=charge(60.0, voltage=0.0)) == []


@pytest.mark.parametrize(("degrees", "warned"), [(59.0, []), (60.0, ["motor_warm"])])
def test_a_warm_motor_is_a_warning_after_half_a_second(degrees: float, warned: list[str]) -> None:
    patrol = Patrol()
    patrol.go(24, joints=motors(30.0, degrees))
    assert patrol.warnings == []
    patrol.go(joints=motors(30.0, degrees))
    assert patrol.warnings == warned
    if warned:
        assert patrol.verdict.warnings[0].text == "motor_1 has 60 °C"


@pytest.mark.parametrize(("degrees", "stopped"), [(69.0, []), (70.0, ["motor_hot"])])
def test_a_hot_motor_stops_the_body_after_half_a_second(degrees: float, stopped: list[str]) -> None:
    patrol = Patrol()
    assert patrol.go(24, joints=motors(degrees)) == []
    assert patrol.go(joints=motors(degrees)) == stopped
    assert [cause.latching for cause in patrol.verdict.causes] == [True] * len(stopped)


def test_a_spike_of_temperature_is_ignored() -> None:
    patrol = Patrol()
    for _ in range(10):
        assert patrol.go(10, joints=motors(80.0)) == []
        patrol.go(joints=motors(30.0))


@pytest.mark.parametrize("reading", [None, -60.0, 400.0])
def test_a_motor_without_plausible_temperatures_stops_the_body(reading: float | None) -> None:
    patrol = Patrol()
    patrol.go(5, joints=motors(30.0, 30.0))
    assert patrol.go(99, joints=motors(30.0, reading)) == []
    assert patrol.go(joints=motors(30.0, reading)) == ["motor_unknown"]


def test_a_body_without_battery_and_temperatures_is_not_stopped() -> None:
    patrol = Patrol()
    assert patrol.go(300, joints=motors(None)) == []
    assert patrol.verdict.verdict == "ok"


def test_one_state_after_a_long_gap_does_not_count_for_the_whole_gap() -> None:
    patrol = Patrol()
    patrol.go(joints=motors(30.0))
    patrol.tick += 1000
    patrol.tick -= patrol.tick % 5 + 1
    assert "motor_hot" not in patrol.go(joints=motors(90.0))


def test_a_value_in_a_single_state_does_not_count_as_measured() -> None:
    patrol = Patrol()
    patrol.go(10, joints=motors(None))
    for _ in range(3):
        patrol.go(joints=motors(30.0), battery=charge(60.0))
        assert patrol.go(200, joints=motors(None)) == []
