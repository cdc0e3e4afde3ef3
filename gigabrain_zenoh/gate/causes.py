"""Why a robot is held back: codes for programs, sentences for people."""

from gigabrain_schemas.base import Cause

BOOT = Cause(
    code="boot",
    text="just started; nobody has released it yet",
    remedy="see that nobody is in its way",
)
SILENCE = Cause(
    code="silence",
    text="no good command for 100 ms",
    remedy="see that whoever drives runs and reaches the robot, then enable it again",
)
STALE = Cause(
    code="stale",
    text="commands rest on sensor data that is too old",
    remedy="see that the lidar, perception and decision keep up, then enable it again",
)
SAFETY_SILENT = Cause(
    code="safety_silent",
    text="the safety process is silent",
    remedy="start the safety process, or read its log to see why it ended",
)
SAFETY_STOP = Cause(
    code="safety_stop",
    text="the safety process says stop",
    remedy="read the log of the safety process",
)
NOT_FINITE = Cause(
    code="nan",
    text="the commander sent a value that is not a number",
    remedy="repair the program that sends it",
)
NAN_STORM = Cause(
    code="nan_storm",
    text="the commander kept sending values that are not numbers",
    latching=True,
    remedy="repair the program that sends them, then release the robot",
)
LINK_LOST = Cause(
    code="link_lost",
    text="the body does not answer",
    remedy="look at its power, its cable or its network",
)


BUTTON_AWAITED = Cause(
    code="button_lost",
    text="the e-stop button has not been heard yet",
    remedy="start its process, and see that its adapter is plugged in",
)
BUTTON_LOST = Cause(
    code="button_lost",
    text="the e-stop button is silent",
    latching=True,
    remedy="see that its process runs, then release the robot",
)
BRAIN_SILENT = frozenset(("perception_silent", "decision_silent", "control_silent"))  # safety's
LATE = BRAIN_SILENT | {SILENCE.code, STALE.code, SAFETY_SILENT.code}  # somebody is too slow


def button(text: str) -> Cause:
    """The e-stop button is pressed, or cannot be believed."""
    return Cause(
        code="button",
        text=f"e-stop button: {text}"[:500],
        latching=True,
        remedy="let the button go, or mend its wire or adapter, then release the robot",
    )


def estop(source: str) -> Cause:
    """An e-stop, by whom."""
    return Cause(
        code="estop",
        text=f"e-stop pressed by {source}"[:500],
        latching=True,
        remedy="find out why it was pressed",
    )


def latching(causes: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """Those of `causes` that only a person releases."""
    return tuple(cause for cause in causes if cause.latching)


def merge(known: tuple[Cause, ...], more: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """`known`, and those of `more` that are new; one that has come to latch counts as new."""
    held = {(cause.code, cause.latching) for cause in known}
    return known + tuple(cause for cause in more if (cause.code, cause.latching) not in held)


def in_words(causes: tuple[Cause, ...]) -> str:
    """`causes` as one phrase, short enough to stand in a reply with words around it.

    What to do about a cause follows it in brackets.
    """
    return "; ".join(map(_in_words, causes))[:400]


def _in_words(cause: Cause) -> str:
    return f"{cause.text} ({cause.remedy})" if cause.remedy else cause.text
