"""The safety page lists the causes, warnings and thresholds of the code."""

from pathlib import Path

from msgspec.structs import fields

from gigabrain_drivers.driver.gatekeeper import UNREADABLE
from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Thresholds
from gigabrain_zenoh.gate import causes
from gigabrain_zenoh.safety.catalogue import CAUSES, WARNINGS, cause

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "safety.md"
GATE_CAUSES = (
    *(value for value in vars(causes).values() if isinstance(value, Cause)),
    causes.estop("NAME"),
    causes.button("WHAT"),
    UNREADABLE,
)


def rows(begin: str, end: str) -> list[list[str]]:
    """Return the cells of all table rows between two headings; the first is a code or name."""
    part = PAGE.read_text().partition(begin)[2].partition(end)[0]
    found = [[cell.strip() for cell in line[1:-1].split("|")] for line in part.splitlines()]
    return [cells for cells in found if cells[0].startswith("`")]


def documented_causes() -> list[list[str]]:
    return rows("### Causes that stop", "## What stops a robot")


def test_the_page_has_every_cause_with_its_text_and_remedy() -> None:
    for each in (*CAUSES.values(), *GATE_CAUSES):
        latches = "yes" if each.latching else ""
        assert [f"`{each.code}`", each.text, each.remedy, latches] in documented_causes()
    for warning in WARNINGS.values():
        assert [f"`{warning.code}`", warning.text, warning.remedy] in documented_causes()


def test_the_page_has_no_unknown_cause() -> None:
    known = {each.code for each in (*CAUSES.values(), *WARNINGS.values(), *GATE_CAUSES)}
    assert {row[0].strip("`") for row in documented_causes()} == known


def test_the_page_has_every_threshold_with_its_default() -> None:
    table = rows("### Thresholds", "### Causes that stop")
    documented = {row[0].strip("`"): float(row[1].split()[0]) for row in table}
    assert documented == {field.name: field.default for field in fields(Thresholds)}


def test_every_cause_has_a_text_and_a_remedy() -> None:
    for each in (*CAUSES.values(), *WARNINGS.values(), *GATE_CAUSES):
        assert each.remedy
        assert each.text


def test_a_cause_may_have_a_text_with_figures() -> None:
    assert cause("battery_low", "battery at 14 %") == Cause(
        code="battery_low", text="battery at 14 %", remedy="charge it soon"
    )
    assert cause("collision").latching
