"""The file with the faults of an emulated body may be anything at any time."""

import asyncio
import os
from collections.abc import Mapping
from pathlib import Path, PosixPath
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gigabrain_drivers.emulators.emulator import Emulator
from gigabrain_drivers.emulators.faults import Faults
from gigabrain_drivers.emulators.process import watch
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.testing.waiting import until


class Body:
    """Stands for an emulator; its physics end when `lost` says so."""

    def __init__(self) -> None:
        self.stations = dict.fromkeys(("base", "scan"))
        self.body = SimpleNamespace(lost="")
        self.applied: list[Mapping[str, Faults]] = []

    def set(self, faults: Mapping[str, Faults]) -> None:
        self.applied.append(faults)


class Vanishing(PosixPath):
    """A file that is removed right after it was looked at."""

    def stat(self, **how: Any) -> os.stat_result:
        found = super().stat(**how)
        self.unlink()
        return found


async def watched(path: Path, caplog: pytest.LogCaptureFixture, sign: str) -> Body:
    """Watch the file until the log has `sign`."""
    caplog.set_level("INFO")
    body = Body()
    watching = asyncio.create_task(watch(cast(Emulator, body), path))
    await until(lambda: sign in caplog.text or watching.done())
    body.body.lost = "the test is over"
    with pytest.raises(BodyLost, match="the test is over"):
        await watching
    return body


async def test_a_file_that_vanishes_ends_all_faults(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = Vanishing(tmp_path / "faults.json")
    path.write_text('{"base": {"silence": true}}')
    body = await watched(path, caplog, "faults: none")
    assert body.applied[0] == {}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"bse": {"silence": true}}', "no station 'bse'; did you mean 'base'? known: base, scan"),
        ('{"base": {"silense": true}}', "unknown field `silense`"),
        ('{"base": ', "Input data was truncated"),
        (None, "Is a directory"),
    ],
)
async def test_a_file_that_cannot_be_applied_changes_nothing_and_says_why(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str | None, problem: str
) -> None:
    path = tmp_path / "faults.json"
    if text is None:
        path.mkdir()
    else:
        path.write_text(text)
    body = await watched(path, caplog, problem)
    assert body.applied == []
