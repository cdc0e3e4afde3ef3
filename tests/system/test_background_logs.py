"""Writing logs blocks neither the event loop nor the end of the process."""

import fcntl
import json
import os
import subprocess
import sys
from pathlib import Path

PIPE_BYTES = 4096


def test_a_process_ends_although_its_console_is_not_read() -> None:
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


def test_all_log_lines_are_written_before_a_process_ends(tmp_path: Path) -> None:
    program = (
        "import logging, os, sys; from pathlib import Path; from gigabrain_zenoh import logs; "
        "logs.setup('driver', Path(sys.argv[1]), json_console=True); "
        "[logging.info('line %d', i) for i in range(500)]; logs.flush(); os._exit(0)"
    )
    done = subprocess.run(
        (sys.executable, "-c", program, str(tmp_path)), capture_output=True, text=True
    )
    logged = [json.loads(line)["text"] for line in done.stderr.splitlines()]
    written = [
        json.loads(line)["text"] for line in (tmp_path / "driver.jsonl").read_text().splitlines()
    ]
    assert logged == written == [f"line {i}" for i in range(500)]
