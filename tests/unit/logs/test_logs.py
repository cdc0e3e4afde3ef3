"""Logs of a process: a JSON line for each record in the run folder, and on the console."""

import contextlib
import io
import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_zenoh import logs
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.host import run_folders

log = logging.getLogger("a.module")


@pytest.fixture(autouse=True)
def root_as_it_was() -> Iterator[None]:
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    yield
    for handler in [h for h in root.handlers if h not in handlers]:
        root.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()
    root.setLevel(level)


class Said:
    """The text written to stderr since the test began."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys, self._text = capsys, ""

    def getvalue(self) -> str:
        logs.flush()
        self._text += self._capsys.readouterr().err
        return self._text


@pytest.fixture
def stderr(capsys: pytest.CaptureFixture[str]) -> Said:
    return Said(capsys)


def lines(path: Path) -> list[dict[str, Any]]:
    logs.flush()
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_record_is_one_json_line_in_the_run_folder_and_on_the_console(
    tmp_path: Path, stderr: Said
) -> None:
    logs.setup("driver", tmp_path / "run", json_console=True)
    log.info("the body answers", extra={"data": {"event": "ready", "port": 7447}})
    written = lines(tmp_path / "run" / "driver.jsonl")
    assert [json.loads(line) for line in stderr.getvalue().splitlines()] == written
    assert written[0].pop("t") > 1_700_000_000_000_000_000
    assert written == [
        {
            "level": "info",
            "process": "driver",
            "event": "ready",
            "text": "the body answers",
            "port": 7447,
        }
    ]


def test_a_record_without_an_event_is_a_log_event(stderr: Said) -> None:
    logs.setup("control", None, json_console=True)
    log.warning("slow: %d ms", 31)
    said = json.loads(stderr.getvalue())
    assert (said["event"], said["text"], said["level"]) == ("log", "slow: 31 ms", "warning")


def test_data_cannot_overwrite_who_spoke_and_when(stderr: Said) -> None:
    logs.setup("control", None, json_console=True)
    log.info("text", extra={"data": {"process": "gate", "t": 1, "level": "x", "text": "y"}})
    said = json.loads(stderr.getvalue())
    assert (said["process"], said["level"], said["text"]) == ("control", "info", "text")
    assert said["t"] > 1


def test_an_exception_becomes_a_traceback_on_one_line(tmp_path: Path, stderr: Said) -> None:
    logs.setup("control", tmp_path, json_console=False)
    try:
        raise ValueError("wheel fell off")
    except ValueError:
        log.exception("stopping")
    (said,) = lines(tmp_path / "control.jsonl")
    assert said["traceback"].startswith("Traceback (most recent call last):\n")
    assert said["traceback"].endswith("ValueError: wheel fell off")
    assert "    ValueError: wheel fell off" in stderr.getvalue().splitlines()


CYCLE: list[Any] = []
CYCLE.append(CYCLE)


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (np.float64(1.5), 1.5),
        (np.float32(0.5), 0.5),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (np.arange(3), [0, 1, 2]),
        (float("nan"), None),
        (Path("a/b"), "a/b"),
        ({np.int64(1): {1}}, {"1": [1]}),
        (ValueError("x"), "x"),
        (10**30, 10**30),
        ("\udc80", "'\\udc80'"),
        (CYCLE, "[[...]]"),
    ],
)
def test_no_value_breaks_a_line(value: object, written: object, stderr: Said) -> None:
    logs.setup("control", None, json_console=True)
    log.info("text", extra={"data": {"value": value}})
    assert json.loads(stderr.getvalue())["value"] == written


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("name", "value", "coloured"),
    [("NO_COLOR", "", True), ("NO_COLOR", "1", False), ("TERM", "dumb", False)],
)
def test_colour_is_for_terminals_and_no_color_is_respected(
    name: str, value: str, coloured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "")
    monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    logs.setup("control", None, json_console=False)
    log.error("x")
    logs.flush()
    assert ("\033[31m" in terminal.getvalue()) is coloured


def test_nothing_is_coloured_in_a_pipe(monkeypatch: pytest.MonkeyPatch, stderr: Said) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    logs.setup("control", None, json_console=False)
    log.error("x")
    assert "\033" not in stderr.getvalue()


def test_the_level_is_obeyed_and_a_mistyped_one_is_suggested(stderr: Said) -> None:
    logs.setup("control", None, json_console=True, level="warning")
    log.info("x")
    assert stderr.getvalue() == ""
    with pytest.raises(UnknownName, match="no log level 'warnign'; did you mean 'warning'"):
        logs.setup("control", None, json_console=True, level="warnign")


def test_a_second_setup_replaces_the_first_and_the_file_goes_on(
    tmp_path: Path, stderr: Said
) -> None:
    for _ in range(2):
        logs.setup("control", tmp_path, json_console=True)
        log.info("x")
    assert len(lines(tmp_path / "control.jsonl")) == 2
    assert len(stderr.getvalue().splitlines()) == 2


def test_a_run_folder_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    said = r"^cannot write the run folder .*/file/run: a part of the path is .*; make it writable"
    with pytest.raises(ConfigError, match=said):
        logs.setup("control", tmp_path / "file" / "run", json_console=True)
    with pytest.raises(ConfigError, match="a part of the path is a file"):
        run_folders.new_run_dir(tmp_path / "file", "demo")
    (tmp_path / "control.jsonl").mkdir()
    with pytest.raises(ConfigError, match="it is a folder"):
        logs.setup("control", tmp_path, json_console=True)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_reported_once_and_loses_no_console_line(
    tmp_path: Path, stderr: Said
) -> None:
    (tmp_path / "control.jsonl").symlink_to("/dev/full")
    logs.setup("control", tmp_path, json_console=True)
    for text in ("one", "two", "three"):
        log.info(text)
    logs.flush()  # the file's complaint is a record of its own
    said = [json.loads(line)["text"] for line in stderr.getvalue().splitlines()]
    (complaint,) = (text for text in said if "control.jsonl" in text)
    assert complaint.endswith("control.jsonl: [Errno 28] No space left on device")
    assert [text for text in said if text != complaint] == ["one", "two", "three"]
    logs.setup("control", None, json_console=True)


def test_a_run_folder_is_named_by_time_label_and_pid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr("os.getpid", lambda: 42)
    first, second = (run_folders.new_run_dir(None, "demo random:7") for _ in range(2))
    assert first.parent == tmp_path / "gigabrain" / "runs"
    assert re.fullmatch(r"\d{8}T\d{6}Z-demo-random-7-42", first.name)
    assert first.is_dir()
    assert second.is_dir()
    assert first != second


@pytest.mark.parametrize("given", ["", "relative/path"])
def test_without_a_usable_state_folder_the_home_holds_the_runs(
    given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", given)
    monkeypatch.setenv("HOME", str(tmp_path))
    made = run_folders.new_run_dir(None, "up")
    assert made.parent == tmp_path / ".local" / "state" / "gigabrain" / "runs"


def test_without_a_home_it_says_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home(path: str) -> str:
        return path  # as `expanduser` does for a user that nobody knows

    monkeypatch.setenv("XDG_STATE_HOME", "")
    monkeypatch.setattr(os.path, "expanduser", no_home)
    with pytest.raises(ConfigError, match="set XDG_STATE_HOME"):
        run_folders.new_run_dir(None, "up")


def test_a_fault_is_logged_once_when_it_begins_and_once_when_it_ends(stderr: Said) -> None:
    logs.setup("perception", None, json_console=True)
    fault = logs.Fault(log)
    fault.end("nothing was wrong")
    for age_ms in (310, 320, 330):
        fault.begin(f"scan is {age_ms} ms old", {"age_ms": age_ms})
    assert fault.active
    fault.end("scans are back")
    fault.end("scans are back")
    assert not fault.active
    fault.begin("scan is 300 ms old")
    said = [json.loads(line) for line in stderr.getvalue().splitlines()]
    assert [(s["level"], s["event"], s["text"], s.get("times")) for s in said] == [
        ("warning", "fault", "scan is 310 ms old", None),
        ("info", "fault ended", "scans are back", 3),
        ("warning", "fault", "scan is 300 ms old", None),
    ]
    assert said[0]["age_ms"] == 310
