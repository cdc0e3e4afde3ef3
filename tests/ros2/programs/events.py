"""Prints events as lines of JSON, for all programs of the judge."""

import json
import threading
import time
from typing import Any

_printing = threading.Lock()


def emit(event: str, **fields: Any) -> None:
    """Print an event with its monotonic time `at_ns`; the default is now."""
    line = json.dumps({"event": event, "at_ns": time.monotonic_ns()} | fields)
    with _printing:
        print(line, flush=True)
