"""The control lease of a script, updated with each robot state."""

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import GateMode, GateStatus, RobotState
from gigabrain_zenoh.client.lease import ControlLease


def state(
    mode: GateMode,
    commander: str = "",
    enables: int = 1,
    boot: int = 7,
    tick: int = 0,
    latches: int = 0,
) -> RobotState:
    return RobotState(
        boot=boot,
        tick=tick,
        robot_type="waffle",
        pose=Pose(x=0.0, y=0.0, yaw=0.0),
        velocity=Velocity(),
        gate=GateStatus(mode=mode, commander=commander, enables=enables, latches=latches),
    )


def granted() -> ControlLease:
    lease = ControlLease("script")
    lease.granted(7, GateStatus(mode="enabled", commander="script", enables=4))
    return lease


def after(*states: RobotState) -> tuple[bool, bool]:
    """(has, lost) of a script that was granted the body and then sees `states`."""
    lease = granted()
    for each in states:
        lease.update(each)
    return lease.has(states[-1]), lease.lost


def test_before_it_asks_it_has_nothing_and_loses_nothing() -> None:
    lease = ControlLease("script")
    lease.update(state("enabled", "control"))
    lease.update(state("latched"))
    assert (lease.has(state("enabled", "control")), lease.lost) == (False, False)


def test_states_from_before_the_answer_say_nothing() -> None:
    assert after(state("enabled", "control", 3)) == (True, False)
    assert after(state("latched", "", 3)) == (True, False)


def test_it_has_the_body_while_the_gate_names_it() -> None:
    assert after(state("enabled", "script", 4)) == (True, False)


def test_a_stop_that_passes_does_not_lose_it_even_when_the_brain_has_gone_on() -> None:
    stopped = (state("stopping", "script", 4), state("idle", "", 4))
    assert after(*stopped) == (False, False)
    assert after(*stopped, state("enabled", "control", 5)) == (False, False)


def test_somebody_who_takes_it_over_has_it_for_good() -> None:
    taken = (state("enabled", "script", 4), state("enabled", "person", 5))
    assert after(*taken) == (False, True)
    assert after(*taken, state("idle", "", 5), state("enabled", "control", 6)) == (False, True)


def test_nobody_but_the_brain_goes_on_meanwhile_without_having_it_for_good() -> None:
    stopped = (state("stopping", "script", 4), state("idle", "", 4))
    assert after(*stopped, state("enabled", "other script", 5)) == (False, True)
    mine = state("enabled", "script", 4, tick=100)
    assert after(mine, state("enabled", "other script", 5, tick=2000)) == (False, True)


def test_a_latch_loses_it_until_it_asks_anew() -> None:
    lease = granted()
    for each in (state("latched", "", 4), state("idle", "", 4)):
        lease.update(each)
    assert lease.lost
    lease.granted(7, GateStatus(mode="enabled", commander="script", enables=5))
    lease.update(state("idle", "", 4))
    assert (lease.lost, lease.has(state("idle", "", 4))) == (False, True)
    assert not lease.has(state("enabled", "control", 6))


def test_another_start_of_the_driver_loses_it_until_it_asks_anew() -> None:
    assert after(state("idle", "", 0, boot=8)) == (False, True)
    assert after(state("enabled", "script", 1, boot=8)) == (False, True)


def test_a_script_that_was_stopped_for_a_while_may_ask_for_the_body_again() -> None:
    mine = state("enabled", "script", 4, tick=100)
    assert after(mine, state("enabled", "control", 5, tick=110)) == (False, True)
    assert after(mine, state("enabled", "control", 5, tick=2000)) == (False, False)


def test_a_latch_that_it_missed_meanwhile_loses_it() -> None:
    mine = state("enabled", "script", 4, tick=100)
    latched = state("enabled", "control", 5, tick=2000, latches=1)
    assert after(mine, latched) == (False, True)
    assert after(mine, latched, state("idle", "", 5, tick=2001, latches=1)) == (False, True)
