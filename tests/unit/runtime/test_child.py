import pytest

from gigabrain_zenoh import logs
from gigabrain_zenoh.host.terminal import LineSplitter
from gigabrain_zenoh.runtime.child import as_record


def test_lines_of_any_cut_are_put_together() -> None:
    lines = LineSplitter()
    assert lines.feed(b"on") == []
    assert lines.feed(b"e\ntwo\n\n  \nthr") == [b"one", b"two"]
    assert lines.end() == b"thr"
    assert lines.end() == b""


def test_a_line_without_end_does_not_grow_for_ever() -> None:
    lines = LineSplitter()
    pieces = [piece for _ in range(100) for piece in lines.feed(b"x" * 65_536)]
    assert sum(map(len, pieces)) >= 6_000_000
    assert max(map(len, pieces)) == 327_680


def test_a_record_with_fields_of_the_wrong_kind_is_put_right() -> None:
    record = as_record(b'{"event": "ready", "t": "noon", "level": 3, "port": 7}', "driver")
    assert record.pop("t") > 1_700_000_000_000_000_000
    assert record == {"event": "ready", "level": "info", "process": "driver", "port": 7}


@pytest.mark.parametrize(
    ("level", "shown"),
    [("WARN", "warning"), ("Error", "error"), ("fatal", "critical"), ("loud", "info")],
)
def test_a_record_of_another_library_has_a_level_and_a_time_of_ours(level: str, shown: str) -> None:
    line = f'{{"event": "started", "level": "{level}", "t": {10**30}}}'
    record = as_record(line.encode(), "lamp")
    assert (record["level"], record["event"]) == (shown, "started")
    assert logs.readable(record)


def test_output_of_a_library_holds_no_password_of_an_address() -> None:
    line = b"[ERROR] cannot find rtsp://admin:pass@word@cam:554/live in this file"
    text = as_record(line, "camera")["text"]
    assert text == "[ERROR] cannot find rtsp://…@cam:554/live in this file"


def test_deeply_nested_output_is_text() -> None:
    assert as_record(b"[" * 100_000, "driver")["event"] == "output"
