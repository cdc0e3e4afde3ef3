"""Velocity commands at the gate: acceptance, limits and refusals."""

from collections.abc import Callable

import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.gate import causes, gate
from gigabrain_zenoh.geometry.limits import ZERO
from tests.unit.gate.rig import BOOT, ZONE, Rig, calm, driving, enabled, idle

NAN, INF = float("nan"), float("inf")
MS = 1_000_000
GOOD = gate.Outcome()


def refused(why: str) -> gate.Outcome:
    return gate.Outcome(refused=why, ok=False)


def test_a_good_command_counts_at_once_and_again_in_every_tick() -> None:
    rig = calm()
    assert rig.send(0.2, 0.1, -0.3) == GOOD
    assert rig.state.output == Velocity(linear_x=0.02, linear_y=0.02, angular_z=-0.06)
    rig.tick()
    assert rig.state.output == Velocity(linear_x=0.04, linear_y=0.04, angular_z=-0.12)
    rig.tick(3)
    assert rig.state.output == Velocity(linear_x=0.1, linear_y=0.1, angular_z=-0.3)


def test_several_commands_in_one_tick_do_not_add_up() -> None:
    rig = calm()
    for _ in range(5):
        rig.send(0.2)
    assert rig.state.output == Velocity(linear_x=0.02)
    rig.send(-0.2)
    assert rig.state.output == Velocity(linear_x=-0.02)
    rig.send(0.01)
    assert rig.state.output == Velocity(linear_x=0.01)


def test_a_command_is_cut_to_what_the_body_can_do() -> None:
    rig = enabled()
    rig.live(18, 5.0, -50.0)
    assert rig.state.output.linear_x == 0.26
    rig.live(17, 5.0, -50.0)
    assert rig.state.output == Velocity(linear_x=0.26, angular_z=-1.8)


def test_it_brakes_before_it_goes_the_other_way() -> None:
    rig = driving(0.1)
    told = []
    for _ in range(5):
        rig.live(1, -0.1)
        told.append(rig.state.output.linear_x)
    assert told == pytest.approx([0.06, 0.02, 0.0, -0.02, -0.04])


def test_safetys_caps_count_at_once_and_the_body_brakes_to_them() -> None:
    rig = driving(0.2)
    rig.tick()
    rig.send(0.2)
    rig.safety(ZONE, verdict="slow", caps=SpeedCaps(forward=0.0))
    assert rig.state.output == Velocity(linear_x=0.16)
    told = []
    for _ in range(4):
        rig.tick()
        rig.send(0.2)
        told.append(rig.state.output.linear_x)
    assert told == pytest.approx([0.12, 0.08, 0.04, 0.0])
    assert (rig.mode, rig.state.causes) == ("enabled", ())


def test_a_zone_ahead_leaves_turning_and_backing_away() -> None:
    rig = calm()
    rig.safety(ZONE, verdict="slow", caps=SpeedCaps(forward=0.0))
    rig.send(0.2, angular_z=1.0)
    assert rig.state.output == Velocity(angular_z=0.06)
    rig.send(-0.2)
    assert rig.state.output == Velocity(linear_x=-0.02)


def test_a_zone_never_stops_an_enable() -> None:
    rig = idle()
    rig.safety(ZONE, verdict="slow", caps=SpeedCaps(forward=0.0))
    assert rig.feed(gate.Enable("control")).ok


@pytest.mark.parametrize(
    ("send", "why"),
    [
        (lambda rig: rig.send(0.2, boot=BOOT + 1), "boot"),
        (lambda rig: rig.send(0.2, boot=BOOT - 1), "boot"),
        (lambda rig: rig.send(0.2, boot=0), "boot"),
        (lambda rig: rig.send(0.2, echo=-1), "future"),
        (lambda rig: rig.send(0.2, basis=-1), "future"),
        (lambda rig: rig.send(0.2, echo=8), "old"),
        (lambda rig: rig.send(0.2, basis=None), "basis"),
        (lambda rig: rig.send(0.0, 0.1, basis=None), "basis"),
        (lambda rig: rig.send(0.0, 0.0, -0.1, basis=None), "basis"),
        (lambda rig: rig.send(0.2, source="alice"), "commander"),
        (lambda rig: rig.send(0.2, source=""), "commander"),
        (lambda rig: rig.send(0.2, seq=rig.seq), "seq"),
        (lambda rig: rig.send(0.2, seq=rig.seq - 1), "seq"),
        (lambda rig: rig.send(0.2, seq=0), "seq"),
    ],
)
def test_what_is_refused_neither_moves_the_body_nor_feeds_the_watchdog(
    send: Callable[[Rig], gate.Outcome], why: str
) -> None:
    rig = enabled()
    rig.live(9)
    for _ in range(5):
        rig.tick()
        rig.safety()
        before = rig.state
        assert send(rig) == refused(why)
        assert rig.state.command == before.command
        assert rig.state.output == ZERO
        assert rig.mode == "enabled"
    rig.tick()
    assert (rig.mode, rig.codes) == ("stopping", ["silence"])


def test_a_refused_command_leaves_no_trace() -> None:
    rig = enabled("alice")
    rig.tick()
    before = rig.state
    for outcome, why in (
        (rig.send(0.2, source="alice", boot=1), "boot"),
        (rig.send(0.2, source="control", boot=1), "boot"),
        (rig.send(0.2, source="control", echo=8), "old"),
        (rig.send(0.2, source="control", basis=None), "basis"),
        (rig.send(0.2, source="bob"), "commander"),
    ):
        assert (outcome, rig.state) == (refused(why), before)


def test_an_echo_of_seven_ticks_passes_and_one_of_eight_does_not() -> None:
    rig = enabled()
    rig.live(10)
    assert rig.send(0.1, echo=7) == GOOD
    assert rig.send(0.1, echo=8) == refused("old")


def test_the_hosts_clock_bounds_an_echo_as_well() -> None:
    rig = enabled()
    for tick in range(3):
        rig.tick(wall_ns=1000 * MS + tick * 40 * MS)  # a simulation at half speed
        rig.safety()
        rig.send()
    assert rig.send(0.1, echo=0, wall_ns=1230 * MS) == GOOD
    assert rig.send(0.1, echo=0, wall_ns=1230 * MS + 1) == refused("old")
    assert rig.send(0.1, echo=1, wall_ns=1190 * MS) == GOOD
    assert rig.send(0.1, echo=1, wall_ns=1190 * MS + 1) == refused("old")
    assert rig.send(0.1, echo=2, wall_ns=1150 * MS) == GOOD
    assert rig.send(0.1, echo=2, wall_ns=1150 * MS + 1) == refused("old")
    assert rig.send(0.1, echo=2) == GOOD


def test_what_a_freeze_has_left_lying_about_is_refused() -> None:
    rig = enabled()
    rig.tick(wall_ns=0)
    rig.safety()
    assert rig.send(0.2, wall_ns=10 * MS) == GOOD
    assert [rig.send(0.2, wall_ns=3000 * MS).refused for _ in range(50)] == ["old"] * 50


def test_age_is_by_ticks_and_by_the_clock_whichever_is_more() -> None:
    rig = Rig()
    for tick in range(20):
        rig.tick(wall_ns=tick * 30 * MS)
    assert gate.age_ns(rig.state, 20, None) == 0
    assert gate.age_ns(rig.state, 18, None) == 40 * MS
    assert gate.age_ns(rig.state, 20, 571 * MS) == 1 * MS
    assert gate.age_ns(rig.state, 18, 571 * MS) == 61 * MS
    assert gate.age_ns(rig.state, 18, 520 * MS) == 40 * MS
    assert gate.age_ns(rig.state, 5, 571 * MS) == 451 * MS  # the oldest remembered tick
    assert gate.age_ns(rig.state, 4, 571 * MS) == 320 * MS
    assert gate.age_ns(rig.state, 21, 571 * MS) == -20 * MS


def test_without_a_clock_that_means_anything_only_ticks_count() -> None:
    rig = Rig()
    rig.tick(wall_ns=5)
    rig.tick()
    rig.tick()
    assert rig.state.issued_ns == ()
    assert gate.age_ns(rig.state, 2, 10**18) == 20 * MS


def test_seq_may_leave_gaps_but_never_comes_again() -> None:
    rig = enabled()
    rig.live(1)
    assert [rig.send(0.1, seq=seq).refused for seq in (50, 50, 49, 51, 60, 52, 61)] == [
        "",
        "seq",
        "seq",
        "",
        "",
        "seq",
        "",
    ]


def test_a_commanders_first_command_may_have_the_number_nought() -> None:
    assert enabled().send(0.1, seq=0) == GOOD


def test_the_brain_may_stand_still_without_having_looked() -> None:
    assert enabled().send(basis=None) == GOOD


def test_a_person_needs_no_scan_to_drive() -> None:
    rig = calm("alice")
    assert rig.send(0.2, source="alice", basis=None) == GOOD
    assert rig.state.output == Velocity(linear_x=0.02)


def test_nothing_passes_while_the_gate_is_shut() -> None:
    rig = idle()
    assert rig.send(0.2) == refused("not_enabled")
    assert rig.state.output == ZERO
    rig.feed(gate.Estop("alice"))
    assert rig.send(0.2) == refused("not_enabled")
    assert rig.state.output == ZERO


def test_nothing_passes_while_it_stops() -> None:
    rig = driving()
    rig.until("stopping", rig.tick)
    assert rig.send(0.2) == refused("not_enabled")
    assert rig.state.output == Velocity(linear_x=0.16)


def test_the_brain_is_heard_whoever_drives_so_that_it_can_take_over() -> None:
    rig = enabled("alice")
    for _ in range(10):
        rig.tick()
        rig.safety()
        rig.send(source="alice")
        assert rig.send(0.1) == refused("commander")
    assert rig.feed(gate.Enable("control", take=True, by="alice")).ok
    rig.tick()
    rig.safety()
    assert rig.state.output == ZERO  # its earlier commands do not count
    assert rig.send(0.1) == GOOD


def test_the_brain_takes_over_by_what_it_says_not_by_what_the_other_said() -> None:
    rig = enabled("alice")
    for _ in range(6):
        rig.tick()
        rig.safety()
        rig.send(source="alice")
    assert rig.feed(gate.Enable("control", take=True, by="alice")) == gate.Outcome(
        ok=False,
        text=f"not now: {causes.in_words((causes.SILENCE,))}",
    )
    assert (rig.mode, rig.state.commander) == ("enabled", "alice")
