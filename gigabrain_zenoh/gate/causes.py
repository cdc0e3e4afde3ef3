"""Causes of stops: a code for programs, a text and a remedy for people."""

from gigabrain_schemas.base import Cause

BOOT = Cause(
    code="boot",
    text="just started, not released yet",
    remedy="check that nobody is in its way",
)
SILENCE = Cause(
    code="silence",
    text="no valid command for 100 ms",
    remedy="check that the commander runs and reaches the robot, then enable it again",
)
STALE = Cause(
    code="stale",
    text="commands use sensor data that is too old",
    remedy="check that lidar, perception and decision keep up, then enable it again",
)
SAFETY_SILENT = Cause(
    code="safety_silent",
    text="the safety process is silent",
    remedy="start the safety process, or read its log",
)
SAFETY_STOP = Cause(
    code="safety_stop",
    text="safety stops the robot",
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
    remedy="check its power, its cable or its network",
)


BUTTON_AWAITED = Cause(
    code="button_lost",
    text="no message from the e-stop button yet",
    remedy="start its process, and check that its adapter is plugged in",
)
BUTTON_LOST = Cause(
    code="button_lost",
    text="the e-stop button is silent",
    latching=True,
    remedy="check that its process runs, then release the robot",
)
BRAIN_SILENT = frozenset(("perception_silent", "decision_silent", "control_silent"))  # in safety
LATE = BRAIN_SILENT | {
    SILENCE.code,
    STALE.code,
    SAFETY_SILENT.code,
}  # codes of processes that are too slow


def button(text: str) -> Cause:
    """Return the cause of a pressed or faulty e-stop button."""
    return Cause(
        code="button",
        text=f"e-stop button: {text}"[:500],
        latching=True,
        remedy="unlock the button, or repair its wire or adapter, then release the robot",
    )


def estop(source: str) -> Cause:
    """Return the cause of an e-stop that `source` pressed."""
    return Cause(
        code="estop",
        text=f"e-stop pressed by {source}"[:500],
        latching=True,
        remedy="find out why it was pressed",
    )


def latching(causes: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """Return those of `causes` that only a person can release."""
    return tuple(cause for cause in causes if cause.latching)


def merge(known: tuple[Cause, ...], more: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """Return `known` with the new causes of `more`; one that latches now counts as new."""
    known_keys = {(cause.code, cause.latching) for cause in known}
    return known + tuple(cause for cause in more if (cause.code, cause.latching) not in known_keys)


def in_words(causes: tuple[Cause, ...]) -> str:
    """Return `causes` as one phrase, each with its remedy in brackets.

    The phrase is short enough to be a part of a reply.
    """
    return "; ".join(map(_with_remedy, causes))[:400]


def _with_remedy(cause: Cause) -> str:
    return f"{cause.text} ({cause.remedy})" if cause.remedy else cause.text
