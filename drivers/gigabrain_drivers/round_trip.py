"""How long the brain takes from a scan to the command that rests on it."""

from collections.abc import Mapping

from gigabrain_zenoh.percentile import Newest

MOST = 20_000  # newest times that the figures are drawn from


class RoundTrip:
    """Times each scan from its departure to the first command with its tick as basis."""

    def __init__(self) -> None:
        self.scan_tick = 0  # newest tick that carried a scan
        self._sent_ns: int | None = None  # None once it is answered
        self._times_ms = Newest(MOST)

    def sent(self, tick: int, now_ns: int) -> None:
        """The scan of `tick` is on its way."""
        self.scan_tick, self._sent_ns = tick, now_ns

    def answered(self, basis: int, now_ns: int, *, counts: bool) -> None:
        """A command that rests on `basis` has come; while the brain still starts none counts."""
        if basis == self.scan_tick and self._sent_ns is not None:
            if counts:
                self._times_ms.add((now_ns - self._sent_ns) / 1e6)
            self._sent_ns = None

    def report(self) -> Mapping[str, float | int | None]:
        """Figures for reports, in milliseconds; None before the first."""
        times = self._times_ms
        return {
            "scan_to_cmd_n": len(times),
            "scan_to_cmd_p50_ms": times.percentile(0.50),
            "scan_to_cmd_p99_ms": times.percentile(0.99),
        }
