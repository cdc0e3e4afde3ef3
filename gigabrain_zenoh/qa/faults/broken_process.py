"""Runs a robot's process with one broken part: published or received messages, or clocks.

Started as `python -m gigabrain_zenoh.qa.faults.broken_process KIND ABOUT` instead of the process
itself, with the same standard input. KIND is `hanging`, a kind of `CLOCK_SKEWS`, or comma-separated
names of `TAMPERINGS`. The machine's own clock does not change.
"""

import functools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar
from unittest import mock

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN, STATE, WORLD, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Close, Transport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.launch.processes import run_process

M = TypeVar("M", bound=Message)
Ranges = NDArray[np.float32]
Shift = Callable[[int], int]  # error of a clock [ns], by the time since the start [ns]
HANGING = "hanging"
HANGING_TOPICS: dict[str, Topic[Any]] = {  # messages that are no longer handled, by process
    "perception": SCAN,
    "decision": WORLD,
    "control": STATE,
    "safety": STATE,
}
FUTURE_TICKS = 50  # a second
YEAR_1970_NS, YEAR_2100_NS = 1, 4_102_444_800_000_000_000
HOUR_NS, YEAR_NS = 3_600_000_000_000, 31_557_600_000_000_000
JUMPS_NS = (0, HOUR_NS, -HOUR_NS, 10 * YEAR_NS, -10 * YEAR_NS)  # in turn
STAY_NS = 1_300_000_000  # duration of each; not whole seconds, so that processes differ
BACK_NS = 500_000_000  # jump back, in each second
OTHER_HOST_NS = 5_000_000_000
OTHER_RATE = 200e-6  # rate error: too fast


class HangingBus(Bus):
    """A bus that stops delivering messages of one topic when `hangs` is set."""

    def __init__(
        self,
        hung: Topic[Any],
        hangs: threading.Event,
        transport: Transport,
        clock: Clock,
        name: str,
    ) -> None:
        super().__init__(transport, clock, name)
        self._hung, self._hangs = hung, hangs

    def subscribe(
        self,
        topic: Topic[M],
        on_message: Callable[[str, M], None],
        on_bad: Callable[[bytes], None] | None = None,
        *,
        name: str = "*",
        lazy: bool = False,
    ) -> Close:
        """Subscribe; messages of the hung topic are dropped while it hangs."""

        def handle(key: str, message: M) -> None:
            if topic is not self._hung or not self._hangs.is_set():
                on_message(key, message)

        return super().subscribe(topic, handle, on_bad, name=name, lazy=lazy)


class Tampering(NamedTuple):
    """A topic, and a function that replaces each message on it by a message or bytes."""

    topic: Topic[Any]
    change: Callable[[Any], Message | bytes]


def _scan(change: Callable[[Ranges], Ranges]) -> Tampering:
    def tamper(scan: LaserScan) -> Message:
        return replace(scan, ranges=ranges_bytes(change(scan.ranges_m.copy())))

    return Tampering(SCAN, tamper)


def _half(values: Ranges) -> Ranges:
    values[::2] = np.nan
    values[1] = np.nan
    return values


def _crooked(scan: LaserScan) -> bytes:
    # an angle_increment of 0, which is invalid
    plain = msgspec.to_builtins(scan, builtin_types=(bytes,))
    return msgspec.msgpack.encode({**plain, "angle_increment": 0.0})


def _battery(percentage: float, volts: float) -> Tampering:
    def tamper(state: RobotState) -> Message:
        if state.battery is None:
            return state
        return replace(
            state, battery=replace(state.battery, percentage=percentage, voltage=volts)
        )  # fmt: skip

    return Tampering(STATE, tamper)


def _hot(state: RobotState) -> Message:
    # 40 degrees above a warm motor
    return replace(state, joints=tuple(replace(j, temperature=85.0) for j in state.joints))


def _shifted(ticks: int) -> Callable[[LaserScan], Message]:
    def tamper(scan: LaserScan) -> Message:
        return replace(scan, tick=max(1, scan.tick + ticks), basis=max(1, scan.basis + ticks))

    return tamper


TAMPERINGS: dict[str, Tampering] = {
    "nan": _scan(lambda values: np.full_like(values, np.nan)),
    "minus-inf": _scan(lambda values: np.full_like(values, -np.inf)),
    "zero": _scan(np.zeros_like),
    "most": _scan(lambda values: np.full_like(values, 3.4)),  # constant, within any range
    "half": _scan(_half),
    "short": _scan(lambda values: values[:-1]),
    "crooked": Tampering(SCAN, _crooked),
    "empty-battery": _battery(3.0, 10.5),
    "no-volts": _battery(50.0, 0.0),
    "hot": Tampering(STATE, _hot),
    "future": Tampering(SCAN, _shifted(FUTURE_TICKS)),
    "past": Tampering(SCAN, _shifted(-FUTURE_TICKS)),
    "of-1970": Tampering(SCAN, lambda scan: replace(scan, stamp_ns=YEAR_1970_NS)),
    "of-2100": Tampering(SCAN, lambda scan: replace(scan, stamp_ns=YEAR_2100_NS)),
}


class TamperingSteps:
    """Steps through kinds of tampering: the first begins, ends, the second begins ..."""

    def __init__(self, kinds: str) -> None:
        self._kinds, self.count = kinds.split(","), 0

    @property
    def now(self) -> Tampering | None:
        """The tampering of this step; None between two of them."""
        turn, on = divmod(self.count, 2)
        return TAMPERINGS[self._kinds[turn % len(self._kinds)]] if on else None


def tampering_bus(steps: TamperingSteps, transport: Transport, clock: Clock, name: str) -> Bus:
    """Return a bus over `transport` that tampers with what it publishes."""
    publish = transport.publish

    def tampered_publish(topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        tampering = steps.now
        if tampering and topic.key == tampering.topic.key:
            message = tampering.change(msgspec.msgpack.decode(payload, type=topic.type))
            payload = message if isinstance(message, bytes) else codec.encode(message)
        publish(topic, key, payload, encoding)

    transport.publish = tampered_publish  # type: ignore[method-assign]
    return Bus(transport, clock, name)


def jumps(since_ns: int) -> int:
    """Return errors with jumps by an hour and ten years, and half a second back every second."""
    return JUMPS_NS[since_ns // STAY_NS % len(JUMPS_NS)] - since_ns // 1_000_000_000 * BACK_NS


def other_host(since_ns: int) -> int:
    """Return the error of a clock that is five seconds ahead and 200 ppm too fast."""
    return OTHER_HOST_NS + drift(since_ns)


def drift(since_ns: int) -> int:
    """Return the error of a clock that is 200 ppm too fast."""
    return round(since_ns * OTHER_RATE)


CLOCK_SKEWS: dict[str, tuple[Shift, Shift]] = {  # of the wall clock and of the steady clock
    "jumps": (jumps, lambda since_ns: 0),
    "other-host": (other_host, drift),
}


@contextmanager
def skewed_clocks(wall: Shift, steady: Shift) -> Iterator[None]:
    """Shift Python's clocks while the block runs."""
    true_wall_ns, true_ns = time.time_ns, time.monotonic_ns
    start_ns = true_ns()

    def wall_ns() -> int:
        return true_wall_ns() + wall(true_ns() - start_ns)

    def steady_ns() -> int:
        now_ns = true_ns()
        return now_ns + steady(now_ns - start_ns)

    with mock.patch.multiple(
        time,
        time_ns=wall_ns,
        time=lambda: wall_ns() / 1e9,
        monotonic_ns=steady_ns,
        monotonic=lambda: steady_ns() / 1e9,
    ):
        yield


def run_broken(kind: str, config: ProcessConfig) -> int:
    """Run the process with this kind of fault; returns its exit code."""
    if kind in CLOCK_SKEWS:
        with skewed_clocks(*CLOCK_SKEWS[kind]):
            return run_process(config)
    if kind == HANGING:
        hangs = threading.Event()
        signal.signal(signal.SIGUSR1, lambda _number, _frame: hangs.set())
        topic = HANGING_TOPICS[config.name]
        return run_process(config, functools.partial(HangingBus, topic, hangs))
    steps = TamperingSteps(kind)

    def go_on(_number: int, _frame: object) -> None:
        steps.count += 1

    signal.signal(signal.SIGUSR1, go_on)
    return run_process(config, functools.partial(tampering_bus, steps))


if __name__ == "__main__":
    this_process.die_with_supervisor()
    config = msgspec.json.decode(sys.stdin.buffer.read(), type=ProcessConfig)
    code = run_broken(sys.argv[1], config)
    sys.stdout.flush()
    os._exit(code)  # Zenoh's threads must not keep a finished process alive
