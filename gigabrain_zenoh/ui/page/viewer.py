"""One browser: what waits to be sent to it, and how much it may say."""

import asyncio

from gigabrain_zenoh.ui.page.access import Role

ROOM = 64  # frames that wait for a slow browser
SAYS_HZ = 120  # frames a second that one may send; held keys take 25


class Viewer:
    """Frames for one browser: of each slot the newest; when there are too many the oldest go."""

    def __init__(self, number: int, role: Role) -> None:
        self.number, self.role = number, role
        self.gives_way = asyncio.Event()
        self._slots: dict[str, bytes] = {}
        self._filled = asyncio.Event()
        self._second, self._said = 0.0, 0

    def put(self, slot: str, frame: bytes) -> None:
        """Have `frame` sent in place of what still waits in its slot. Never waits."""
        self._slots[slot] = frame
        while len(self._slots) > ROOM:
            del self._slots[next(iter(self._slots))]
        self._filled.set()

    async def next(self) -> bytes:
        """The next frame to send."""
        await self._filled.wait()
        frame = self._slots.pop(next(iter(self._slots)))
        if not self._slots:
            self._filled.clear()
        return frame

    def floods(self, now_s: float) -> bool:
        """Count a frame that came; whether there are too many of them in this second."""
        if now_s - self._second >= 1.0:
            self._second, self._said = now_s, 0
        self._said += 1
        return self._said > SAYS_HZ
