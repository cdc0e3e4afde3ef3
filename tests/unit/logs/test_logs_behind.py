"""Writing logs holds up nothing: not the event loop, not the end of the process."""

import contextlib
import fcntl
import json
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from gigabrain_zenoh import logs
from gigabrain_zenoh.diagnostics.log_reader import LogFilter, read

log = logging.getLogger("a.module")
PIPE_BYTES = 4096


@contextlib.contextmanager
def unread() -> Iterator[IO[bytes]]:
    """The reading end of a console that nobody reads; the root logger as it was, afterwards."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    read_fd, write_fd = os.pipe()
    fcntl.fcntl(write_fd, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    with os.fdopen(read_fd, "rb") as pipe, os.fdopen(write_fd, "w") as console:
        before, sys.stderr = sys.stderr, console
        yield pipe
        sys.stderr = before
        for handler in [h for h in root.handlers if h not in handlers]:
            root.removeHandler(handler)
            handler.close()
        root.setLevel(level)


@pytest.mark.long
def test_a_console_that_nobody_reads_holds_up_neither_the_program_nor_its_log_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "LAST_WORDS_S", 60.0)
    with unread() as pipe:
        logs.setup("driver", tmp_path, json_console=True)
        file, console = (
            h for h in logging.getLogger().handlers if isinstance(h, logs.QueuedHandler)
        )
        for i in range(1500):
            log.info("line %d", i)
            if i % 100 == 99:
                file.flush()
        lost = console.lost
        assert 400 < lost < 500  # a thousand wait, and a pipe full is with the kernel
        written = [
            json.loads(line)["text"]
            for line in (tmp_path / "driver.jsonl").read_text().splitlines()
        ]
        assert written == [f"line {i}" for i in range(1500)]
        texts = [json.loads(pipe.readline())["text"] for _ in range(1500 - lost)]
        assert texts == [f"line {i}" for i in range(1500 - lost)]
        log.info("read again")
        assert json.loads(pipe.readline())["text"] == "read again"
        said = json.loads(pipe.readline())
        assert said["text"] == f"{lost} records did not reach the console"
        assert said["level"] == "warning"


def test_a_log_file_is_rotated_and_all_that_is_kept_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "FILE_BYTES", 2000)
    with unread() as pipe:
        logs.setup("driver", tmp_path, json_console=False, level="warning")
        for i in range(200):
            log.warning("line %03d", i)
            pipe.readline()
        logs.flush()
        sizes = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
        assert sorted(sizes) == ["driver.jsonl", "driver.jsonl.1", "driver.jsonl.2"]
        assert max(sizes.values()) <= 2000
        texts = [str(line["text"]) for line in read(tmp_path, LogFilter(process="driver"), 1000)]
        assert texts == [f"line {i:03d}" for i in range(200 - len(texts), 200)]
        assert len(texts) > 40
