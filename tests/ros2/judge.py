"""Real ROS 2 as a judge: rclpy programs, each in its own process, in a free domain.

A program (`tests/ros2/programs`) reads commands and prints events as lines of JSON. Its discovery
is limited to this machine. It uses UDP, so that a killed program leaves nothing in shared memory.
"""

import asyncio
import fcntl
import itertools
import json
import os
import random
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from gigabrain_zenoh.ros2.rtps_discovery import multicast_port, participant_ports
from gigabrain_zenoh.testing.waiting import PATIENCE_S
from tests.places import ROOT

DOMAINS = range(1, 100)  # with ports below Linux's ephemeral ones
USER_VARIABLES = ("HOME", "LANG", "TMPDIR", "TZ")  # passed to programs
END_TIMEOUT_S = 10.0  # for a program after the end of its stdin, on a busy machine
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # of an endpoint while its participant is not known
POLL_S = 0.005
Event = dict[str, Any]


class Ended(Exception):
    """Raised if a program ends before an awaited event."""


class Program:
    """An rclpy program in a process of its own."""

    def __init__(self, name: str, command: list[str], env: dict[str, str], errors: Path) -> None:
        self.name = name
        self._errors = errors
        self._events: list[Event] = []
        self._changed = threading.Condition()
        self._numbers = itertools.count()
        self._ended = False
        with errors.open("wb") as file:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                env=env,
                cwd=ROOT,
                text=True,
                start_new_session=True,
            )
        self.pid = self._process.pid
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            with self._changed:
                self._events.append(json.loads(line))
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    @property
    def running(self) -> bool:
        """True until the program ends."""
        return self._process.poll() is None

    @property
    def errors(self) -> str:
        """The text that the program has written to standard error."""
        return self._errors.read_text()

    def send(self, do: str, **fields: Any) -> int:
        """Send a command, and return its number."""
        number = next(self._numbers)
        assert self._process.stdin
        self._process.stdin.write(json.dumps({"do": do, "id": number} | fields) + "\n")
        self._process.stdin.flush()
        return number

    def ask(self, do: str, **fields: Any) -> Event:
        """Send a command, and return its answer."""
        return self.wait(do, id=self.send(do, **fields))

    def poll(
        self,
        do: str,
        fits: Callable[[Event], object],
        within_s: float = PATIENCE_S,
        **fields: Any,
    ) -> Event:
        """Repeat a command until `fits` accepts its answer, and return that answer."""
        end_s = time.monotonic() + within_s
        while not fits(answer := self.ask(do, **fields)):
            if time.monotonic() > end_s:
                raise TimeoutError(f"{self.name}: {do} {fields} is still {answer}")
            time.sleep(POLL_S)
        return answer

    def seen(self, event: str, **like: Any) -> list[Event]:
        """Return the events so far that have the given fields, in order."""
        with self._changed:
            return [each for each in self._events if _matches(each, event, like)]

    def wait(self, event: str, within_s: float = PATIENCE_S, nth: int = 0, **like: Any) -> Event:
        """Wait for the event number `nth` with these fields, counted from 0 since the start.

        Raises:
            Ended: The program ended first.
            TimeoutError: There was no such event in time.
        """

        def found() -> Event | None:
            matching = [each for each in self._events if _matches(each, event, like)]
            return matching[nth] if len(matching) > nth else None

        with self._changed:
            if not self._changed.wait_for(lambda: self._ended or found(), within_s):
                raise TimeoutError(f"{self.name}: no {event} {like} within {within_s:g} s")
            if event_found := found():
                return event_found
        code = self._process.wait(END_TIMEOUT_S)
        last = self.errors.strip().rpartition("\n")[2]
        raise Ended(f"{self.name} ended with exit code {code} before {event} {like}: {last}")

    async def wait_async(
        self, event: str, within_s: float = PATIENCE_S, nth: int = 0, **like: Any
    ) -> Event:
        """Like `wait`, without blocking the event loop."""
        return await asyncio.to_thread(self.wait, event, within_s, nth, **like)

    async def query(self, do: str, **fields: Any) -> Event:
        """Like `ask`, without blocking the event loop."""
        return await self.wait_async(do, id=self.send(do, **fields))

    async def available(self, **where: Any) -> None:
        """Wait until the program finds the server of a service or action.

        A request that is sent earlier is lost.
        """
        await asyncio.to_thread(self.poll, "available", lambda one: one["available"], **where)

    async def endpoints(self, topic: str) -> Event:
        """Return the publishers and subscribers, once ROS knows the names of their nodes."""

        def named(found: Event) -> bool:
            ends = [*found["publishers"], *found["subscribers"]]
            return all(end["node"] != UNKNOWN_NODE for end in ends)

        return await asyncio.to_thread(self.poll, "endpoints", named, topic=topic)

    def kill(self) -> int:
        """Kill the program by SIGKILL; return the monotonic time [ns] of the signal."""
        self._process.kill()
        killed_ns = time.monotonic_ns()
        self._process.wait(END_TIMEOUT_S)
        return killed_ns

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Stop the program by SIGSTOP, and continue it at the end of the context."""
        with frozen(self.pid):
            yield

    def end(self) -> None:
        """Close stdin, so that the program ends, without waiting for its end."""
        assert self._process.stdin
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGCONT)
        with suppress(BrokenPipeError):
            self._process.stdin.close()

    def close(self) -> None:
        """End the program, by force if closing its stdin does not help."""
        self.end()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(END_TIMEOUT_S)
        with suppress(ProcessLookupError):  # the program, if it still runs, and its children
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait(END_TIMEOUT_S)
        self._reader.join(END_TIMEOUT_S)
        assert self._process.stdout
        self._process.stdout.close()


class Judge:
    """Starts and ends rclpy programs in one domain."""

    def __init__(self, python: Path, domain: int, folder: Path) -> None:
        """`python` is the interpreter of an environment with ROS 2; logs go to `folder`."""
        self.domain = domain
        self._python, self._folder = python, folder
        self._programs: list[Program] = []

    def start(
        self, program: str, node: str = "judge", namespace: str = "/", **settings: Any
    ) -> Program:
        """Start a program with a node of the given name, and wait until it is ready."""
        name = f"{program}-{len(self._programs)}"
        words = json.dumps({"node": node, "namespace": namespace} | settings)
        command = [str(self._python), "-m", f"tests.ros2.programs.{program}", words]
        started = Program(name, command, self.environment(), self._folder / f"{name}.err")
        self._programs.append(started)
        started.wait("ready")
        return started

    def environment(self) -> dict[str, str]:
        """Return the environment variables of a ROS program in this domain."""
        return {name: os.environ[name] for name in USER_VARIABLES if name in os.environ} | {
            "PATH": f"{self._python.parent}:/usr/bin:/bin",
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "ROS_LOG_DIR": str(self._folder),
        }

    def close(self) -> None:
        """End all programs."""
        for program in self._programs:
            program.end()
        while self._programs:
            self._programs.pop().close()


@contextmanager
def judging(python: Path, folder: Path) -> Iterator[Judge]:
    """Yield a judge in a free domain; end its programs at the end of the context."""
    with free_domain() as domain, ExitStack() as stack:
        judge = Judge(python, domain, folder)
        stack.callback(judge.close)
        yield judge


@contextmanager
def free_domain() -> Iterator[int]:
    """Yield an unused domain: no test has locked it, and all its ports are free."""
    folder = Path(tempfile.gettempdir()) / f"gigabrain-ros2-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        with (folder / f"{domain}.lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            if is_free(domain):
                yield domain
                return
    raise RuntimeError(f"no free ROS domain between {DOMAINS[0]} and {DOMAINS[-1]}")


def is_free(domain: int) -> bool:
    """Return whether no DDS participant uses a domain on this machine."""
    ports = itertools.chain.from_iterable(participant_ports(domain, each) for each in range(120))
    for port in (multicast_port(domain), *ports):
        with socket.socket(type=socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", port))
            except OSError:
                return False
    return True


@contextmanager
def frozen(pid: int) -> Iterator[None]:
    """Stop a process by SIGSTOP, and continue it at the end of the context."""
    os.kill(pid, signal.SIGSTOP)
    try:
        while _process_state(pid) != "T":  # the signal takes effect a little later
            time.sleep(POLL_S)
        yield
    finally:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def _process_state(pid: int) -> str:
    """Return the state letter of a process in /proc."""
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]


def _matches(event: Event, name: str, like: dict[str, Any]) -> bool:
    return event["event"] == name and all(event.get(key) == like[key] for key in like)
