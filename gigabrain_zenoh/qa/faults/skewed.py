"""A process whose wall clock is wrong, or jumps. For tests only.

Started as `python -m gigabrain_zenoh.qa.faults.skewed KIND CONFIG` in the place of the process
itself. The machine's own clock is not touched: what this process sees of it is.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest import mock

import msgspec

from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.launch.processes import run_process

HOUR_NS, YEAR_NS = 3_600_000_000_000, 31_557_600_000_000_000
JUMPS_NS = (0, HOUR_NS, -HOUR_NS, 10 * YEAR_NS, -10 * YEAR_NS)  # one after the other
STAY_NS = 1_300_000_000  # with each; no whole number of seconds, so that processes differ
BACK_NS = 500_000_000  # in each second
OTHER_HOST_NS = 5_000_000_000
OTHER_RATE = 200e-6  # faster than the true one

Shift = Callable[[int], int]  # how far the clock is off, so long after the start [ns]


def jumps(since_ns: int) -> int:
    """An hour and ten years to and fro, and back by half a second every second."""
    return JUMPS_NS[since_ns // STAY_NS % len(JUMPS_NS)] - since_ns // 1_000_000_000 * BACK_NS


def other_host(since_ns: int) -> int:
    """The clock of a host that is five seconds ahead and 200 ppm too fast."""
    return OTHER_HOST_NS + drift(since_ns)


def drift(since_ns: int) -> int:
    """What a quartz that is 200 ppm too fast gains."""
    return round(since_ns * OTHER_RATE)


WALLS: dict[str, Shift] = {"jumps": jumps, "other-host": other_host}
RATES: dict[str, Shift] = {"jumps": lambda since_ns: 0, "other-host": drift}


def main() -> None:
    """Entry of the process."""
    this_process.die_with_supervisor()
    config = msgspec.json.decode(sys.argv[2], type=ProcessConfig)
    with clocks(WALLS[sys.argv[1]], RATES[sys.argv[1]]):
        code = run_process(config)
    sys.stdout.flush()
    os._exit(code)  # Zenoh's threads must not keep a finished process alive


@contextmanager
def clocks(wall: Shift, rate: Shift) -> Iterator[None]:
    """Python's clocks, off by `wall` and `rate`, while the block runs."""
    true_wall_ns, true_ns = time.time_ns, time.monotonic_ns
    start_ns = true_ns()

    def wall_ns() -> int:
        return true_wall_ns() + wall(true_ns() - start_ns)

    def steady_ns() -> int:
        now_ns = true_ns()
        return now_ns + rate(now_ns - start_ns)

    with mock.patch.multiple(
        time,
        time_ns=wall_ns,
        time=lambda: wall_ns() / 1e9,
        monotonic_ns=steady_ns,
        monotonic=lambda: steady_ns() / 1e9,
    ):
        yield


if __name__ == "__main__":
    main()
