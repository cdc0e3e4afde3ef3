"""One way of one connection: takes bytes, and hands them on when and how chaos would have it."""

import asyncio
from collections import deque
from collections.abc import Callable

from gigabrain_zenoh.qa.proxy.chaos import CALM, Chaos
from gigabrain_zenoh.qa.proxy.damage import Damage

MOST_WAITING = 4 << 20  # bytes on their way; then the sender has to wait


class Pipe:
    """From `feed` to `hand_on`, in order. `on_room` is told whether the sender may go on."""

    def __init__(
        self,
        damage: Damage,
        hand_on: Callable[[bytes], object],
        on_room: Callable[[bool], None],
        on_end: Callable[[], None],
    ) -> None:
        self._damage, self._figures = damage, damage.figures
        self._hand_on, self._on_room, self._on_end = hand_on, on_room, on_end
        self._chaos = CALM
        self._queue: deque[tuple[float, bytes]] = deque()
        self._waiting = 0
        self._stuck = self._ended = False
        self._timer: asyncio.TimerHandle | None = None

    def set(self, chaos: Chaos) -> None:
        """Be like this from now on; what is under way arrives when it was to arrive."""
        self._chaos = chaos
        self._flush()

    def wake(self) -> None:
        """The ends have changed: hand on what may be, take what may be."""
        self._flush()

    def feed(self, data: bytes) -> None:
        """What the sender has sent."""
        now_s = asyncio.get_running_loop().time()
        pieces = self._damage.damaged(data, self._chaos, now_s)
        self._queue.extend(pieces)
        self._count(sum(len(piece) for _, piece in pieces))
        self._flush()

    def end(self) -> None:
        """The sender sends no more; the receiver is told when the last byte has arrived."""
        self._ended = True
        self._flush()

    def stick(self, stuck: bool) -> None:
        """Whether the receiver takes no more at present."""
        self._stuck = stuck
        self._flush()

    def close(self) -> None:
        """Forget what is under way."""
        if self._timer:
            self._timer.cancel()
        self._queue.clear()
        self._count(-self._waiting)

    def _flush(self) -> None:
        if self._timer:
            self._timer.cancel()
            self._timer = None
        loop = asyncio.get_running_loop()
        if not (self._chaos.hole or self._stuck):
            due = []
            while self._queue and self._queue[0][0] <= loop.time():
                due.append(self._queue.popleft()[1])
            if due:
                self._deliver(due)
            if self._queue:
                self._timer = loop.call_at(self._queue[0][0], self._flush)
            elif self._ended:
                self._ended = False
                self._on_end()
        self._on_room(not self._chaos.hole and self._waiting < MOST_WAITING)

    def _deliver(self, pieces: list[bytes]) -> None:
        size = sum(map(len, pieces))
        self._count(-size)
        self._figures.handed_on += size
        for piece in [b"".join(pieces)] if self._chaos.merge_ms else pieces:
            self._hand_on(piece)

    def _count(self, more: int) -> None:
        self._waiting += more
        self._figures.waiting += more
