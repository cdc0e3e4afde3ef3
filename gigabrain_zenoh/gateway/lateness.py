"""Delay of a message over the fastest of its sender, whose clock may be off."""

from msgspec import Struct
from msgspec.structs import replace

WINDOW_NS = 10_000_000_000  # [ns] for which the shortest delay of a sender counts, at least


class Lateness(Struct, frozen=True):
    """Delay of messages beyond the shortest one of the last ten to twenty seconds.

    Clocks need not agree: an offset is in all delays alike. What a network hands over after a
    freeze is late, whatever its sender's clock says.
    """

    now_ns: int = 0  # of the newest message; 0 for one without a time
    least_ns: int | None = None  # delay in this window, offset included
    before_ns: int | None = None  # in the window before
    began_ns: int = 0  # of this window

    def then(self, sent_ns: int | None, arrived_ns: int, clock_ns: int) -> "Lateness":
        """Return the state after a message, sent and arrived by clocks that may differ.

        `clock_ns` only goes forward; it ends the windows.
        """
        if sent_ns is None:
            return replace(self, now_ns=0)
        delay_ns, fresh = arrived_ns - sent_ns, self
        if self.least_ns is None:
            fresh = replace(self, began_ns=clock_ns)
        elif clock_ns - self.began_ns > WINDOW_NS:
            fresh = Lateness(0, None, self.least_ns, clock_ns)
        least_ns = delay_ns if fresh.least_ns is None else min(fresh.least_ns, delay_ns)
        known = least_ns if fresh.before_ns is None else min(least_ns, fresh.before_ns)
        return replace(fresh, now_ns=delay_ns - known, least_ns=least_ns)
