"""Reasons for the gate to stop an enabled body: silence, old data, safety, the driver."""

from typing import Literal

import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import ZERO
from tests.unit.gate.rig import BLIND, BOOT, HOT, LOST, ZONE, Rig, driving, enabled, idle, plain

MS = 1_000_000


def quiet(rig: Rig) -> None:
    """A tick in which safety is well and nobody commands."""
    rig.tick()
    rig.safety()


def test_100_ms_without_a_command_are_borne_and_no_more() -> None:
    rig = driving(0.2)
    for _ in range(5):
        quiet(rig)
        assert (rig.mode, rig.state.output) == ("enabled", Velocity(linear_x=0.2))
    quiet(rig)
    assert (rig.mode, rig.state.output) == ("stopping", Velocity(linear_x=0.16))
    assert plain(rig.state.causes) == [("silence", "no valid command for 100 ms")]


def test_a_body_that_was_just_enabled_waits_as_long_for_its_first_command() -> None:
    rig = enabled()
    for _ in range(5):
        quiet(rig)
    assert rig.mode == "enabled"
    quiet(rig)
    assert (rig.mode, rig.codes) == ("stopping", ["silence"])


def test_it_ramps_down_as_the_body_brakes_and_stays_at_zero() -> None:
    rig = driving(0.2)
    told = []
    for _ in range(5):
        quiet(rig)
    for _ in range(7):
        quiet(rig)
        told.append(rig.state.output.linear_x)
    assert told == pytest.approx([0.16, 0.12, 0.08, 0.04, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(("limit_ms", "borne"), [(250, 12), (300, 15), (299, 14), (20, 1)])
def test_sensor_data_may_be_so_old_and_no_older(limit_ms: int, borne: int) -> None:
    rig = enabled(basis_ns=limit_ms * MS)
    looked = rig.state.tick
    for _ in range(borne):
        rig.tick()
        rig.safety()
        assert rig.send(0.2, basis=rig.state.tick - looked) == gate.Outcome()
    assert rig.mode == "enabled"
    rig.tick()
    assert plain(rig.state.causes) == [("stale", "commands use sensor data that is too old")]
    assert rig.mode == "stopping"


def test_a_scan_that_is_too_old_stops_a_person_too_who_says_to_go_by_one() -> None:
    rig = enabled("alice")
    rig.send(0.2, source="alice", basis=12)
    rig.tick()
    assert (rig.mode, rig.codes) == ("stopping", ["stale"])


def test_a_command_that_rests_on_data_too_old_stops_the_body_as_it_comes() -> None:
    rig = driving(0.2)
    rig.tick()
    assert rig.send(0.2, basis=13) == gate.Outcome()
    assert (rig.mode, rig.codes) == ("stopping", ["stale"])
    assert rig.state.output == Velocity(linear_x=0.16)


def test_without_a_basis_nothing_is_too_old() -> None:
    rig = enabled("alice")
    for _ in range(30):
        quiet(rig)
        rig.send(0.2, source="alice", basis=None)
    assert rig.state.output == Velocity(linear_x=0.2)


def test_the_commander_is_judged_by_its_own_commands() -> None:
    rig = enabled("alice")
    for _ in range(6):
        quiet(rig)
        rig.send()  # as the brain
    assert (rig.mode, rig.codes) == ("stopping", ["silence"])


def test_safety_may_be_silent_for_seven_ticks_and_not_for_eight() -> None:
    rig = driving(0.2)
    for _ in range(7):
        rig.tick()
        rig.send(0.2)
    assert rig.mode == "enabled"
    rig.tick()
    assert plain(rig.state.causes) == [("safety_silent", "the safety process is silent")]
    assert (rig.mode, rig.state.output) == ("stopping", Velocity(linear_x=0.16))


def test_a_verdict_is_as_old_as_the_tick_that_it_echoes() -> None:
    rig = driving(0.2)
    for _ in range(7):
        rig.tick()
        rig.send(0.2)
    rig.safety(tick=6)
    rig.tick()
    rig.send(0.2)
    assert rig.mode == "enabled"
    rig.tick()
    assert (rig.mode, rig.codes) == ("stopping", ["safety_silent"])


@pytest.mark.parametrize(("late_ns", "mode"), [(150 * MS, "enabled"), (150 * MS + 1, "stopping")])
def test_the_hosts_clock_bounds_a_verdicts_age_as_well(late_ns: int, mode: str) -> None:
    rig = enabled()
    rig.tick(wall_ns=0)
    rig.safety()
    rig.send(0.2)
    rig.tick(wall_ns=late_ns)
    assert rig.mode == mode


@pytest.mark.parametrize("boot", [BOOT - 1, BOOT + 1, 0])
def test_a_verdict_for_another_start_of_the_driver_is_not_heard(boot: int) -> None:
    rig = enabled()
    before = rig.state
    rig.safety(BLIND, verdict="stop", boot=boot)
    assert rig.state == before


def test_a_verdict_from_the_future_is_not_heard() -> None:
    rig = enabled()
    before = rig.state
    rig.safety(BLIND, verdict="stop", tick=-1)
    assert rig.state == before


def test_a_verdict_that_was_overtaken_is_not_heard() -> None:
    rig = idle()
    before = rig.state
    rig.safety(BLIND, tick=1)
    assert rig.state == before
    rig.safety(ZONE)  # a newer one of the same tick
    assert rig.state.safety
    assert rig.state.safety.causes == (ZONE,)


def test_when_safety_says_stop_it_stops_at_once() -> None:
    rig = driving(0.2)
    rig.tick()
    rig.send(0.2)
    assert rig.state.output == Velocity(linear_x=0.2)
    rig.safety(ZONE, BLIND, verdict="stop")
    assert (rig.mode, rig.state.causes) == ("stopping", (ZONE, BLIND))
    assert rig.state.output == Velocity(linear_x=0.16)
    assert rig.state.stopped_tick == rig.state.tick


def test_a_stop_without_a_reason_is_a_stop() -> None:
    rig = driving(0.2)
    rig.safety(verdict="stop")
    assert rig.mode == "stopping"
    assert plain(rig.state.causes) == [("safety_stop", "safety stops the robot")]


@pytest.mark.parametrize("verdict", ["ok", "slow"])
def test_a_zone_alone_stops_nothing(verdict: Literal["ok", "slow"]) -> None:
    rig = driving(0.2)
    for _ in range(20):
        rig.tick()
        rig.safety(ZONE, verdict=verdict)
        rig.send(0.2)
    assert (rig.mode, rig.state.causes) == ("enabled", ())


def test_what_latches_stops_whatever_the_verdict_is_called() -> None:
    rig = driving(0.2)
    rig.safety(ZONE, HOT)
    assert (rig.mode, rig.state.causes) == ("stopping", (HOT,))
    rig.tick(20)
    assert (rig.mode, rig.state.causes) == ("latched", (HOT,))


def test_a_stop_by_safety_lets_go_by_itself_once_all_is_well() -> None:
    rig = driving(0.2)
    rig.safety(BLIND, verdict="stop")
    for _ in range(15):
        rig.tick()
        rig.safety(BLIND, verdict="stop")
        rig.send()
    assert (rig.mode, rig.codes) == ("idle", ["scan_blind"])
    rig.live(2)
    assert (rig.mode, rig.codes) == ("idle", [])
    assert rig.feed(gate.Enable("control")).ok


def test_what_the_driver_finds_wrong_stops_it() -> None:
    rig = driving(0.2)
    rig.tick(faults=(LOST,))
    assert (rig.mode, rig.state.causes) == ("stopping", (LOST,))
    assert rig.state.output == Velocity(linear_x=0.16)


def test_all_that_is_wrong_is_reported() -> None:
    rig = driving(0.2)
    rig.tick(5)
    rig.send(0.2)
    rig.tick(2)
    rig.send(0.2, basis=12)
    assert rig.mode == "enabled"
    rig.tick(faults=(LOST,))
    assert rig.codes == ["link_lost", "safety_silent", "stale"]


def test_a_driver_that_was_held_up_stops_the_body_when_it_goes_on() -> None:
    rig = driving(0.2)
    rig.tick(100)
    assert (rig.mode, rig.state.output) == ("idle", ZERO)


def test_ticks_that_are_made_up_for_do_not_speed_the_body_up() -> None:
    rig = driving(0.1)
    rig.tick(4, late=True)
    assert rig.state.output == Velocity(linear_x=0.1)
    rig.safety()
    rig.send(0.2)
    assert rig.state.output == Velocity(linear_x=0.1)  # this tick is still a late one
    rig.tick()
    assert rig.state.output.linear_x == pytest.approx(0.12)


def test_ticks_that_are_made_up_for_do_not_turn_the_body_round() -> None:
    rig = driving(0.2)
    rig.tick()
    rig.send(-0.2)
    assert rig.state.output.linear_x == pytest.approx(0.16)
    rig.tick(3, late=True)
    assert (rig.mode, rig.state.output.linear_x) == ("enabled", pytest.approx(0.16))
    rig.safety()
    rig.tick()
    assert rig.state.output.linear_x == pytest.approx(0.12)


def test_a_stop_takes_the_steps_that_it_has_missed() -> None:
    rig = driving(0.2)
    rig.send(0.0)
    rig.tick(2, late=True)
    assert rig.state.output.linear_x == pytest.approx(0.08)
    rig = driving(0.2)
    rig.tick(faults=(LOST,))
    rig.tick(4, late=True)
    assert (rig.mode, rig.state.output) == ("stopping", ZERO)
