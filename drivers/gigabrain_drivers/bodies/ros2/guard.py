"""A process that stops a ROS 2 robot when its driver dies or hangs.

A robot without its own watchdog drives on for ever when its commands end. So the driver starts this
process, which has its own node, and reports each command to it: moving, or at rest. When reports of
a moving robot end, or the driver is gone, it sends zero. It cannot help if the network between this
machine and the robot is cut.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

import msgspec

from gigabrain_drivers.bodies.ros2.link import RosLink
from gigabrain_drivers.bodies.ros2.options import Ros2Options
from gigabrain_drivers.links.line_guard import AT_REST, MOVING, QUIT, GuardState
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.clock import Clock

SILENCE_NS = 150_000_000  # from the last report of a moving robot to zero
ZEROS_NS = 1_000_000_000  # zero is repeated this long, as a single message may get lost
PERIOD_NS = 20_000_000
REPORT_NS = 500_000_000  # between two reports to the driver
LOST_NS = 3_000_000_000  # the driver counts the guard as lost after this time without a report
RESTART_NS = 500_000_000
CLOSE_S = 1.0  # timeout for its own link
END_S = 2.0  # timeout for the whole process
START_S = 60.0  # for its first report on a busy machine, which a restart would only delay
MAX_CHARS = 200  # of a fault
GUARD = "the guard, which stops the robot if this driver dies,"


class Guard:
    """The driver's end: starts the process, and restarts it if it ends."""

    def __init__(self, options: Ros2Options, clock: Clock, reached: Callable[[], object]) -> None:
        """`reached` returns whether the driver itself reaches the robot."""
        self._options, self._clock, self._reached = options, clock, reached
        self._process: asyncio.subprocess.Process | None = None
        self._received_ns: int | None = None
        self._readers, self._fault = 0, ""  # the fault of the previous process
        self._task: asyncio.Task[None] | None = None

    @property
    def problem(self) -> str:
        """Return why the guard could not stop the robot; empty if it could."""
        if self._received_ns is None:
            return f"{GUARD} {self._fault or 'is starting'}"
        if self._clock.now_ns() - self._received_ns > LOST_NS:
            return f"{GUARD} does not answer"
        if not self._readers:
            return f"{GUARD} does not reach it yet"
        return ""

    def open(self) -> None:
        """Start it in the background."""
        if self._task is None:
            self._task = asyncio.create_task(self._keep(), name="guard")

    def tell(self, *, moving: bool) -> None:
        """Report a sent command to it."""
        self._write(MOVING if moving else AT_REST)

    async def close(self) -> None:
        """End the process."""
        task, self._task = self._task, None
        if task:
            self._write(QUIT)
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    def _write(self, word: bytes) -> None:
        process = self._process
        if process and process.stdin and process.returncode is None:
            with contextlib.suppress(ConnectionError, RuntimeError):
                process.stdin.write(word)

    async def _keep(self) -> None:
        while True:
            try:
                self._fault = f"{await self._run()}; starting it again"
            finally:
                self._process, self._received_ns = None, None
            await self._clock.sleep_ns(RESTART_NS)

    async def _start(self) -> asyncio.subprocess.Process:
        """Start the process. Raises OSError."""
        settings = msgspec.to_builtins(self._options)
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        return await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", __name__, json.dumps(settings)),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env=environment,
            start_new_session=True,  # signals to the driver's group must not end it
        )

    async def _run(self) -> str:
        """Start the process, and receive its reports; return why it no longer works."""
        try:
            process = self._process = await self._start()
        except OSError as error:
            return f"cannot be started: {error}"
        assert process.stdout
        assert process.stdin
        alone_ns: int | None = None  # time of its first report
        try:
            while alone_ns is None or self._clock.now_ns() - alone_ns < LOST_NS:  # else: not joined
                async with asyncio.timeout(START_S if self._received_ns is None else LOST_NS / 1e9):
                    line = await process.stdout.readline()
                if not line:
                    return "has ended"
                self._readers = int(line)
                self._received_ns = self._clock.now_ns()
                if alone_ns is None or self._readers or not self._reached():
                    alone_ns = self._received_ns
            return "does not reach the robot, which this driver does"
        except TimeoutError:
            return "does not answer"
        except ValueError as error:
            return f"printed something other than a number: {str(error)[:MAX_CHARS]}"
        finally:
            process.stdin.close()  # this ends it
            await _ended(process, 0.0 if self._task else END_S)  # a lost one may hang


async def _ended(process: asyncio.subprocess.Process, within_s: float) -> None:
    """Wait until a process has ended; kill it after `within_s`."""
    try:
        async with asyncio.timeout(within_s):
            await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def guard(options: Ros2Options) -> None:
    """Guard the robot until the driver has ended and zero was sent."""
    clock, state = Clock(), GuardState(SILENCE_NS, ZEROS_NS)
    link = RosLink(msgspec.structs.replace(options, node=f"{options.node}_guard"[:64]), clock)
    link.open()
    loop = asyncio.get_running_loop()
    os.set_blocking(sys.stdin.fileno(), False)

    def read() -> None:
        with contextlib.suppress(BlockingIOError):
            words = os.read(sys.stdin.fileno(), 4096)
            state.take(words, clock.now_ns())
            if not words:
                loop.remove_reader(sys.stdin.fileno())

    loop.add_reader(sys.stdin.fileno(), read)
    told_ns = -REPORT_NS
    async for now_ns in clock.every(PERIOD_NS):
        if state.stops(now_ns):
            link.send(Velocity())
        if state.ended(now_ns):
            break
        if link.transport and now_ns - told_ns >= REPORT_NS and not state.gone:
            told_ns = now_ns
            with contextlib.suppress(BrokenPipeError):
                print(link.readers, flush=True)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(CLOSE_S):
            await link.close()
    os._exit(0)  # threads of DDS can hang at exit


def main(words: list[str]) -> None:
    """Run the guard of the link whose options are given as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends it through the driver
    options: Any = msgspec.convert(json.loads(words[0]), Ros2Options)
    asyncio.run(guard(options))


if __name__ == "__main__":
    main(sys.argv[1:])
