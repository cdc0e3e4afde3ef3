"""The host's end of a servo bus: sends one question at a time, and matches its answers."""

import asyncio
from collections.abc import Sequence

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.protocol import FeetechDecoder, FeetechPacket
from gigabrain_drivers.links.frames import Spelling, Wording
from gigabrain_drivers.links.link import Link
from gigabrain_zenoh.clock import Clock

ANSWER_TIMEOUT_NS = 3_000_000  # per servo, in a cycle; USB adds 1 ms each way
PATIENT_TIMEOUT_NS = 60_000_000  # for important questions, on a busy host

ATTEMPTS = 4  # for important questions


class HostBus:
    """Asks servos over a link. Calls may overlap: each waits until the line is free.

    An answer counts only while its question waits, with the right id and length. Others, and
    duplicates, are dropped.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.link, self._clock = link, clock
        self.link.wording = Wording(
            Spelling(FeetechDecoder().feed, feetech.describe_sent),
            Spelling(FeetechDecoder().feed, feetech.describe_received),
        )
        self.link.on_bytes, self.link.on_lost = self._take, self._lost
        self.unanswered = 0  # missing answers
        self._decoder = FeetechDecoder()
        self._line = asyncio.Lock()
        self._waiting: set[int] = set()
        self._answers: dict[int, FeetechPacket] = {}
        self._garbled = False  # received bytes that are no answer
        self._complete = asyncio.Event()

    @property
    def errors(self) -> int:
        """Number of dropped stretches of bytes."""
        return self._decoder.errors

    @property
    def busy(self) -> bool:
        """Return whether a request waits for its answers."""
        return self._line.locked()

    async def send(self, frame: bytes) -> bool:
        """Send a frame without an answer, when the line is free; return whether it was sent."""
        async with self._line:
            return self.link.write(frame)

    async def ask(
        self,
        frame: bytes,
        servos: Sequence[int],
        length: int,
        timeout_ns: int = PATIENT_TIMEOUT_NS,
    ) -> dict[int, bytes]:
        """Ask servos for `length` bytes each; return the answers in time, by id.

        The first byte of each answer is its error.
        """
        async with self._line:
            self._decoder.clear()
            self._decoder.expected, self._garbled = length, False
            self._waiting, self._answers = set(servos), {}
            self._complete.clear()
            before = self._decoder.errors
            if self.link.write(frame):
                await self._until_complete(timeout_ns)
            self.unanswered += len(self._waiting)
            self._waiting = set()
            self._garbled = self._decoder.errors > before
        return {
            servo: bytes([its.instruction]) + its.params for servo, its in self._answers.items()
        }

    async def find(self, servo: int) -> str:
        """Return whether a servo is `there`, `missing`, or answers `garbled`."""
        garbled = False
        for _ in range(ATTEMPTS):
            # two servos with one id answer a ping alike, but their measurements differ
            if await self.ask(
                feetech.read(servo, feetech.FIRST, feetech.LENGTH), [servo], feetech.LENGTH
            ):
                return "there"
            garbled = garbled or self._garbled
        return "garbled" if garbled else "missing"

    async def read(self, servo: int, address: int, length: int) -> bytes | None:
        """Return bytes of a control table, or None without an answer."""
        for _ in range(ATTEMPTS):
            answers = await self.ask(feetech.read(servo, address, length), [servo], length)
            if servo in answers:
                return answers[servo][1:]
        return None

    async def confirm(self, servo: int, address: int, length: int) -> bytes | None:
        """Return bytes of a control table that two reads agree on, or None.

        A checksum of 8 bits does not detect all wrong answers.
        """
        before = None
        for _ in range(ATTEMPTS):
            data = await self.read(servo, address, length)
            if data is None or data == before:
                return data
            before = data
        return None

    async def write(self, servo: int, register: feetech.Register, value: int) -> bool:
        """Write an item and read it back; return whether it holds the value."""
        data = register.encode(value)
        for _ in range(ATTEMPTS):
            await self.ask(feetech.write(servo, register.address, data), [servo], 0)
            if await self.read(servo, register.address, register.size) == data:
                return True
        return False

    async def _until_complete(self, timeout_ns: int) -> None:
        """Wait for all answers, at most `timeout_ns`."""
        if self._complete.is_set():
            return
        timeout = asyncio.create_task(self._time_out(timeout_ns))
        try:
            await self._complete.wait()
        finally:
            timeout.cancel()

    async def _time_out(self, timeout_ns: int) -> None:
        await self._clock.sleep_ns(timeout_ns)
        self._complete.set()

    def _take(self, data: bytes) -> None:
        for packet in self._decoder.feed(data):
            if packet.id not in self._waiting:
                continue
            self._waiting.discard(packet.id)
            self._answers[packet.id] = packet
        if not self._waiting:
            self._complete.set()

    def _lost(self, _why: str) -> None:
        self._complete.set()
