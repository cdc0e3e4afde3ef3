"""Values that a device repeats: when the newest one expires."""

from gigabrain_drivers.links.recent import Recent

S, MS = 1_000_000_000, 1_000_000


def recent_with(*times_ns: int) -> Recent[float]:
    recent = Recent[float]()
    for now_ns in times_ns:
        recent.put(20.0, now_ns)
    return recent


def test_there_is_no_value_at_the_start() -> None:
    assert recent_with().get(0) is None


def test_a_frequent_value_expires_after_two_seconds() -> None:
    recent = recent_with(*range(S, 2 * S + 1, 20 * MS))
    assert recent.get(4 * S) == 20.0
    assert recent.get(4 * S + 1) is None


def test_a_value_every_five_seconds_expires_after_three_periods() -> None:
    recent = recent_with(*range(0, 61 * S, 5 * S))
    assert recent.get(75 * S) == 20.0
    assert recent.get(75 * S + 1) is None


def test_a_single_value_expires_after_thirty_seconds() -> None:
    assert recent_with(S).get(31 * S) == 20.0
    assert recent_with(S).get(31 * S + 1) is None


def test_values_that_arrive_together_after_a_delay_do_not_shorten_the_next_period() -> None:
    recent = recent_with(*range(0, 61 * S, 5 * S), 70 * S, 70 * S)
    assert recent.get(75 * S) == 20.0


def test_a_value_after_an_expired_one_has_no_period_yet() -> None:
    recent = recent_with(*range(0, 61 * S, 5 * S), 600 * S)
    assert recent.get(630 * S) == 20.0
    assert recent.get(630 * S + 1) is None
