"""Enabling the gate: rights, refusals and timing."""

from collections.abc import Callable

import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.gate import causes, gate
from gigabrain_zenoh.geometry.limits import ZERO
from tests.unit.gate.rig import BLIND, LOST, ZONE, Rig, enabled, idle


def test_a_latched_gate_is_not_enabled() -> None:
    rig = enabled()
    rig.feed(gate.Estop("alice"))
    rig.live(5)
    before = rig.state
    assert rig.feed(gate.Enable("control", take=True)) == gate.Outcome(
        ok=False,
        text="latched: e-stop pressed by alice (find out why it was pressed); release it first",
    )
    assert rig.state == before


def test_nobody_enables_namelessly() -> None:
    rig = idle()
    before = rig.state
    assert rig.feed(gate.Enable("")) == gate.Outcome(
        ok=False, text="the source is empty; name the commander"
    )
    assert rig.state == before


def _brain_quiet(rig: Rig) -> None:
    for _ in range(6):
        rig.tick()
        rig.safety()


def _brain_stares(rig: Rig) -> None:
    rig.live(10)
    rig.send(basis=13)


@pytest.mark.parametrize(
    ("spoil", "why", "brain_only"),
    [
        (lambda rig: rig.live(1), "", False),
        (lambda rig: rig.safety(ZONE, verdict="slow"), "", False),
        (lambda rig: rig.tick(faults=(LOST,)), "the body does not answer", False),
        (lambda rig: rig.tick(8), "the safety process is silent", False),
        (lambda rig: rig.safety(BLIND, verdict="stop"), "the lidar is blind", False),
        (_brain_quiet, "no valid command for 100 ms", True),
        (_brain_stares, "commands use sensor data that is too old", True),
    ],
)
def test_it_is_enabled_only_when_nothing_speaks_against_it(
    spoil: Callable[[Rig], None], why: str, brain_only: bool
) -> None:
    for source in ("control", "alice"):
        rig = idle()
        spoil(rig)
        granted = not why or (brain_only and source != "control")
        rig.feed(gate.Enable(source))
        assert rig.outcome.ok is granted
        assert rig.mode == ("enabled" if granted else "idle")
        assert granted or rig.outcome.text.startswith("not now: " + why)


def test_all_that_speaks_against_it_is_said() -> None:
    rig = idle()
    rig.tick(8, faults=(LOST,))
    assert rig.feed(gate.Enable("control")) == gate.Outcome(
        ok=False,
        text=f"not now: {causes.in_words((LOST, causes.SAFETY_SILENT, causes.SILENCE))}",
    )


def test_while_idle_it_says_what_the_brain_is_waiting_for() -> None:
    rig = idle()
    rig.live(3)
    assert rig.state.causes == ()
    rig.tick(6)
    assert rig.codes == ["silence"]
    rig.tick(2)
    assert rig.codes == ["safety_silent", "silence"]
    rig.live(2)
    assert rig.state.causes == ()


def test_one_commander_holds_the_body_and_another_is_told_who() -> None:
    rig = enabled("alice")
    before = rig.state
    assert rig.feed(gate.Enable("bob")) == gate.Outcome(
        ok=False, text="alice drives; take it over with --take (in a script take=True)"
    )
    assert rig.state == before
    assert rig.feed(gate.Enable("bob", take=True)) == gate.Outcome(text="bob drives")
    assert (rig.state.commander, rig.state.enables, rig.mode) == ("bob", 2, "enabled")
    assert rig.send(source="alice").refused == "commander"
    assert rig.send(source="bob").refused == ""


def test_whoever_takes_over_starts_anew() -> None:
    rig = enabled("alice")
    rig.tick()
    rig.safety()
    rig.send(0.2, source="alice", seq=1000)
    rig.feed(gate.Enable("bob", take=True))
    assert rig.state.output == ZERO  # alice's last command is forgotten
    rig.send(0.2, source="alice", seq=1001)
    for told in (0.0, 0.0, 0.0, 0.0, 0.02):
        rig.tick()
        rig.safety()
        assert rig.send(0.2, source="bob", seq=rig.state.tick).refused == ""
        assert rig.state.output == Velocity(linear_x=told)


def test_a_second_enable_is_counted_and_is_no_command() -> None:
    rig = enabled()
    rig.tick()
    rig.safety()
    rig.send(0.2, seq=1000)
    before = rig.state
    assert rig.feed(gate.Enable("control")) == gate.Outcome(text="control drives")
    assert gate.status(rig.state).enables == 2
    assert (rig.state.command, rig.state.output) == (before.command, before.output)
    assert rig.send(0.2, seq=1000).refused == "seq"
    for _ in range(5):
        rig.tick()
        rig.safety()
        rig.feed(gate.Enable("control"))
    assert rig.mode == "enabled"
    rig.tick()
    assert rig.mode == "stopping"


def test_the_brain_takes_the_body_from_nobody_unless_a_person_hands_it_over() -> None:
    rig = enabled("alice")
    rig.live(3)
    for by in ("", "control"):
        assert rig.feed(gate.Enable("control", take=True, by=by)) == gate.Outcome(
            ok=False, text="alice drives; only a person can enable the brain"
        )
    assert rig.state.commander == "alice"
    assert rig.feed(gate.Enable("control", take=True, by="bob")) == gate.Outcome(
        text="control drives"
    )


def test_a_held_joystick_moves_nothing_in_the_first_100_ms() -> None:
    rig = idle()
    for _ in range(30):  # commands arrive while the gate is closed
        rig.tick()
        rig.safety()
        rig.send(0.26, source="alice")
    assert rig.feed(gate.Enable("alice")).ok
    told = []
    for _ in range(6):
        rig.send(0.26, source="alice")
        told.append(rig.state.output.linear_x)
        rig.tick()
        rig.safety()
    assert told == [0.0, 0.0, 0.0, 0.0, 0.0, 0.02]


def test_a_release_under_a_held_joystick_moves_nothing_without_an_enable() -> None:
    rig = enabled("alice")
    rig.feed(gate.Estop("bob"))
    for _ in range(40):
        rig.tick()
        rig.safety()
        rig.send(0.26, source="alice")
    assert rig.feed(gate.Release(1)).ok
    for _ in range(40):
        rig.tick()
        rig.safety()
        assert rig.send(0.26, source="alice").refused == "not_enabled"
    assert (rig.mode, rig.state.commander, rig.state.output) == ("idle", "", ZERO)
