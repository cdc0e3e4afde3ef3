"""How long the brain takes from a scan to the command that rests on it."""

from collections import deque
from collections.abc import Mapping

from gigabrain_zenoh.host.bounded import NewestValues

MOST = 20_000  # newest times that the figures are drawn from
WAITING = 1_000  # scans that may be unanswered; a brain that is away answers none


class RoundTrip:
    """Times each scan from its departure to the first command that rests on it, or on a newer one.

    A scan that the brain has skipped counts as well, else slow answers would flatter the figures.
    """

    def __init__(self) -> None:
        self.scan_tick = 0  # newest tick that carried a scan
        self._waiting: deque[tuple[int, int]] = deque(maxlen=WAITING)  # tick, sent at [ns]
        self._times_ms = NewestValues(MOST)

    def sent(self, tick: int, now_ns: int) -> None:
        """The scan of `tick` is on its way."""
        self.scan_tick = tick
        self._waiting.append((tick, now_ns))

    def answered(self, basis: int, now_ns: int, *, counts: bool) -> None:
        """A command that rests on `basis` has come; while the brain still starts none counts."""
        while self._waiting and self._waiting[0][0] <= basis:
            _, sent_ns = self._waiting.popleft()
            if counts:
                self._times_ms.add((now_ns - sent_ns) / 1e6)

    def report(self) -> Mapping[str, float | int | None]:
        """Figures for reports, in milliseconds; None before the first."""
        times = self._times_ms
        return {
            "scan_to_cmd_n": len(times),
            "scan_to_cmd_p50_ms": times.percentile(0.50),
            "scan_to_cmd_p99_ms": times.percentile(0.99),
        }
