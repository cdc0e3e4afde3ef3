"""Causes, thresholds, and the tables of the safety page: the same words everywhere."""

from pathlib import Path

from msgspec.structs import fields

from gigabrain_drivers.driver.gatekeeper import UNREADABLE
from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Thresholds
from gigabrain_zenoh.gate import causes
from gigabrain_zenoh.safety.catalogue import CAUSES, WARNINGS, cause

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "safety.md"
OTHERS = (
    *(value for value in vars(causes).values() if isinstance(value, Cause)),
    causes.estop("NAME"),
    causes.button("WHAT"),
    UNREADABLE,
)


def rows(begin: str, end: str) -> list[list[str]]:
    """The cells of every row of the tables between two headings, code or name first."""
    part = PAGE.read_text().partition(begin)[2].partition(end)[0]
    found = [[cell.strip() for cell in line[1:-1].split("|")] for line in part.splitlines()]
    return [cells for cells in found if cells[0].startswith("`")]


def causes_told() -> list[list[str]]:
    return rows("### Causes that stop", "## What stops a robot")


def test_the_page_has_every_cause_with_its_sentence_and_its_remedy() -> None:
    for one in (*CAUSES.values(), *OTHERS):
        latches = "yes" if one.latching else ""
        assert [f"`{one.code}`", one.text, one.remedy, latches] in causes_told()
    for warning in WARNINGS.values():
        assert [f"`{warning.code}`", warning.text, warning.remedy] in causes_told()


def test_the_page_has_no_cause_that_there_is_not() -> None:
    known = {one.code for one in (*CAUSES.values(), *WARNINGS.values(), *OTHERS)}
    assert {row[0].strip("`") for row in causes_told()} == known


def test_the_page_has_every_threshold_with_its_default() -> None:
    table = rows("### Thresholds", "### Causes that stop")
    told = {row[0].strip("`"): float(row[1].split()[0]) for row in table}
    assert told == {field.name: field.default for field in fields(Thresholds)}


def test_every_cause_says_what_to_do_about_it() -> None:
    for one in (*CAUSES.values(), *WARNINGS.values(), *OTHERS):
        assert one.remedy
        assert one.text


def test_a_cause_may_be_said_with_figures() -> None:
    assert cause("battery_low", "battery at 14 %") == Cause(
        code="battery_low", text="battery at 14 %", remedy="charge it soon"
    )
    assert cause("collision").latching
