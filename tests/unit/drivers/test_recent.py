"""Values that a device repeats: how long the last one counts once no more come."""

from gigabrain_drivers.links.recent import Recent

S, MS = 1_000_000_000, 1_000_000


def repeated(*when_ns: int) -> Recent[float]:
    recent = Recent[float]()
    for now_ns in when_ns:
        recent.put(20.0, now_ns)
    return recent


def test_there_is_none_before_the_first() -> None:
    assert repeated().get(0) is None


def test_a_value_that_came_often_expires_after_two_seconds() -> None:
    recent = repeated(*range(S, 2 * S + 1, 20 * MS))
    assert recent.get(4 * S) == 20.0
    assert recent.get(4 * S + 1) is None


def test_a_value_that_comes_every_five_seconds_stays_for_three_of_its_periods() -> None:
    recent = repeated(*range(0, 61 * S, 5 * S))
    assert recent.get(75 * S) == 20.0
    assert recent.get(75 * S + 1) is None


def test_a_value_that_came_once_stays_for_half_a_minute() -> None:
    assert repeated(S).get(31 * S) == 20.0
    assert repeated(S).get(31 * S + 1) is None


def test_values_that_come_at_once_after_a_delay_do_not_make_the_next_one_late() -> None:
    recent = repeated(*range(0, 61 * S, 5 * S), 70 * S, 70 * S)
    assert recent.get(75 * S) == 20.0


def test_a_value_that_comes_again_after_it_expired_has_no_period_yet() -> None:
    recent = repeated(*range(0, 61 * S, 5 * S), 600 * S)
    assert recent.get(630 * S) == 20.0
    assert recent.get(630 * S + 1) is None
