import os
import subprocess
import sys
from pathlib import Path

import pytest

QUIET = """
import asyncio
from gigabrain_zenoh.diagnostics.listener import stop_on_broken_pipe

async def quiet():
    stop = asyncio.Event()
    with stop_on_broken_pipe(stop):
        print("one word and no more", end="", flush=True)
        await asyncio.wait_for(stop.wait(), float("{patience_s}"))

asyncio.run(quiet())
"""


def test_a_closed_stdout_pipe_ends_the_wait_at_once() -> None:
    read, write = os.pipe()
    with subprocess.Popen(
        [sys.executable, "-c", QUIET.format(patience_s=60)], stdout=write
    ) as command:
        os.close(write)
        os.read(read, 1)
        os.close(read)
    assert command.returncode == 0


@pytest.mark.parametrize("kind", ["pipe", "file"])
def test_an_open_stdout_does_not_end_the_wait(kind: str, tmp_path: Path) -> None:
    with (tmp_path / "out").open("wb") as file:
        command = subprocess.run(
            [sys.executable, "-c", QUIET.format(patience_s=0.3)],
            stdout=subprocess.PIPE if kind == "pipe" else file,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert command.stderr.endswith("TimeoutError\n")
