"""The supervisor's log file: starts, deaths and hangs of processes, and output that is no log."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gigabrain_zenoh.logs import file_sink

NAME = "supervisor"
OUTPUT = "output"  # event of a line that a process printed


class SupervisorLog:
    """Writes what only the supervisor knows beside the logs of the processes."""

    def __init__(self, run_dir: Path) -> None:
        self._sink = file_sink(NAME, run_dir)

    def add(self, record: Mapping[str, Any]) -> None:
        """Write a record, unless its process writes it itself."""
        if record["process"] != NAME and record["event"] != OUTPUT:
            return
        known = {"t", "level", "process", "text"}
        about = {key: value for key, value in record.items() if key not in known}
        child = {} if record["process"] == NAME else {"child": record["process"]}
        level = getattr(logging, str(record["level"]).upper(), logging.INFO)
        made = logging.LogRecord(NAME, level, "", 0, "%s", (record.get("text", ""),), None)
        made.data = about | child
        self._sink.handle(made)

    def close(self) -> None:
        """Write what is left."""
        self._sink.close()
