"""A process that stops a ROS 2 robot when its driver dies or hangs.

A robot without a watchdog of its own drives on for ever when its commands end. So the driver
starts this process, which has its own node, and reports each command to it: moving, or at rest.
The guard sends zero if the reports of a moving robot end, or the driver ends. It cannot help if
the network between this machine and the robot is cut.
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
from gigabrain_zenoh.host.files import file_problem

SILENCE_NS = 150_000_000  # zero is sent after this time without a report of a moving robot
ZEROS_NS = 1_000_000_000  # zero is repeated for this time, because a message may get lost
PERIOD_NS = 20_000_000
REPORT_NS = 500_000_000  # between two reports to the driver
LOST_NS = 3_000_000_000  # the driver restarts the guard after this time without a report
RESTART_NS = 500_000_000  # delay
CLOSE_S = 1.0  # timeout for leaving ROS 2
END_S = 2.0  # timeout for the end of the process
START_S = 60.0  # timeout for the first report; long, because a restart would delay it further
MAX_CHARS = 200  # in the text of a fault
GUARD = "the guard, which stops the robot if this driver dies,"


class Guard:
    """The driver's side: starts the guard process, and restarts it if it ends or hangs."""

    def __init__(self, options: Ros2Options, clock: Clock, reached: Callable[[], object]) -> None:
        """`reached` returns whether the driver itself reaches the robot."""
        self._options, self._clock, self._reached = options, clock, reached
        self._process: asyncio.subprocess.Process | None = None
        self._received_ns: int | None = None
        self._readers = 0  # nodes that subscribe to the commands of the process
        self._fault = ""  # of the previous process
        self._task: asyncio.Task[None] | None = None

    @property
    def problem(self) -> str:
        """The reason why the guard could not stop the robot; empty if it could."""
        if self._received_ns is None:
            return f"{GUARD} {self._fault or 'is starting'}"
        if self._clock.now_ns() - self._received_ns > LOST_NS:
            return f"{GUARD} does not answer"
        if not self._readers:
            return f"{GUARD} does not reach it yet"
        return ""

    def open(self) -> None:
        """Start the process in the background."""
        if self._task is None:
            self._task = asyncio.create_task(self._keep_running(), name="guard")

    def tell(self, *, moving: bool) -> None:
        """Report a sent command to the process."""
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

    async def _keep_running(self) -> None:
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
        """Start the process, and receive its reports; return the reason of its end."""
        try:
            process = self._process = await self._start()
        except OSError as error:
            return f"cannot be started: {file_problem(error)}"
        assert process.stdout
        assert process.stdin
        # time of the newest report that is no fault: the first one, one with readers, or any while
        # the driver itself does not reach the robot
        well_ns: int | None = None
        try:
            while well_ns is None or self._clock.now_ns() - well_ns < LOST_NS:
                async with asyncio.timeout(START_S if self._received_ns is None else LOST_NS / 1e9):
                    line = await process.stdout.readline()
                if not line:
                    return "has ended"
                self._readers = int(line)
                self._received_ns = self._clock.now_ns()
                if well_ns is None or self._readers or not self._reached():
                    well_ns = self._received_ns
            return "does not reach the robot, which this driver does"
        except TimeoutError:
            return "does not answer"
        except ValueError as error:
            return f"printed something other than a number: {str(error)[:MAX_CHARS]}"
        finally:
            process.stdin.close()  # ends the process
            await _wait_or_kill(process, 0.0 if self._task else END_S)  # a faulty one may hang


async def _wait_or_kill(process: asyncio.subprocess.Process, timeout_s: float) -> None:
    """Wait for the end of a process; kill it after `timeout_s`."""
    try:
        async with asyncio.timeout(timeout_s):
            await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def guard(options: Ros2Options) -> None:
    """Guard the robot until the driver ends, then send zero, and end the process."""
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
    reported_ns = -REPORT_NS
    async for now_ns in clock.every(PERIOD_NS):
        if state.stops(now_ns):
            link.send(Velocity())
        if state.ended(now_ns):
            break
        if link.transport and now_ns - reported_ns >= REPORT_NS and not state.gone:
            reported_ns = now_ns
            with contextlib.suppress(BrokenPipeError):
                print(link.readers, flush=True)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(CLOSE_S):
            await link.close()
    os._exit(0)  # threads of DDS can hang at exit


def main(words: list[str]) -> None:
    """Run the guard; its only argument is the driver's options as JSON."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends it through the driver
    options: Any = msgspec.convert(json.loads(words[0]), Ros2Options)
    asyncio.run(guard(options))


if __name__ == "__main__":
    main(sys.argv[1:])
