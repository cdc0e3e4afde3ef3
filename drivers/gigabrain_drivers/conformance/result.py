"""What a check found."""

from typing import Literal, NamedTuple

Verdict = Literal["pass", "fail", "n/a"]


class NotApplicable(Exception):
    """The check says nothing about this link; the text says why. Never counted as passed."""


class Failed(Exception):
    """The driver did not come as far as the check needs; the text says where it stopped."""


class Finding(NamedTuple):
    """What was measured, and whether that is good enough."""

    ok: bool
    measured: str


class Result(NamedTuple):
    """One line of the table."""

    check: str
    criterion: str
    measured: str
    verdict: Verdict
