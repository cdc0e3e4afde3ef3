"""Calculation of figures: percentiles, rounds, hops and latencies of scans."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.driver.lockstep import RoundTrip
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, SCAN
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.diagnostics.topic_stats import ChainMonitor, median_ms
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.bounded import NewestValues, percentile
from gigabrain_zenoh.qa.bench.chain import Hop, HopTimer, relay_roles
from gigabrain_zenoh.qa.judging import latencies, over_rounds
from tests.unit.qa.figures import compared, one

MS = 1_000_000


@pytest.mark.parametrize(
    ("count", "share", "expected"),
    [(1, 0.99, 1), (2, 0.50, 1), (3, 0.50, 2), (100, 0.50, 50), (100, 0.99, 99), (101, 0.99, 100)],
)
def test_a_percentile_is_one_of_the_measured_values(
    count: int, share: float, expected: float
) -> None:
    assert percentile(range(1, count + 1), share) == expected


def test_without_values_there_is_no_percentile() -> None:
    assert percentile([], 0.5) is None
    assert NewestValues(3).percentile(0.5) is None


def test_a_new_value_replaces_the_oldest() -> None:
    newest = NewestValues(3)
    for value in (5.0, 1.0, 9.0, 2.0):
        newest.add(value)
    assert len(newest) == 3
    assert [newest.percentile(share) for share in (0.0, 0.5, 1.0)] == [1.0, 2.0, 9.0]


@given(st.lists(st.floats(0, 9), min_size=1), st.integers(1, 9), st.floats(0, 1))
def test_the_percentile_is_that_of_the_newest_values(
    values: list[float], size: int, share: float
) -> None:
    newest = NewestValues(size)
    for value in values:
        newest.add(value)
    assert newest.percentile(share) == percentile(sorted(values[-size:]), share)


def test_a_run_without_measurements_is_refused() -> None:
    assert latencies([0.4, 0.2, 0.3]) == one(3, 0.3, 0.4)
    with pytest.raises(GigabrainError, match="nothing came back"):
        latencies([])


def test_one_disturbed_round_does_not_count() -> None:
    assert over_rounds(compared().chain) == one(300, 0.7, 1.5)


def test_a_ratio_is_ours_over_the_bare_relays() -> None:
    assert compared().ratio_p50 == pytest.approx(1.4)
    assert compared().ratio_p99 == pytest.approx(1.5 / 0.9)


def test_the_rest_is_the_time_outside_a_hops_own_work() -> None:
    hop = Hop(name="scan → world", took=1.0, put=0.1, bridge=0.05, decode=0.02, step=0.23)
    assert hop.rest == pytest.approx(0.6)


def test_work_is_timed_by_name_and_its_result_is_returned() -> None:
    timed = HopTimer()
    assert timed("step", lambda: 7) == 7
    assert timed.median("step") >= 0.0
    for duration_ns in (MS, 5 * MS, 2 * MS):
        timed.add("put", duration_ns)
    assert timed.median("put") == 2.0
    assert timed.median("never done") == 0.0


def test_a_hop_lasts_from_the_first_message_with_a_basis_to_the_next_topics() -> None:
    received = ChainMonitor()
    for tick, left_ms in ((5, 100), (10, 200), (15, 300)):
        received.add("robot/scan", CmdVel(linear_x=0.0, basis=tick, stamp_ns=left_ms * MS))
    for tick, left_ms in ((5, 101), (10, 203), (10, 220)):  # the last repeats a basis
        received.add("robot/cmd_vel", CmdVel(linear_x=0.0, basis=tick, stamp_ns=left_ms * MS))
    assert received.between(SCAN, CMD_VEL) == 2.0
    assert not received.complete
    assert median_ms({1: 0, 2: 0, 3: 0}, {2: 4 * MS, 3: 8 * MS, 4: MS}) == 6.0


def test_the_relay_is_a_ring_with_one_source() -> None:
    here = Endpoint(connect=("tcp/127.0.0.1:7447",))
    roles = relay_roles(50.0, 2.0, (1600, 240, 490, 125), [here] * 4)
    assert [role.gets for role in roles[1:]] == [role.puts for role in roles[:-1]]
    assert roles[0].gets == roles[-1].puts
    assert [role.size for role in roles] == [1600, 240, 490, 125]
    assert [role.rate_hz for role in roles] == [50.0, 0.0, 0.0, 0.0]
    assert [role.first for role in roles] == [True, False, False, True]  # like driver and control


def test_a_scan_is_timed_until_the_first_command_that_is_based_on_it() -> None:
    trip = RoundTrip()
    trip.sent(5, 100 * MS)
    trip.answered(0, 101 * MS, counts=True)
    trip.answered(5, 103 * MS, counts=True)
    trip.answered(5, 120 * MS, counts=True)
    assert trip.scan_tick == 5
    assert trip.report() == {
        "scan_to_cmd_n": 1, "scan_to_cmd_p50_ms": 3.0, "scan_to_cmd_p99_ms": 3.0,
    }  # fmt: skip


def test_a_scan_that_was_skipped_counts_until_a_newer_one_is_answered() -> None:
    trip = RoundTrip()
    trip.sent(5, 100 * MS)
    trip.sent(6, 120 * MS)
    trip.answered(6, 124 * MS, counts=True)
    assert trip.report() == {
        "scan_to_cmd_n": 2, "scan_to_cmd_p50_ms": 4.0, "scan_to_cmd_p99_ms": 24.0,
    }  # fmt: skip


def test_a_brain_that_is_still_starting_is_not_timed() -> None:
    trip = RoundTrip()
    trip.sent(5, 100 * MS)
    trip.answered(5, 900 * MS, counts=False)
    assert trip.report()["scan_to_cmd_n"] == 0
    assert trip.report()["scan_to_cmd_p50_ms"] is None
