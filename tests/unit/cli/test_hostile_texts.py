"""Keys and texts of other clients, and of files, cannot move the cursor or add a line."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from gigabrain_zenoh.bus.headers import header_of
from gigabrain_zenoh.cli.app import _call
from gigabrain_zenoh.cli.faults import _run
from gigabrain_zenoh.cli.options import print_json, print_line, print_table
from gigabrain_zenoh.diagnostics.message_text import as_json
from gigabrain_zenoh.diagnostics.top import cell_text
from gigabrain_zenoh.diagnostics.topics import TopicRow, topic_table
from gigabrain_zenoh.qa.faults import suite
from gigabrain_zenoh.qa.faults.rig import Options
from gigabrain_zenoh.qa.judging import FaultResult, FaultRow, FaultRun
from gigabrain_zenoh.recording.bag_reader import print_info, read_info
from gigabrain_zenoh.recording.bag_writer import BagWriter, ReceivedMessage
from tests.unit.recording.bags import BEGIN_NS

KEY = "robot/\x1b[2Jfake\nline\x9b1m[/red]"
SHOWN = "\\x1b[2Jfake\\nline\\x9b1m[/red]"


def lines_of(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return the printed lines; each is printable."""
    lines = capsys.readouterr().out.splitlines()
    assert all(line.isprintable() for line in lines)
    return lines


def test_a_line_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    print_line(KEY)
    assert lines_of(capsys) == [f"robot/{SHOWN}"]


def test_json_is_printable_and_keeps_its_value(capsys: pytest.CaptureFixture[str]) -> None:
    value = {"key": KEY + "\U000e0001\u202e"}
    print_json(value)
    print_json(value, indent=2)
    short, *long = lines_of(capsys)
    assert json.loads(short) == json.loads("\n".join(long)) == json.loads(as_json(value)) == value
    assert as_json(value).isprintable()


def test_a_key_in_a_table_is_neither_markup_nor_control(capsys: pytest.CaptureFixture[str]) -> None:
    row = TopicRow(
        key=KEY, type=None, hz=1.0, promised_hz=None, size=1, age_s=0.1, senders=(), receivers=()
    )
    print_table(topic_table([row]))
    assert lines_of(capsys)[1].startswith(SHOWN)
    assert cell_text(KEY).isprintable()


def test_the_keys_and_notes_of_a_recording_are_escaped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hostile.mcap"
    bag = BagWriter(path, viewers=False, notes={"by\x1b[2J": "x\ny"})
    for seq in (1, 3):
        payload = json.dumps({"stamp_ns": 1, "seq": seq, "boot": 1, "tick": 1}).encode()
        bag.add(ReceivedMessage(BEGIN_NS + seq, KEY, "", payload, header_of(payload)))
    bag.finish()
    bag.close()
    print_info(read_info(path))
    first, *_, last = lines_of(capsys)
    assert first.endswith("by\\x1b[2J x\\ny")
    assert last.startswith(f"robot/{SHOWN}")
    assert _call(["bag", "check", str(path)]) == 1
    assert lines_of(capsys) == [f"{path}: robot/{SHOWN}: 1 messages are missing"]


def test_the_reason_of_a_fault_test_is_printed_as_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def run_one(
        rows: Sequence[FaultRow], options: Options, *others: Any
    ) -> list[FaultResult]:
        _, _, _, ended, _ = others
        ended(rows[0], FaultRun(verdict="FAILED", reason=KEY))
        return []

    monkeypatch.setattr(suite, "run_suite", run_one)
    _run(suite.FAULTS[:1], Options(), 1, None)
    assert f": FAILED: robot/{SHOWN} (" in lines_of(capsys)[0]


def test_an_error_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert _call(["bag", "info", "missing\x1b[2J\n.mcap"]) == 2
    assert capsys.readouterr().err == (
        "gigabrain: cannot read missing\\x1b[2J\\n.mcap: no such file or folder; check the path\n"
    )
