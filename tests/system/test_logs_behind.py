"""Writing logs holds up nothing: not the event loop, not the end of the process."""

import contextlib
import fcntl
import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from gigabrain_zenoh import logs

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


def test_a_console_that_nobody_reads_does_not_keep_a_process_from_ending() -> None:
    program = (
        "import logging, os; from gigabrain_zenoh import logs; "
        "logs.setup('driver', None, json_console=True); "
        "[logging.info('x' * 100) for _ in range(200)]; logs.flush(); os._exit(7)"
    )
    read_fd, write_fd = os.pipe()
    fcntl.fcntl(write_fd, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    try:
        done = subprocess.run((sys.executable, "-c", program), stderr=write_fd, timeout=60)
    finally:
        os.close(read_fd)
        os.close(write_fd)
    assert done.returncode == 7


def test_last_words_are_written_before_a_process_ends(tmp_path: Path) -> None:
    program = (
        "import logging, os, sys; from pathlib import Path; from gigabrain_zenoh import logs; "
        "logs.setup('driver', Path(sys.argv[1]), json_console=True); "
        "[logging.info('line %d', i) for i in range(500)]; logs.flush(); os._exit(0)"
    )
    done = subprocess.run(
        (sys.executable, "-c", program, str(tmp_path)), capture_output=True, text=True
    )
    said = [json.loads(line)["text"] for line in done.stderr.splitlines()]
    written = [
        json.loads(line)["text"] for line in (tmp_path / "driver.jsonl").read_text().splitlines()
    ]
    assert said == written == [f"line {i}" for i in range(500)]
