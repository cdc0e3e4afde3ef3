"""Why a robot is held back: codes for programs, sentences for people."""

from gigabrain_schemas.base import Cause

BOOT = Cause(code="boot", text="just started; nobody has released it yet")
SILENCE = Cause(code="silence", text="no good command for 100 ms")
STALE = Cause(code="stale", text="commands rest on sensor data that is too old")
SAFETY_SILENT = Cause(code="safety_silent", text="the safety process is silent")
SAFETY_STOP = Cause(code="safety_stop", text="the safety process says stop")
NOT_FINITE = Cause(code="nan", text="the commander sent a value that is not a number")
NAN_STORM = Cause(
    code="nan_storm", text="the commander kept sending values that are not numbers", latching=True
)
LINK_LOST = Cause(code="link_lost", text="the body does not answer")


def estop(source: str) -> Cause:
    """An e-stop, by whom."""
    return Cause(code="estop", text=f"e-stop pressed by {source}"[:500], latching=True)


def latching(causes: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """Those of `causes` that only a person releases."""
    return tuple(cause for cause in causes if cause.latching)


def merge(known: tuple[Cause, ...], more: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """`known`, and those of `more` that are new; one that has come to latch counts as new."""
    held = {(cause.code, cause.latching) for cause in known}
    return known + tuple(cause for cause in more if (cause.code, cause.latching) not in held)


def in_words(causes: tuple[Cause, ...]) -> str:
    """`causes` as one phrase, short enough to stand in a reply with words around it."""
    return "; ".join(cause.text for cause in causes)[:400]
