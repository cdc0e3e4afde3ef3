"""A process that sends its messages as they never should be. For tests only.

Started as `python -m gigabrain_zenoh.qa.faults.tampering KINDS CONFIG` in the place of the process
itself, KINDS being names of `TAMPERINGS` with commas between. Each SIGUSR1 goes one step on: the
first kind begins, ends, the second begins ...
"""

import functools
import os
import signal
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges, ranges_bytes
from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN, STATE, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Transport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.launch.processes import run_process

Ranges = NDArray[np.float32]
FUTURE_TICKS = 50  # a second
YEAR_1970_NS, YEAR_2100_NS = 1, 4_102_444_800_000_000_000


class Tampering(NamedTuple):
    """On which topic, and what becomes of a message there; what is no message goes out as bytes."""

    topic: Topic[Any]
    change: Callable[[Any], Message | bytes]


def _scan(change: Callable[[Ranges], Ranges]) -> Tampering:
    def tamper(scan: LaserScan) -> Message:
        return replace(scan, ranges=ranges_bytes(change(ranges(scan).copy())))

    return Tampering(SCAN, tamper)


def _half(values: Ranges) -> Ranges:
    values[::2] = np.nan
    values[1] = np.nan
    return values


def _crooked(scan: LaserScan) -> bytes:
    """An angle_increment of 0, which no LaserScan can have."""
    plain = msgspec.to_builtins(scan, builtin_types=(bytes,))
    return msgspec.msgpack.encode({**plain, "angle_increment": 0.0})


def _power(percentage: float, volts: float) -> Tampering:
    def tamper(state: RobotState) -> Message:
        if state.battery is None:
            return state
        return replace(
            state, battery=replace(state.battery, percentage=percentage, voltage=volts)
        )  # fmt: skip

    return Tampering(STATE, tamper)


def _hot(state: RobotState) -> Message:
    """40 degrees more than a warm motor."""
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
    "empty-battery": _power(3.0, 10.5),
    "no-volts": _power(50.0, 0.0),
    "hot": Tampering(STATE, _hot),
    "future": Tampering(SCAN, _shifted(FUTURE_TICKS)),
    "past": Tampering(SCAN, _shifted(-FUTURE_TICKS)),
    "of-1970": Tampering(SCAN, lambda scan: replace(scan, stamp_ns=YEAR_1970_NS)),
    "of-2100": Tampering(SCAN, lambda scan: replace(scan, stamp_ns=YEAR_2100_NS)),
}


class Steps:
    """How often the process was told to go on."""

    def __init__(self, kinds: str) -> None:
        self._kinds, self.count = kinds.split(","), 0

    @property
    def now(self) -> Tampering | None:
        """What is to be tampered with, if anything."""
        turn, on = divmod(self.count, 2)
        return TAMPERINGS[self._kinds[turn % len(self._kinds)]] if on else None


class TamperedTransport:
    """A transport whose `publish` is not to be trusted."""

    def __init__(self, transport: Transport, steps: Steps) -> None:
        self._publish, self._steps = transport.publish, steps

    def publish(self, topic: Topic[Any], key: str, payload: bytes, encoding: str) -> None:
        """Send `payload`, or what becomes of it."""
        tampering = self._steps.now
        if tampering and topic.key == tampering.topic.key:
            message = tampering.change(msgspec.msgpack.decode(payload, type=topic.type))
            payload = message if isinstance(message, bytes) else codec.encode(message)
        self._publish(topic, key, payload, encoding)


def tampering_bus(steps: Steps, transport: Transport, clock: Clock, name: str) -> Bus:
    """A bus over `transport`, what it publishes being tampered with."""
    tampered = TamperedTransport(transport, steps)
    transport.publish = tampered.publish  # type: ignore[method-assign]
    return Bus(transport, clock, name)


def main() -> None:
    """Entry of the process."""
    this_process.die_with_supervisor()
    config = msgspec.json.decode(sys.argv[2], type=ProcessConfig)
    steps = Steps(sys.argv[1])

    def go_on(_number: int, _frame: object) -> None:
        steps.count += 1

    signal.signal(signal.SIGUSR1, go_on)
    code = run_process(config, functools.partial(tampering_bus, steps))
    sys.stdout.flush()
    os._exit(code)  # Zenoh's threads must not keep a finished process alive


if __name__ == "__main__":
    main()
