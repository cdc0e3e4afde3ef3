"""What a hypervisor takes from this machine."""

import os
from pathlib import Path

STEAL = 8  # the column of proc_stat(5), counted from the core's name


class StolenTime:
    """How long any one core was kept from running what was there to run, as Linux tells it."""

    def __init__(self, stat: Path = Path("/proc/stat")) -> None:
        self._stat, self._ticks_hz = stat, os.sysconf("SC_CLK_TCK")
        self._told = self._tell()

    def most_s(self) -> float:
        """The most that was taken from one core since the last call [s]; 0 where nobody tells."""
        before, self._told = self._told, self._tell()
        taken = (ticks - before.get(core, ticks) for core, ticks in self._told.items())
        return max(taken, default=0) / self._ticks_hz

    def _tell(self) -> dict[str, int]:
        try:
            lines = self._stat.read_text().splitlines()
        except OSError:  # not Linux
            return {}
        rows = (line.split() for line in lines)
        return {row[0]: int(row[STEAL]) for row in rows if _of_one_core(row)}


def _of_one_core(row: list[str]) -> bool:
    return len(row) > STEAL and row[0].startswith("cpu") and row[0] != "cpu"
