"""What processes hold more than they did."""

from collections.abc import Sequence

from gigabrain_zenoh.faults.helpers import open_files, rss_mb


class Growth:
    """Memory and open files of some processes, against those of the moment when it was made.

    Raises Skipped where /proc does not say.
    """

    def __init__(self, pids: Sequence[int]) -> None:
        self._before = {pid: (rss_mb(pid), open_files(pid)) for pid in pids}

    def memory_mb(self) -> float:
        """By how much that of one of them has grown at most; 0 where all have shrunk."""
        grown = (rss_mb(pid) - before for pid, (before, _) in self._before.items())
        return max(0.0, *grown)

    def open_files(self) -> int:
        """The same of files, sockets and pipes."""
        return max(0, *(open_files(pid) - before for pid, (_, before) in self._before.items()))
