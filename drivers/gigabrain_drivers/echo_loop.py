"""Whether a contact is closed, by what is sent through it and has to come back. Pure."""

import os
from collections import deque
from collections.abc import Callable

LATE_NS = 200_000_000  # what has not come back by then counts as never coming
BYTES = 2  # of each question: none of them can be guessed, nor held over from before


class EchoLoop:
    """Random bytes go out at TX, through a normally closed contact, and in at RX.

    An open contact, a broken wire and an adapter that is gone all look the same: nothing comes
    back. A short circuit to something else that talks looks wrong.
    """

    def __init__(self, random: Callable[[int], bytes] = os.urandom) -> None:
        self._random = random
        self._expected: deque[tuple[int, int]] = deque()  # byte, sent at [ns]
        self._good_ns: int | None = None  # when the newest byte that came back was sent
        self._deaf_until_ns = 0

    def opened(self) -> None:
        """The line is new: nothing from before counts."""
        self._expected.clear()
        self._good_ns = None

    def question(self, now_ns: int) -> bytes:
        """What to send now."""
        if now_ns < self._deaf_until_ns:
            return b""
        while self._expected and now_ns - self._expected[0][1] > LATE_NS:
            self._expected.popleft()
        data = self._random(BYTES)
        self._expected.extend((byte, now_ns) for byte in data)
        return data

    def heard(self, data: bytes, now_ns: int) -> None:
        """What has come back. After a wrong byte nothing is believed until the line is quiet."""
        for byte in data:
            if now_ns < self._deaf_until_ns:
                return
            expected, sent_ns = self._expected.popleft() if self._expected else (None, 0)
            if byte != expected:
                self._deaf_until_ns, self._good_ns = now_ns + LATE_NS, None
                self._expected.clear()
            elif now_ns - sent_ns <= LATE_NS:
                self._good_ns = sent_ns

    def problem(self, now_ns: int) -> str:
        """Why the contact does not count as closed, or an empty text."""
        if now_ns < self._deaf_until_ns:
            return "what comes back is not what was sent"
        if self._good_ns is None or now_ns - self._good_ns > LATE_NS:
            return "the contact is open, or its wire is broken"
        return ""
