"""A machine that is too small for its robot is told in one line, a pause of it is not."""

from gigabrain_zenoh.launch.demo import Capacity

SMALL = (
    "this machine is too small for the robot, or too busy: its time runs at 60% of real time; "
    "run fewer robots on it, or stop other programs"
)


def run(
    capacity: Capacity, share: float, seconds: int, begin_s: int = 0, held: bool = False
) -> str:
    """Look ten times a second at a robot whose clock runs at a share of real time."""
    for look in range(10 * seconds + 1):
        now_s = begin_s + look / 10
        capacity.compare(now_s, begin_s + share * look / 10, held=held and look % 10 == 5)
    return capacity.problem


def test_time_that_keeps_being_lost_is_reported_after_5_s() -> None:
    assert run(Capacity(), 0.6, 4) == ""
    assert run(Capacity(), 0.6, 6) == SMALL


def test_what_was_reported_stays_reported() -> None:
    capacity = Capacity()
    run(capacity, 0.6, 6)
    assert run(capacity, 1.0, 20, begin_s=6) == SMALL


def test_a_robot_that_keeps_its_time_is_fine() -> None:
    assert run(Capacity(), 0.97, 60) == ""


def test_a_pause_of_the_machine_passes() -> None:
    capacity = Capacity()
    for begin_s in range(0, 60, 5):
        run(capacity, 0.5, 3, begin_s)
        run(capacity, 1.0, 2, begin_s + 3)
    assert capacity.problem == ""


def test_a_clock_that_stands_still_is_another_fault() -> None:
    assert run(Capacity(), 0.0, 60) == ""


def test_a_brain_that_gets_too_little_time_is_reported_though_the_clock_goes_on() -> None:
    assert "the brain is late" in run(Capacity(), 1.0, 6, held=True)


def test_a_start_begins_anew() -> None:
    capacity = Capacity()
    for begin_s in range(0, 60, 3):
        run(capacity, 0.6, 3, begin_s)
        capacity.restart()
    assert capacity.problem == ""
