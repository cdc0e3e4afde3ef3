"""A process one of whose parts hangs from SIGUSR1 on, while all else of it runs. For tests only.

Started as `python -m gigabrain_zenoh.qa.faults.hanging CONFIG` in the place of the process itself.
"""

import functools
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import SCAN, STATE, WORLD, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Close, Transport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.launch.processes import run_process

M = TypeVar("M", bound=Message)
PARTS: dict[str, Topic[Any]] = {  # what is not handled
    "perception": SCAN,
    "decision": WORLD,
    "control": STATE,
    "safety": STATE,
}


class HangingBus(Bus):
    """Whoever handles a message of `part` never comes back from it once `hangs` is set."""

    def __init__(
        self,
        part: Topic[Any],
        hangs: threading.Event,
        transport: Transport,
        clock: Clock,
        name: str,
    ) -> None:
        super().__init__(transport, clock, name)
        self._part, self._hangs = part, hangs

    def subscribe(
        self,
        topic: Topic[M],
        on_message: Callable[[str, M], None],
        on_bad: Callable[[bytes], None] | None = None,
        *,
        name: str = "*",
    ) -> Close:
        """As any bus does."""

        def handle(key: str, message: M) -> None:
            if topic is not self._part or not self._hangs.is_set():
                on_message(key, message)

        return super().subscribe(topic, handle, on_bad, name=name)


def main() -> None:
    """Entry of the process."""
    this_process.die_with_supervisor()
    config = msgspec.json.decode(sys.argv[1], type=ProcessConfig)
    hangs = threading.Event()
    signal.signal(signal.SIGUSR1, lambda _number, _frame: hangs.set())
    make_bus = functools.partial(HangingBus, PARTS[config.name], hangs)
    code = run_process(config, make_bus)
    sys.stdout.flush()
    os._exit(code)  # Zenoh's threads must not keep a finished process alive


if __name__ == "__main__":
    main()
