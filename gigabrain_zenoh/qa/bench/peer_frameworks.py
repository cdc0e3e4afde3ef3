"""The bare relay built with dora and with ROS 1, for `bench chain --peers`.

Each needs its command on the PATH: `dora` or `rosmaster`. The Python interpreter of that command
runs the four processes.
"""

import asyncio
import contextlib
import os
import shutil
import signal
import socket
import tempfile
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import yaml

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.network import reserve_port
from gigabrain_zenoh.qa.judging import Failed, Latencies, latencies
from gigabrain_zenoh.qa.probe import until

NODE = Path(__file__).parent / "peer_node.py"
NAMES = ("source", "first", "second", "third")
COMMANDS = {"dora": "dora", "rospy": "rosmaster"}
START_TIMEOUT_S, END_TIMEOUT_S = 20.0, 3.0
LOCAL = "127.0.0.1"
Role = dict[str, Any]


class Framework(NamedTuple):
    """An installed framework."""

    name: str  # "dora"
    command: str
    python: str  # interpreter that can import it


def installed() -> tuple[Framework, ...]:
    """Return the frameworks whose commands are on the PATH."""
    found = ((name, shutil.which(command)) for name, command in COMMANDS.items())
    return tuple(Framework(name, path, _interpreter(path)) for name, path in found if path)


def _interpreter(script: str) -> str:
    """Return the interpreter that a script's first line names. Raises GigabrainError."""
    first = Path(script).read_bytes().partition(b"\n")[0].decode(errors="replace")
    if not first.startswith("#!"):
        raise GigabrainError(
            f"{script} is not a Python script; expected the one that pip or apt has"
        )
    return first.removeprefix("#!").split()[-1]


async def time_framework(
    framework: Framework, rate_hz: float, seconds: float, settle_s: float, sizes: Sequence[int]
) -> Latencies:
    """Time its four processes. Raises GigabrainError when they do not finish."""
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as name:
        folder = Path(name)
        result, log = folder / "times.json", folder / "log"
        role: Role = {
            "system": framework.name,
            "sizes": list(sizes),
            "rate_hz": rate_hz,
            "settle_s": settle_s,
            "seconds": seconds,
            "result": str(result),
        }
        with log.open("wb") as output:
            async with _RUNS[framework.name](framework, role, folder, output.fileno()):
                try:
                    await until(result.exists, "times", START_TIMEOUT_S + settle_s + seconds)
                except Failed as error:
                    last_line = log.read_text(errors="replace").splitlines()[-1:]
                    raise Failed(f"{framework.name}: {error}; {''.join(last_line)}") from None
        return latencies(msgspec.json.decode(result.read_bytes()))


@asynccontextmanager
async def _dora(framework: Framework, role: Role, folder: Path, output: int) -> AsyncIterator[None]:
    nodes = []
    for index, name in enumerate(NAMES):
        inputs = {"in": f"{NAMES[index - 1]}/out"}
        if not index:
            inputs["tick"] = f"dora/timer/millis/{round(1e3 / role['rate_hz'])}"
        words = msgspec.json.encode(role | {"index": index}).decode()
        nodes.append(
            {
                "id": name,
                "path": framework.python,
                "args": f"{NODE} '{words}'",
                "inputs": inputs,
                "outputs": ["out"],
            }
        )
    (folder / "flow.yml").write_text(yaml.safe_dump({"nodes": nodes}), encoding="utf-8")
    async with _running([framework.command, "run", "flow.yml"], folder, output):
        yield


@asynccontextmanager
async def _rospy(
    framework: Framework, role: Role, folder: Path, output: int
) -> AsyncIterator[None]:
    port = reserve_port(LOCAL)
    variables = {
        "ROS_MASTER_URI": f"http://{LOCAL}:{port}", "ROS_IP": LOCAL,
        "ROS_HOME": str(folder), "ROS_LOG_DIR": str(folder),
    }  # fmt: skip
    async with contextlib.AsyncExitStack() as stack:
        master = [framework.command, "--core", "-p", str(port)]
        await stack.enter_async_context(_running(master, folder, output, variables))
        await until(lambda: _listens(port), "rosmaster", START_TIMEOUT_S)
        for index in range(len(NAMES)):
            words = msgspec.json.encode(role | {"index": index}).decode()
            node = [framework.python, str(NODE), words]
            await stack.enter_async_context(_running(node, folder, output, variables))
        yield


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOCAL, port)) == 0


@asynccontextmanager
async def _running(
    command: Sequence[str], folder: Path, output: int, variables: Mapping[str, str] | None = None
) -> AsyncIterator[None]:
    """Run a process in its own session; at the end of the block, end all of its children too."""
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        cwd=folder,
        env={**os.environ, **(variables or {})},
        start_new_session=True,
    )
    try:
        yield
    finally:
        for sign in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, sign)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(END_TIMEOUT_S):
                    await process.wait()


_RUNS = {"dora": _dora, "rospy": _rospy}
