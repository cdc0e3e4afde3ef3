"""Stopping of the gate: duration, remembered causes, latching and the e-stop."""

from collections.abc import Callable
from typing import Literal

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import ZERO
from tests.unit.gate.rig import BLIND, CRASHED, HOT, LOST, Rig, driving, enabled, idle


def test_it_stops_for_300_ms_and_is_idle_then() -> None:
    rig = enabled()
    rig.live(1)
    assert rig.until("stopping", rig.tick) == 6
    assert rig.until("idle", rig.tick) == 15
    assert (rig.state.commander, rig.codes) == ("", ["safety_silent", "silence", "stale"])


def test_a_body_that_needs_longer_than_300_ms_is_not_cut_short() -> None:
    rig = enabled()
    rig.live(40, angular_z=1.8)  # 30 ticks to stop from there
    rig.tick()
    rig.until("stopping", rig.tick)
    assert rig.state.output.angular_z == pytest.approx(1.74)
    assert rig.until("idle", rig.tick) == 30
    assert rig.state.output == ZERO


def test_it_does_not_go_back_from_stopping_to_enabled() -> None:
    rig = driving()
    rig.until("stopping", rig.tick)
    rig.live(14, 0.2)
    assert (rig.mode, rig.state.output) == ("stopping", ZERO)
    rig.live(1, 0.2)
    assert (rig.mode, rig.state.causes) == ("idle", ())
    rig.live(100, 0.2)
    assert (rig.mode, rig.state.output) == ("idle", ZERO)


def test_what_latches_while_it_stops_is_kept_until_a_release() -> None:
    rig = driving()
    rig.until("stopping", rig.tick)
    rig.tick(faults=(CRASHED,))
    assert rig.codes == ["silence", "collision"]
    rig.live(13)
    assert rig.codes == ["silence", "collision"]
    rig.live(1)
    assert (rig.mode, rig.state.causes) == ("latched", (CRASHED,))
    rig.live(100)
    assert (rig.mode, rig.state.causes) == ("latched", (CRASHED,))


def test_each_latch_counts_once() -> None:
    rig = driving()
    booted = rig.state.latches
    rig.tick(faults=(CRASHED,))
    rig.live(20)
    rig.live(20)
    assert (rig.mode, rig.state.latches) == ("latched", booted + 1)


def test_a_cause_that_comes_to_latch_is_not_taken_for_the_one_that_did_not() -> None:
    rig = driving()
    rig.tick(faults=(Cause(code="collision", text="a bump"),))
    assert (rig.mode, rig.codes) == ("stopping", ["collision"])
    rig.tick(faults=(CRASHED,))
    rig.live(20)
    assert (rig.mode, rig.state.causes) == ("latched", (CRASHED,))


def test_an_idle_gate_latches_too_and_remembers_all_that_did() -> None:
    rig = idle()
    rig.tick(faults=(LOST, CRASHED))
    assert (rig.mode, rig.state.causes) == ("latched", (CRASHED,))
    rig.safety(HOT, BLIND, verdict="stop")
    rig.tick()
    assert (rig.mode, rig.state.causes) == ("latched", (CRASHED, HOT))


@pytest.mark.parametrize("make", [Rig, idle, enabled, driving])
def test_an_estop_latches_in_any_mode_at_once(make: Callable[[], Rig]) -> None:
    rig = make()
    rig.live(1, 0.2)
    assert rig.feed(gate.Estop("alice")) == gate.Outcome(
        text="stopped and latched; e-stop number 1"
    )
    assert (rig.mode, rig.codes, rig.state.output) == ("latched", ["estop"], ZERO)
    assert rig.state.commander == ""
    assert rig.send(0.2).refused == "not_enabled"
    rig.live(100, 0.2)
    assert (rig.mode, rig.codes, rig.state.output) == ("latched", ["estop"], ZERO)


def test_an_estop_stops_what_is_already_stopping_and_keeps_what_latches() -> None:
    rig = driving()
    rig.tick(faults=(LOST, CRASHED))
    assert rig.state.output == Velocity(linear_x=0.16)
    rig.feed(gate.Estop("alice"))
    assert (rig.codes, rig.state.output) == (["collision", "estop"], ZERO)


@pytest.mark.parametrize("mode", ["latched", "idle"])
def test_a_gate_that_is_shut_says_zero_whatever_it_said_before(
    mode: Literal["latched", "idle"],
) -> None:
    rig = driving()
    rig.state = replace(rig.state, mode=mode)
    rig.safety()
    assert rig.state.output == ZERO


def test_every_estop_counts() -> None:
    rig = driving()
    for count in (1, 2, 3):
        text = f"stopped and latched; e-stop number {count}"
        assert rig.feed(gate.Estop("alice")) == gate.Outcome(text=text)
        assert rig.state.estop_generation == count
    assert rig.codes == ["estop"]


def test_nothing_jumps_when_it_is_enabled_within_the_tick_of_an_estop() -> None:
    rig = driving()
    rig.live(30, 0.2)  # stuck wheels: the body is at rest despite its command
    rig.feed(gate.Estop("alice"))
    rig.feed(gate.Release(1))
    rig.feed(gate.Enable("control"))
    rig.send(0.2)
    assert (rig.mode, rig.state.output) == ("enabled", ZERO)
    rig.live(5, 0.2)
    assert (rig.mode, rig.state.output) == ("enabled", Velocity(linear_x=0.02))
