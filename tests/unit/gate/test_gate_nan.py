"""Speeds at the gate that are not finite numbers: refusals, stops and latching."""

from collections.abc import Callable

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import ZERO
from tests.unit.gate.rig import BOOT, Rig, driving, enabled, idle

NAN, INF = float("nan"), float("inf")


def refused(why: str) -> gate.Outcome:
    return gate.Outcome(refused=why, ok=False)


@pytest.mark.parametrize("speeds", [(NAN, 0, 0), (0, INF, 0), (0, 0, -INF), (0.1, NAN, 0.1)])
def test_a_value_that_is_not_a_number_stops_the_body_at_once(
    speeds: tuple[float, float, float],
) -> None:
    rig = driving(0.2)
    assert rig.send(*speeds) == refused("not_finite")
    assert (rig.mode, rig.codes, rig.state.output) == ("stopping", ["nan"], ZERO)
    rig.safety()
    assert rig.state.output == ZERO
    rig.live(14, 0.2)
    assert (rig.mode, rig.codes, rig.state.output) == ("stopping", ["nan"], ZERO)
    rig.live(1, 0.2)
    assert (rig.mode, rig.codes, rig.state.output) == ("idle", [], ZERO)


def test_what_did_not_decode_for_such_a_value_counts_as_well() -> None:
    rig = driving(0.2)
    assert rig.feed(gate.NotFinite("control", BOOT)) == refused("not_finite")
    assert (rig.mode, rig.codes, rig.state.output) == ("stopping", ["nan"], ZERO)


@pytest.mark.parametrize(
    ("source", "boot"), [("alice", BOOT), ("", BOOT), ("control", BOOT + 1), ("control", BOOT - 1)]
)
def test_from_anybody_else_it_is_only_refused(source: str, boot: int) -> None:
    rig = driving(0.2)
    before = rig.state
    assert rig.feed(gate.NotFinite(source, boot)) == refused("not_finite")
    assert rig.state == before


@pytest.mark.parametrize("make", [Rig, idle])
@pytest.mark.parametrize("source", ["", "control"])
def test_while_nobody_drives_it_is_only_refused(make: Callable[[], Rig], source: str) -> None:
    rig = make()
    before = rig.state
    assert rig.feed(gate.NotFinite(source, BOOT)) == refused("not_finite")
    assert rig.state == before


def test_it_stops_a_body_that_is_still_rolling_out_and_does_not_prolong_it() -> None:
    rig = driving(0.2)
    rig.until("stopping", rig.tick)
    assert rig.state.output == Velocity(linear_x=0.16)
    rig.feed(gate.NotFinite("control", BOOT))
    assert (rig.state.output, rig.codes) == (ZERO, ["silence", "nan"])
    assert rig.until("idle", rig.tick) == 15


def test_five_within_a_second_latch() -> None:
    rig = enabled()
    rig.live(5)
    for _ in range(4):
        rig.feed(gate.NotFinite("control", BOOT))
    assert rig.codes == ["nan"]
    rig.feed(gate.NotFinite("control", BOOT))
    assert (rig.mode, rig.codes) == ("stopping", ["nan", "nan_storm"])
    rig.live(20)
    assert (rig.mode, rig.codes) == ("latched", ["nan_storm"])


@pytest.mark.parametrize("apart", [4, 12])
@pytest.mark.parametrize("again", [False, True])
def test_five_within_a_second_latch_also_where_the_first_has_closed_the_gate(
    apart: int, again: bool
) -> None:
    rig = enabled()
    rig.live(5)
    for _ in range(4):
        rig.feed(gate.NotFinite("control", BOOT))
        rig.live(apart)
        if again:
            rig.feed(gate.Enable("control"))
    assert rig.mode != "latched"
    rig.feed(gate.NotFinite("control", BOOT))
    rig.live(20)
    assert (rig.mode, rig.codes) == ("latched", ["nan_storm"])
    before = rig.state
    assert rig.feed(gate.NotFinite("control", BOOT)) == refused("not_finite")
    assert rig.state == before


def test_once_the_gate_is_idle_only_that_of_whoever_lost_the_body_by_it_counts() -> None:
    rig = enabled()
    rig.live(5)
    rig.feed(gate.NotFinite("control", BOOT))
    rig.until("idle", lambda: rig.live(1))
    before = rig.state
    assert rig.feed(gate.NotFinite("alice", BOOT)) == refused("not_finite")
    assert rig.state == before
    assert rig.feed(gate.NotFinite("control", BOOT)) == refused("not_finite")
    assert rig.codes == ["nan"]


def test_the_fifth_from_a_former_commander_latches_before_an_enable_forgets_it() -> None:
    rig = enabled()
    rig.live(5)
    for _ in range(4):
        rig.feed(gate.NotFinite("control", BOOT))
    rig.until("idle", lambda: rig.live(1))
    latches = rig.state.latches
    rig.feed(gate.NotFinite("control", BOOT))
    assert (rig.mode, rig.codes) == ("latched", ["nan_storm"])
    assert rig.state.latches == latches + 1
    assert not rig.feed(gate.Enable("control", take=True)).ok
    rig.live(1)
    assert (rig.mode, rig.codes) == ("latched", ["nan_storm"])


@pytest.mark.parametrize(("ticks", "codes"), [(49, ["nan", "nan_storm"]), (50, ["nan"])])
def test_five_in_more_than_a_second_do_not(ticks: int, codes: list[str]) -> None:
    rig = driving(0.2)
    for _ in range(4):
        rig.feed(gate.NotFinite("control", BOOT))
    rig.state = gate_that_stops_for_long(rig)
    rig.tick(ticks)
    rig.feed(gate.NotFinite("control", BOOT))
    assert rig.codes == codes


def gate_that_stops_for_long(rig: Rig) -> gate.GateState:
    """So that it does not become idle, and forget who drove, within the second."""
    return replace(rig.state, stopped_tick=rig.state.tick + 1000)


def test_what_another_commander_sent_before_is_not_held_against_the_next() -> None:
    rig = enabled()
    rig.live(1)
    for _ in range(4):
        rig.feed(gate.NotFinite("control", BOOT))
    rig.until("idle", lambda: rig.live(1))
    rig.feed(gate.Enable("alice"))
    rig.feed(gate.NotFinite("alice", BOOT))
    assert rig.codes == ["nan"]


def test_auto_resume_waits_half_a_second_after_it() -> None:
    rig = driving()
    rig.config = gate.GateConfig(limits=rig.config.limits, auto_resume=True)
    rig.live(110)
    rig.feed(gate.NotFinite("control", BOOT))
    rig.live(10)
    rig.feed(gate.NotFinite("control", BOOT))
    assert rig.until("idle", lambda: rig.live(1)) == 5
    assert rig.until("enabled", lambda: rig.live(1)) == 20
