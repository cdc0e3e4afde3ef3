"""The supervisor's log file: starts, deaths and hangs of processes, and their other output."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gigabrain_zenoh.logs import file_sink

NAME = "supervisor"
OUTPUT = "output"  # event of a line that a process printed


class SupervisorLog:
    """Writes the records that are in no log of a process."""

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
        entry = logging.LogRecord(NAME, level, "", 0, "%s", (record.get("text", ""),), None)
        entry.data = about | child
        self._sink.handle(entry)

    def close(self) -> None:
        """Write the queued records, and close the file."""
        self._sink.close()
