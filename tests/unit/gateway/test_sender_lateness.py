"""How late a command is, by the clocks of its sender and of this host, which may differ."""

import pytest

from gigabrain_zenoh.gateway.commander import Lateness

MS, S = 1_000_000, 1_000_000_000


def driven(lateness: Lateness, begin_ns: int, offset_ns: int, seconds: int = 15) -> Lateness:
    """Return the state after commands each 50 ms, whose delay is the offset and 2 ms."""
    for ns in range(begin_ns, begin_ns + seconds * S, 50 * MS):
        lateness = lateness.then(ns - offset_ns - 2 * MS, ns, ns)
        assert lateness.now_ns == 0
    return lateness


@pytest.mark.parametrize("offset_ns", [360 * MS, 5 * S, -5 * S, 7200 * S])
def test_clocks_that_have_parted_in_a_pause_do_not_make_a_sender_late(offset_ns: int) -> None:
    lateness = driven(Lateness(), 100 * S, 0)
    driven(lateness, 3700 * S, offset_ns)


def test_a_pause_within_the_windows_forgets_no_delay() -> None:
    lateness = driven(Lateness(), 100 * S, 0)
    after = lateness.then(119 * S - 800 * MS, 119 * S, 119 * S)
    assert after.now_ns == 798 * MS


def test_what_comes_after_a_long_freeze_of_the_network_is_late() -> None:
    lateness = driven(Lateness(), 100 * S, 0)
    for second in range(60):  # sent all the while, and handed over at once
        sent_ns, arrived_ns = (115 + second) * S, 175 * S + second * MS
        lateness = lateness.then(sent_ns, arrived_ns, arrived_ns)
        assert lateness.now_ns == arrived_ns - sent_ns - 2 * MS
