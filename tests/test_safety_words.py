"""Causes, thresholds, and the tables of the safety page: the same words everywhere."""

import re
from pathlib import Path

from msgspec.structs import fields

from gigabrain_drivers.latch import UNREADABLE
from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Thresholds
from gigabrain_zenoh import causes
from gigabrain_zenoh.safety.words import CAUSES, WARNINGS, say

PAGE = Path(__file__).parent.parent / "docs" / "safety.md"
OTHERS = (
    *(value for value in vars(causes).values() if isinstance(value, Cause)),
    causes.estop("NAME"),
    causes.button("WHAT"),
    UNREADABLE,
)


def rows() -> list[list[str]]:
    """The cells of every row of every table on the page."""
    lines = PAGE.read_text().splitlines()
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in lines if line[:1] == "|"]


def test_the_page_has_every_cause_with_its_sentence_and_its_remedy() -> None:
    for cause in (*CAUSES.values(), *OTHERS):
        latches = "yes" if cause.latching else ""
        assert [f"`{cause.code}`", cause.text, cause.remedy, latches] in rows()
    for warning in WARNINGS.values():
        assert [f"`{warning.code}`", warning.text, warning.remedy] in rows()


def test_the_page_has_no_cause_that_there_is_not() -> None:
    known = {cause.code for cause in (*CAUSES.values(), *WARNINGS.values(), *OTHERS)}
    told = {row[0].strip("`") for row in rows() if len(row) in (3, 4) and row[0].startswith("`")}
    assert told - known <= {field.name for field in fields(Thresholds)}  # some share a name
    assert known <= told


def test_the_page_has_every_threshold_with_its_default() -> None:
    told = {
        row[0].strip("`"): float(match[0])
        for row in rows()
        if len(row) == 3 and (match := re.match(r"[\d.]+", row[1]))
    }
    assert told == {field.name: field.default for field in fields(Thresholds)}


def test_every_cause_says_what_to_do_about_it() -> None:
    for cause in (*CAUSES.values(), *WARNINGS.values(), *OTHERS):
        assert cause.remedy
        assert cause.text


def test_a_cause_may_be_said_with_figures() -> None:
    assert say("battery_low", "battery at 14 %") == Cause(
        code="battery_low", text="battery at 14 %", remedy="charge it soon"
    )
    assert say("collision").latching
