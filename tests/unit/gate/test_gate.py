"""The gate at boot, and how it is released."""

import copy
from typing import Literal

import pytest

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.body import GateStatus
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import ZERO
from tests.unit.gate.rig import BLIND, BOOT, CRASHED, HOT, LIMITS, LOST, Rig, driving, enabled, idle


def test_it_boots_latched_and_at_rest() -> None:
    state = gate.GateState(boot=BOOT)
    assert gate.status(state) == GateStatus(
        mode="latched",
        causes=(
            Cause(
                code="boot",
                text="just started, not released yet",
                remedy="check that nobody is in its way",
            ),
        ),
        estop_generation=0,
        commander="",
        enables=0,
    )
    assert (state.output, state.tick) == (ZERO, 0)


def test_what_a_deployment_does_not_say() -> None:
    config = gate.GateConfig(limits=LIMITS)
    assert (config.basis_ns, config.auto_resume) == (250_000_000, False)


def test_the_status_shows_who_drives_and_what_has_happened() -> None:
    rig = enabled("alice")
    assert gate.status(rig.state) == GateStatus(mode="enabled", commander="alice", enables=1)
    rig.feed(gate.Estop("bob"))
    assert gate.status(rig.state) == GateStatus(
        mode="latched",
        causes=(
            Cause(
                code="estop",
                text="e-stop pressed by bob",
                latching=True,
                remedy="find out why it was pressed",
            ),
        ),
        estop_generation=1,
        latches=1,
        enables=1,
    )


def test_without_auto_resume_nothing_but_a_person_opens_it() -> None:
    rig = Rig()
    rig.live(200, 0.2)
    assert (rig.mode, rig.codes, rig.state.output) == ("latched", ["boot"], ZERO)
    assert rig.feed(gate.Release(0)) == gate.Outcome(text="released; enable it to move")
    assert (rig.mode, rig.state.causes, rig.state.output) == ("idle", (), ZERO)
    rig.live(200, 0.2)
    assert (rig.mode, rig.state.output) == ("idle", ZERO)
    assert rig.feed(gate.Enable("control")) == gate.Outcome(text="control drives")
    rig.live(4, 0.2)  # it stands for 100 ms after an enable
    assert (rig.mode, rig.state.output) == ("enabled", ZERO)
    rig.live(1, 0.2)
    assert (rig.mode, rig.state.output) == ("enabled", Velocity(linear_x=0.02))


@pytest.mark.parametrize("generation", [0, 1, 3])
def test_a_release_must_name_the_newest_estop(generation: int) -> None:
    rig = enabled()
    rig.feed(gate.Estop("alice"))
    rig.feed(gate.Estop("alice"))
    rig.tick(30)
    assert rig.feed(gate.Release(generation)) == gate.Outcome(
        ok=False, text="wrong e-stop number, the newest is 2; check its cause, then release"
    )
    assert rig.mode == "latched"
    assert rig.feed(gate.Release(2)).ok
    assert rig.mode == "idle"


def test_a_release_needs_half_a_second_at_rest() -> None:
    rig = Rig()
    rig.tick(24)
    assert rig.feed(gate.Release(0)) == gate.Outcome(
        ok=False, text="the body is not at rest yet; wait half a second"
    )
    assert rig.mode == "latched"
    rig.tick()
    assert rig.feed(gate.Release(0)).ok


@pytest.mark.parametrize(
    ("measured", "still"),
    [
        (Velocity(linear_x=0.0099, linear_y=-0.0099, angular_z=0.0499), True),
        (Velocity(linear_x=0.01), False),
        (Velocity(linear_x=-0.01), False),
        (Velocity(linear_y=0.01), False),
        (Velocity(linear_y=-0.01), False),
        (Velocity(angular_z=0.05), False),
        (Velocity(angular_z=-0.05), False),
        (Velocity(linear_x=float("nan")), False),
        (Velocity(linear_y=float("nan")), False),
        (Velocity(angular_z=float("nan")), False),
    ],
)
def test_at_rest_means_under_a_centimetre_a_second(measured: Velocity, still: bool) -> None:
    rig = Rig()
    rig.tick(24)
    rig.tick(measured=measured)
    assert rig.feed(gate.Release(0)).ok is still
    rig.tick(24)
    assert rig.feed(gate.Release(0)).ok is still


@pytest.mark.parametrize("verdict", ["stop", "ok"])
def test_a_release_waits_until_what_latched_it_is_over(verdict: Literal["ok", "stop"]) -> None:
    rig = Rig()
    rig.tick(25)
    rig.safety(HOT, BLIND, verdict=verdict)
    assert rig.feed(gate.Release(0)) == gate.Outcome(
        ok=False, text="the cause is still present: a motor is hot"
    )
    rig.safety(BLIND, verdict="stop")
    assert rig.feed(gate.Release(0)).ok


def test_what_the_driver_itself_finds_wrong_holds_a_release_back_as_well() -> None:
    rig = Rig()
    rig.tick(25, faults=(CRASHED, LOST))
    rig.safety(HOT)
    assert rig.feed(gate.Release(0)) == gate.Outcome(
        ok=False, text="the cause is still present: it has hit something; a motor is hot"
    )
    rig.safety()
    assert not rig.feed(gate.Release(0)).ok
    rig.tick(faults=(LOST,))
    assert rig.feed(gate.Release(0)).ok


def test_where_nothing_is_latched_there_is_nothing_to_release() -> None:
    for rig in (idle(), enabled()):
        before = rig.state
        assert rig.feed(gate.Release(0)) == gate.Outcome(text="not latched, nothing to release")
        assert rig.state == before


def test_while_stopping_nothing_is_released_or_enabled() -> None:
    rig = driving()
    rig.until("stopping", rig.tick)
    before = rig.state
    assert rig.feed(gate.Release(0)) == gate.Outcome(
        ok=False, text="still stopping; try again when the body is at rest"
    )
    assert rig.feed(gate.Enable("control")) == gate.Outcome(
        ok=False, text="still stopping; try again when it is idle"
    )
    assert rig.state == before


def test_the_same_events_give_the_same_states_and_change_nothing_that_went_in() -> None:
    rig = driving()
    before = copy.deepcopy(rig.state)
    events: list[gate.Event] = [
        gate.Tick(ZERO, 5, (LOST,)),
        gate.NotFinite("control", BOOT),
        gate.Estop("alice"),
        gate.Release(0),
        gate.Enable("bob", take=True),
    ]
    for event in events:
        assert gate.step(rig.config, rig.state, event) == gate.step(rig.config, rig.state, event)
        assert rig.state == before
