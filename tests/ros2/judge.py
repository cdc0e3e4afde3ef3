"""Real ROS 2 as a judge: rclpy programs in processes of their own, in a domain of their own.

A program (`tests/ros2/programs`) takes commands and reports events by lines of JSON. ROS finds
others on this machine only, over UDP, so that a killed program leaves nothing in shared memory.
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

DOMAINS = range(1, 100)  # their ports lie below those that Linux gives to clients
OF_USER = ("HOME", "LANG", "TMPDIR", "TZ")  # variables that programs keep
LONGEST_END_S = 10.0  # of a program whose stdin has ended, on a busy machine
NOT_KNOWN_YET = "_NODE_NAME_UNKNOWN_"  # of an endpoint whose participant is known later
POLL_S = 0.005
Event = dict[str, Any]


class Ended(Exception):
    """A program has ended while something was awaited from it."""


class Program:
    """An rclpy program in a process of its own."""

    def __init__(self, name: str, command: list[str], env: dict[str, str], errors: Path) -> None:
        self.name = name
        self._errors = errors
        self._events: list[Event] = []
        self._changed = threading.Condition()
        self._numbers = itertools.count()
        self._over = False
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
            self._over = True
            self._changed.notify_all()

    @property
    def running(self) -> bool:
        """True until it has ended."""
        return self._process.poll() is None

    @property
    def errors(self) -> str:
        """Return the text that it has written to standard error."""
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
        """Ask again and again until the answer fits, and return that one."""
        end_s = time.monotonic() + within_s
        while not fits(answer := self.ask(do, **fields)):
            if time.monotonic() > end_s:
                raise TimeoutError(f"{self.name}: {do} {fields} is still {answer}")
            time.sleep(POLL_S)
        return answer

    def seen(self, event: str, **like: Any) -> list[Event]:
        """Return the events so far, with the given fields, in their order."""
        with self._changed:
            return [one for one in self._events if _fits(one, event, like)]

    def wait(self, event: str, within_s: float = PATIENCE_S, nth: int = 0, **like: Any) -> Event:
        """Wait for the `nth` event with these fields, counted from 0 since the program began.

        Raises:
            Ended: The program ends before.
            TimeoutError: It does not come.
        """

        def found() -> Event | None:
            fitting = [one for one in self._events if _fits(one, event, like)]
            return fitting[nth] if len(fitting) > nth else None

        with self._changed:
            if not self._changed.wait_for(lambda: self._over or found(), within_s):
                raise TimeoutError(f"{self.name}: no {event} {like} within {within_s:g} s")
            if one := found():
                return one
        code = self._process.wait(LONGEST_END_S)
        last = self.errors.strip().rpartition("\n")[2]
        raise Ended(f"{self.name} ended with exit code {code} before {event} {like}: {last}")

    async def hear(
        self, event: str, within_s: float = PATIENCE_S, nth: int = 0, **like: Any
    ) -> Event:
        """Wait as `wait` does, while the event loop goes on."""
        return await asyncio.to_thread(self.wait, event, within_s, nth, **like)

    async def query(self, do: str, **fields: Any) -> Event:
        """Send a command and return its answer, while the event loop goes on."""
        return await self.hear(do, id=self.send(do, **fields))

    async def available(self, **where: Any) -> None:
        """Wait until the program finds the server of a service or action, as its users must.

        What is sent before is lost.
        """
        await asyncio.to_thread(self.poll, "available", lambda one: one["available"], **where)

    async def endpoints(self, topic: str) -> Event:
        """Return who publishes and subscribes, once ROS knows the names of their nodes."""

        def named(found: Event) -> bool:
            ends = [*found["publishers"], *found["subscribers"]]
            return all(end["node"] != NOT_KNOWN_YET for end in ends)

        return await asyncio.to_thread(self.poll, "endpoints", named, topic=topic)

    def kill(self) -> int:
        """End it at once, as `kill -9` does; returns the monotonic time [ns] of the signal."""
        self._process.kill()
        killed_ns = time.monotonic_ns()
        self._process.wait(LONGEST_END_S)
        return killed_ns

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Stop it by SIGSTOP, and let it go on afterwards."""
        with frozen(self.pid):
            yield

    def end(self) -> None:
        """Ask it to end, as its user would, without waiting for that."""
        assert self._process.stdin
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGCONT)
        with suppress(BrokenPipeError):
            self._process.stdin.close()

    def close(self) -> None:
        """End it as its user would, and by force where that does not help."""
        self.end()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(LONGEST_END_S)
        with suppress(ProcessLookupError):  # it, where it still runs, and what it has started
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait(LONGEST_END_S)
        self._reader.join(LONGEST_END_S)
        assert self._process.stdout
        self._process.stdout.close()


class Judge:
    """Starts rclpy programs in one domain, and ends them."""

    def __init__(self, python: Path, domain: int, folder: Path) -> None:
        """Use the interpreter of an environment with ROS 2; logs go to `folder`."""
        self.domain = domain
        self._python, self._folder = python, folder
        self._programs: list[Program] = []

    def start(
        self, program: str, node: str = "judge", namespace: str = "/", **settings: Any
    ) -> Program:
        """Start one of the programs, with a node of that name, and wait until it is ready."""
        name = f"{program}-{len(self._programs)}"
        words = json.dumps({"node": node, "namespace": namespace} | settings)
        command = [str(self._python), "-m", f"tests.ros2.programs.{program}", words]
        started = Program(name, command, self.environment(), self._folder / f"{name}.err")
        self._programs.append(started)
        started.wait("ready")
        return started

    def environment(self) -> dict[str, str]:
        """Return the variables of a program of ROS in this domain."""
        return {name: os.environ[name] for name in OF_USER if name in os.environ} | {
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
    """Start and end a judge in a free domain, with the interpreter of an environment."""
    with free_domain() as domain, ExitStack() as stack:
        judge = Judge(python, domain, folder)
        stack.callback(judge.close)
        yield judge


@contextmanager
def free_domain() -> Iterator[int]:
    """Claim a domain that nobody uses: by a lock among tests, and by its ports among all."""
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
    """Return whether no participant of DDS uses a domain on this machine."""
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
    """Stop a process by SIGSTOP, and let it go on afterwards."""
    os.kill(pid, signal.SIGSTOP)
    try:
        while _state(pid) != "T":  # the signal takes effect a little later
            time.sleep(POLL_S)
        yield
    finally:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def _state(pid: int) -> str:
    """Return the letter of a process in /proc."""
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]


def _fits(event: Event, name: str, like: dict[str, Any]) -> bool:
    return event["event"] == name and all(event.get(key) == like[key] for key in like)
