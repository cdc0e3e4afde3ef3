"""Safety's step: causes that stop or slow the body, and after how long."""

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import BodyDescription, GateStatus, RobotState, Thresholds
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.gate.causes import BRAIN_SILENT
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step
from gigabrain_zenoh.safety.zones import ProtectiveField
from gigabrain_zenoh.testing.samples import DRIVING, LIDAR, WAFFLE, open_space, scan, state
from tests.unit.gate.rig import plain

MS = 1_000_000
BODY = replace(WAFFLE, thresholds=Thresholds(reaction_time=0.32, stop_margin=0.08))
ALL = ("perception", "decision", "control")


def after_one_scan(boot: int = 7) -> SafetyMemory:
    """Return the memory after one scan."""
    return SafetyMemory(boot=boot, field=ProtectiveField(scans=1))


def judge(
    *,
    at: RobotState | None = None,
    seen: LaserScan | None = None,
    age_ms: float | None = 0,
    silent: tuple[str, ...] = (),
    memory: SafetyMemory | None = None,
    body: BodyDescription = BODY,
) -> SafetyState:
    """Return the verdict on one tick."""
    now = at or state(1)
    inputs = SafetyInputs(
        state=now,
        scan=seen or scan(open_space()),
        scan_age_ns=None if age_ms is None else round(age_ms * MS),
        silent=silent,
    )
    return step(body, memory or after_one_scan(now.boot), inputs)[1]


def codes(verdict: SafetyState) -> list[str]:
    return [cause.code for cause in verdict.causes]


class Watch:
    """Safety over time: each call is a tick with a new scan of free space or an obstacle."""

    def __init__(self) -> None:
        self.memory, self.tick = after_one_scan(), 0

    def sees(
        self, ahead: float | None = None, behind: float | None = None, v: float = 0.0
    ) -> SafetyState:
        """Return the verdict with free distances [m], at the speed `v` [m/s]."""
        self.tick += 1
        values = open_space()
        if ahead is not None:
            values[0] = 0.075 + ahead
        if behind is not None:
            values[180] = 0.200 + behind
        return self._judge(
            SafetyInputs(state=state(self.tick, v=v), scan=scan(values, self.tick), scan_age_ns=0)
        )

    def _judge(self, inputs: SafetyInputs) -> SafetyState:
        self.memory, verdict = step(BODY, self.memory, inputs)
        return verdict


def test_without_faults_the_verdict_is_ok() -> None:
    assert judge() == SafetyState(verdict="ok")


def test_a_lost_scan_stops_the_body_after_250_ms() -> None:
    assert judge(age_ms=250).verdict == "ok"
    lost = judge(age_ms=250.001)
    assert lost.verdict == "stop"
    assert plain(lost.causes) == [("scan_lost", "no scan for more than 250 ms")]
    text = "no scan has come yet"
    assert plain(judge(age_ms=None).causes) == [("scan_lost", text)]


def test_a_slow_lidar_may_take_one_and_a_half_periods() -> None:
    slow = replace(BODY, lidar=replace(LIDAR, rate_hz=5.0))
    assert judge(age_ms=300, body=slow).verdict == "ok"
    assert judge(age_ms=300.001, body=slow).causes[0].code == "scan_lost"


@pytest.mark.parametrize(
    ("rate_hz", "limit_ms"), [(50.0, 250), (10.0, 250), (6.0, 250), (5.0, 300), (2.0, 750)]
)
def test_the_age_limit_of_scans_depends_on_the_lidars_rate(rate_hz: float, limit_ms: int) -> None:
    assert scan_limit_ns(replace(BODY, lidar=replace(LIDAR, rate_hz=rate_hz))) == limit_ms * MS
    assert scan_limit_ns(replace(BODY, lidar=None)) == 250 * MS


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (np.full(360, np.nan), "the lidar sees nothing at all"),
        (np.full(360, 2.0), "all beams report the same distance"),
        (np.linspace(1, 2, 359), "the scan has 359 beams, the body's lidar 360"),
    ],
)
def test_a_blind_lidar_stops_the_body(values: np.ndarray, text: str) -> None:
    verdict = judge(seen=scan(values))
    assert verdict.verdict == "stop"
    assert plain(verdict.causes) == [("scan_blind", text)]


def test_a_lidar_without_a_valid_beam_ahead_stops_the_body() -> None:
    values = np.linspace(1.0, 2.0, 360)
    values[:16] = values[-15:] = np.nan
    assert codes(judge(seen=scan(values))) == ["scan_blind"]


def test_a_body_without_a_lidar_is_not_stopped_for_it() -> None:
    assert judge(body=replace(BODY, lidar=None), age_ms=None).verdict == "ok"


@pytest.mark.parametrize("name", ALL)
def test_a_silent_system_stops_the_body_while_the_brain_drives(name: str) -> None:
    verdict = judge(silent=(name,))
    assert verdict.verdict == "stop"
    assert plain(verdict.causes) == [(f"{name}_silent", f"{name} is silent")]


@pytest.mark.parametrize(
    ("commander", "silent", "expected"),
    [
        ("control", ALL, "stop"),
        ("script", ALL, "ok"),  # a person or a script watches instead
        ("", ("decision",), "stop"),  # the brain would be next
        ("", ("perception", "decision"), "stop"),
        ("", ALL, "ok"),  # there is no brain, and a script need not wait for one
    ],
)
def test_the_systems_matter_only_where_the_brain_does(
    commander: str, silent: tuple[str, ...], expected: str
) -> None:
    gate = GateStatus(mode="enabled" if commander else "idle", commander=commander)
    assert judge(at=state(1, gate=gate), silent=silent).verdict == expected


def test_within_the_stopping_distance_the_way_ahead_is_closed_but_no_other() -> None:
    verdict = Watch().sees(ahead=0.16, v=0.2)  # L(0.2) = 0.164 m
    assert verdict.verdict == "slow"
    assert verdict.caps == SpeedCaps(forward=0.0)
    assert plain(verdict.causes) == [("zone_ahead", "obstacle 0.16 m ahead of the body")]
    verdict = Watch().sees(behind=0.16, v=-0.2)
    assert verdict.caps == SpeedCaps(backward=0.0)
    assert codes(verdict) == ["zone_behind"]


def test_beyond_the_stopping_distance_only_the_speed_is_bounded() -> None:
    verdict = Watch().sees(ahead=0.17, v=0.2)
    assert (verdict.verdict, verdict.causes) == ("slow", ())
    assert verdict.caps.forward == pytest.approx(0.211, abs=0.001)
    assert Watch().sees(ahead=0.5, v=0.26) == SafetyState(verdict="ok")


def test_a_closed_zone_opens_again_with_ten_centimetres_to_spare() -> None:
    watch = Watch()
    assert codes(watch.sees(ahead=0.16, v=0.2)) == ["zone_ahead"]
    assert codes(watch.sees(ahead=0.17)) == ["zone_ahead"]  # at rest, L(0) = 0.08 m
    opened = watch.sees(ahead=0.19)
    assert opened.causes == ()
    assert opened.caps.forward is not None
    assert opened.caps.forward > 0.2
    assert codes(watch.sees(ahead=0.17)) == []


def test_a_zone_depends_on_the_speed_towards_it() -> None:
    assert codes(Watch().sees(ahead=0.1, v=-0.26)) == []
    assert codes(Watch().sees(behind=0.1, v=0.26)) == []


def test_a_scan_waits_for_the_state_of_its_tick() -> None:
    near = open_space(deg_0=0.2)
    memory, verdict = step(
        BODY, after_one_scan(), SafetyInputs(state=state(4), scan=scan(near, 5), scan_age_ns=0)
    )
    assert (memory.field.basis, memory.field.free, codes(verdict)) == (0, {}, ["starting"])
    memory, verdict = step(
        BODY, memory, SafetyInputs(state=state(5, v=0.2), scan=scan(near, 5), scan_age_ns=0)
    )
    assert memory.field.basis == 5
    assert codes(verdict) == ["zone_ahead"]


def test_a_scan_is_judged_once_by_the_speed_of_its_own_time() -> None:
    seen = scan(open_space(deg_0=0.255), 1)  # 0.18 m free
    memory, first = step(
        BODY, after_one_scan(), SafetyInputs(state=state(1, v=0.2), scan=seen, scan_age_ns=0)
    )
    _, later = step(BODY, memory, SafetyInputs(state=state(3, v=0.26), scan=seen, scan_age_ns=0))
    assert codes(first) == codes(later) == []
    assert first.caps == later.caps  # they keep the speed within what the zone allows


def test_a_blind_scan_has_no_free_distances() -> None:
    watch = Watch()
    watch.sees(ahead=0.1, v=0.2)
    watch.tick += 1
    inputs = SafetyInputs(
        state=state(watch.tick), scan=scan(np.full(360, np.nan), watch.tick), scan_age_ns=0
    )
    memory, verdict = step(BODY, watch.memory, inputs)
    assert (memory.field.free, memory.field.stopped) == ({}, frozenset())
    assert codes(verdict) == ["scan_blind"]


def test_a_restart_of_the_driver_resets_the_memory() -> None:
    watch = Watch()
    watch.sees(ahead=0.1, v=0.2)
    now = state(1, boot=8, battery=1.0)
    memory, verdict = step(BODY, watch.memory, SafetyInputs(state=now, scan_age_ns=None))
    assert (memory.boot, memory.tick, memory.field) == (8, 1, ProtectiveField())
    assert codes(verdict)[:2] == ["scan_lost", "starting"]


def test_nothing_moves_before_the_second_scan() -> None:
    memory, found = SafetyMemory(), []
    for tick in (1, 2, 5, 6):
        seen = scan(open_space(), 5 if tick >= 5 else 1)
        inputs = SafetyInputs(state=state(tick), scan=seen, scan_age_ns=0)
        memory, verdict = step(BODY, memory, inputs)
        found.append(codes(verdict))
    assert found == [["starting"], ["starting"], [], []]
    bare = replace(BODY, lidar=None)
    assert step(bare, SafetyMemory(), SafetyInputs(state=state(1)))[1] == SafetyState(verdict="ok")


def test_at_the_first_scan_it_reports_systems_that_have_not_published_yet() -> None:
    """Later it knows whether there is a brain; a script need not wait for a missing one."""
    systems, memory, found = ("perception", "decision", "control"), SafetyMemory(), []
    for tick, basis in ((1, 0), (2, 2), (5, 2), (7, 7)):
        seen = scan(open_space(), basis) if basis else None
        now = state(tick, gate=GateStatus(mode="idle"))
        inputs = SafetyInputs(state=now, scan=seen, scan_age_ns=0, silent=systems)
        memory, verdict = step(BODY, memory, inputs)
        found.append([code for code in codes(verdict) if code in BRAIN_SILENT])
    all_silent = [f"{name}_silent" for name in systems]
    assert found == [[], all_silent, all_silent, []]


def test_a_verdict_can_have_several_causes() -> None:
    watch = Watch()
    watch.sees(ahead=0.05)
    inputs = SafetyInputs(
        state=state(watch.tick + 1, gate=DRIVING), scan_age_ns=300 * MS, silent=("control",)
    )
    _, verdict = step(BODY, watch.memory, inputs)
    assert codes(verdict) == ["scan_lost", "control_silent", "zone_ahead"]
    assert verdict.verdict == "stop"
