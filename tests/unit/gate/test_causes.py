"""The words for what holds a robot back."""

from gigabrain_schemas.base import Cause
from gigabrain_zenoh.gate import causes
from tests.unit.gate.rig import BLIND, HOT, LOST, ZONE


def test_a_latching_cause_by_name() -> None:
    kept = causes.latching((LOST, HOT, ZONE, causes.NAN_STORM))
    assert [cause.code for cause in kept] == ["motor_hot", "nan_storm"]


def test_causes_in_words() -> None:
    assert causes.in_words(()) == ""
    assert causes.in_words((HOT,)) == "a motor is hot"
    assert causes.in_words((HOT, BLIND)) == "a motor is hot; the lidar is blind"


def test_causes_in_words_leave_room_for_the_words_around_them() -> None:
    wordy = Cause(code="wordy", text="x" * 399)
    assert causes.in_words((wordy, HOT)) == "x" * 399 + ";"


def test_an_estop_by_somebody_with_an_endless_name_still_fits_into_a_message() -> None:
    cause = causes.estop("x" * 1000)
    assert cause.text == "e-stop pressed by " + "x" * 482
    assert (cause.code, cause.latching) == ("estop", True)


def test_causes_merge_by_code_and_by_whether_they_latch() -> None:
    latched = Cause(code="link_lost", text="for good", latching=True)
    again = Cause(code="link_lost", text="other words")
    assert causes.merge((LOST,), (again, HOT)) == (LOST, HOT)
    assert causes.merge((LOST,), (latched,)) == (LOST, latched)
    assert causes.merge((), (LOST, HOT)) == (LOST, HOT)
    assert causes.merge((LOST, HOT), ()) == (LOST, HOT)


def test_what_to_do_about_a_cause_follows_it() -> None:
    lost = Cause(code="link_lost", text="the body does not answer", remedy="look at its cable")
    words = "the body does not answer (look at its cable); a motor is hot"
    assert causes.in_words((lost, HOT)) == words


def test_a_button_latches_and_says_why_and_what_to_do() -> None:
    assert causes.button("the contact is open") == Cause(
        code="button",
        text="e-stop button: the contact is open",
        latching=True,
        remedy="unlock the button, or repair its wire or adapter, then release the robot",
    )
    assert len(causes.button("x" * 1000).text) == 500
