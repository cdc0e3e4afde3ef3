"""Prints events, as all programs of the judge do."""

import json
import threading
import time
from typing import Any

_printing = threading.Lock()


def say(event: str, **fields: Any) -> None:
    """Print an event, with the monotonic time at which it is printed unless `at_ns` is given."""
    line = json.dumps({"event": event, "at_ns": time.monotonic_ns()} | fields)
    with _printing:
        print(line, flush=True)
