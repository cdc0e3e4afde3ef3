"""Repeated stop tests are judged by their worst time, and reported with the median."""

from pathlib import Path

import pytest

from gigabrain_zenoh.qa.conformance import kit
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot
from gigabrain_zenoh.qa.judging import Finding, summary


def test_the_worst_and_the_median_of_each_time_are_reported() -> None:
    found = [
        Finding(True, "", {"known": known, "at rest": rest})
        for known, rest in ((20.0, 160.0), (60.0, 140.0), (40.0, 150.0))
    ]
    assert summary(found) == (
        "worst of 3: known after 60, median 40 ms; at rest after 160, median 150 ms"
    )


def test_one_failure_among_many_is_counted_and_named() -> None:
    found = [Finding(True, "fine", {"known": 1.0}), Finding(False, "still moving")]
    assert summary([*found, found[0]]) == (
        "failed 1 times: still moving; worst of 3: known after 1, median 1 ms"
    )


def test_a_single_try_reports_its_measurement() -> None:
    assert summary([Finding(True, "at rest after 3 ticks", {"at rest": 60.0})]) == (
        "at rest after 3 ticks"
    )


@pytest.mark.slow
async def test_only_the_stops_are_repeated(tmp_path: Path) -> None:
    messages: list[str] = []
    results = await kit.check("mock", "sim", tmp_path, messages.append, repeat=2)
    assert [result for result in results if result.verdict == "FAILED"] == []
    assert [text for text in messages if "2 of 2" in text] == [
        "stops on silence, 2 of 2",
        "stops on SIGKILL, 2 of 2",
    ]
    assert messages.count("opens") == 1
    silent = next(result for result in results if result.check == "stops on silence")
    assert silent.measured.startswith("worst of 2: at rest after ")


@pytest.mark.parametrize(
    ("name", "promise"),
    [
        ("mycustombot", "150 ms (firmware_line.md)"),
        ("turtlebot3_burger", "500 ms (OpenCR's firmware)"),
        ("alpha", "100 ms (firmware_alpha.md)"),
    ],
)
async def test_a_body_is_judged_by_the_timeout_of_its_firmware(
    name: str, promise: str, tmp_path: Path
) -> None:
    async with CheckedRobot(name, "emulated", tmp_path) as subject:
        assert subject.promise == promise
