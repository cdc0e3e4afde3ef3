from gigabrain_zenoh.runtime.managed_process import Backoff, RestartPolicy


def test_the_wait_doubles_from_a_fifth_of_a_second_to_five() -> None:
    patience = RestartPolicy(Backoff(deaths=100))
    waits = [patience.died(now_s=float(n), up_s=0.0) for n in range(7)]
    assert waits == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]


def test_ten_seconds_up_make_the_wait_short_again() -> None:
    patience = RestartPolicy(Backoff(deaths=100))
    assert [patience.died(1.0, 0.0), patience.died(2.0, 0.0)] == [0.2, 0.4]
    assert patience.died(12.0, 9.9) == 0.8
    assert patience.died(23.0, 10.0) == 0.2
    assert patience.died(24.0, 0.0) == 0.4


def test_the_fifth_death_within_a_minute_is_the_last() -> None:
    patience = RestartPolicy(Backoff())
    deaths = [patience.died(now_s, 20.0) for now_s in (100.0, 115.0, 130.0, 145.0, 160.0)]
    assert deaths == [0.2, 0.2, 0.2, 0.2, None]


def test_deaths_more_than_a_minute_ago_are_forgiven() -> None:
    patience = RestartPolicy(Backoff())
    deaths = [patience.died(now_s, 20.0) for now_s in (100.0, 115.0, 130.0, 145.0, 160.1, 175.2)]
    assert deaths == [0.2, 0.2, 0.2, 0.2, 0.2, 0.2]
    assert patience.died(175.3, 0.0) is None


def test_all_figures_can_be_chosen() -> None:
    patience = RestartPolicy(Backoff(1.0, 3.0, 4.0, deaths=4, window_s=10.0, reset_after_s=2.0))
    assert [patience.died(t, 0.0) for t in (0.0, 1.0, 2.0)] == [1.0, 3.0, 4.0]
    assert patience.died(11.5, 2.0) == 1.0
    assert patience.died(11.6, 0.0) == 3.0
    assert patience.died(11.7, 0.0) is None
