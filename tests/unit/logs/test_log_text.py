"""Records as lines that people read."""

import logging
import re

import pytest

from gigabrain_zenoh import logs


def test_a_library_whose_arguments_do_not_fit_loses_no_line() -> None:
    record = logging.makeLogRecord({"msg": "%d beams", "args": ("many",), "levelno": 20})
    assert logs.fields(record, "control")["text"] == "%d beams ('many',)"


def test_addresses_have_no_password() -> None:
    try:
        raise ValueError("no picture from rtsp://admin:pass@word@cam:554/live")
    except ValueError as error:
        about = (type(error), error, error.__traceback__)
    record = logging.LogRecord("x", 20, "", 0, "%s, mail a@b", ("http://u:word@cam",), about)
    record.data = {"value": "rtsp://u:word@cam", "count": 3}
    found = logs.fields(record, "camera")
    assert (found["text"], found["value"]) == ("http://…@cam, mail a@b", "rtsp://…@cam")
    assert found["traceback"].endswith("no picture from rtsp://…@cam:554/live")
    assert found["count"] == 3


def test_a_console_line_reads_time_process_level_text_and_data() -> None:
    record = {
        "t": 1_700_000_000_000_000_000,
        "level": "warning",
        "process": "driver",
        "event": "silence",
        "text": "no command",
        "age_s": 0.1234567891,
        "source": "control",
        "why": "late again",
        "causes": ["a", "b"],
    }
    line = logs.readable(record)
    assert re.fullmatch(r"\d\d:\d\d:20 .*", line)
    assert line[9:] == (
        "driver     warning  no command age_s=0.123457 source=control "
        'why="late again" causes=["a","b"]'
    )


def test_a_record_without_text_shows_its_event() -> None:
    record = {"t": 0, "level": "info", "process": "perception", "event": "ready"}
    assert logs.readable(record)[9:] == "perception info     ready"


def test_colour_marks_the_level_alone() -> None:
    record = {"t": 0, "level": "error", "process": "driver", "event": "log", "text": "lost"}
    assert logs.readable(record, colour=True)[9:] == "driver     \033[31merror   \033[0m lost"


def test_text_from_outside_cannot_move_the_cursor() -> None:
    record = {
        "t": 0,
        "level": "info",
        "process": "p\r",
        "event": "log",
        "text": "\033[2J\n",
        "k": "\a",
    }
    assert logs.readable(record)[9:] == "p\\r        info     \\x1b[2J\\n k=\\x07"


@pytest.mark.parametrize(
    ("number", "name"),
    [(5, "debug"), (10, "debug"), (25, "info"), (50, "critical"), (99, "critical")],
)
def test_foreign_levels_take_the_nearest_name_below(number: int, name: str) -> None:
    assert logs.level_of(logging.makeLogRecord({"levelno": number})) == name
