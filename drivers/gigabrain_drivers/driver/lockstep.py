"""Lock-step of a simulation with the brain, and the round trip from scan to command."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping

from gigabrain_schemas.brain import CmdVel, JointCommand, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.gate.causes import BRAIN_SILENT
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.stopping import REPEAT_TICKS
from gigabrain_zenoh.host.bounded import NewestValues
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)
TIMEOUT_S = 0.15  # of wall time per tick
ANNOUNCE_S = 0.2  # of waiting, then a tick is announced again: states are stale after 0.25 s
REPEAT_S = 0.1  # how often the first tick is announced until the brain is there

MAX_TIMES = 20_000  # newest times that the figures are drawn from
MAX_UNANSWERED = 1_000  # scans that may be unanswered; a brain that is away answers none


class Lockstep:
    """Tracks whether everything that a tick waits for has arrived.

    A tick waits for a command that echoes it. A tick with a scan waits for the command, and for the
    verdict of safety, that rest on that scan. Between scans safety is waited for as well: a verdict
    that is old by the robot's clock would stop it, where only the machine is slow. So decisions do
    not depend on how fast a machine is.

    A tick in which cameras take pictures waits for these, or for word that they are withheld, and
    for the world that has their contours, once perception has shown that it makes some.

    A verdict that misses a part of the brain does not count: that part answered before safety
    listened, and whether safety gets its next answer in time would be left to chance.
    """

    def __init__(self, period_ticks: int = 1, timeout_s: float = TIMEOUT_S) -> None:
        self._timeout_s = timeout_s
        self._period = period_ticks  # from one command of control to the next
        self._tick = self._basis = self._newest = 0
        self._echo = self._echo_basis = self._judged = 0
        self._seen = self._wanted = 0  # the tick that safety has seen, and the one it must have
        self._exposed: dict[str, int] = {}  # tick of each camera's newest exposure
        self._pictures: dict[str, int] = {}  # the one of its newest picture
        self._contours: dict[str, int] = {}  # the one of the newest contours
        self._wake = asyncio.Event()
        self.timeouts = 0  # ticks that went on without the brain
        self._fault = Fault(log)  # never ended: only the first of them is logged

    def begin(self, tick: int, basis: int, exposed: Iterable[str] = ()) -> None:
        """A tick has been sent out; `basis` is the tick of the newest scan, or 0.

        `exposed` are the cameras that take a picture in it.
        """
        self._exposed.update(dict.fromkeys(exposed, tick))
        self._tick, self._basis, self._newest = tick - tick % self._period, basis, tick
        self._wanted = max(1, tick - REPEAT_TICKS + 1)  # it need not say the same in every tick
        self._wake.clear()

    def command(self, command: CmdVel | JointCommand) -> None:
        """Note a command. One without a basis comes from a commander that needs no scan.

        One that echoes a tick that has not been sent out yet answers nothing.
        """
        if max(command.tick, command.basis) > self._newest:
            return
        self._echo = max(self._echo, command.tick)
        basis = command.basis if command.source == BRAIN else command.tick
        self._echo_basis = max(self._echo_basis, basis)
        self._wake.set()

    def verdict(self, verdict: SafetyState) -> None:
        """Safety has spoken."""
        silent = any(cause.code in BRAIN_SILENT for cause in verdict.causes)
        if silent or max(verdict.tick, verdict.basis) > self._newest:
            return
        self._judged = max(self._judged, verdict.basis)
        self._seen = max(self._seen, verdict.tick)
        self._wake.set()

    def picture(self, camera: str, basis: int) -> None:
        """A picture has come, or word that it is withheld."""
        if basis <= self._newest:
            self._pictures[camera] = max(self._pictures.get(camera, 0), basis)
            self._wake.set()

    def forget_pictures(self) -> None:
        """Wait for no picture that has not come yet."""
        self._exposed.clear()

    def world(self, world: WorldModel) -> None:
        """Perception has seen something."""
        for camera in world.cameras:
            if camera.ok and 0 < camera.exposure <= self._newest:
                self._contours[camera.name] = camera.exposure
            elif not camera.ok:  # no contours are to come
                self._contours.pop(camera.name, None)
        self._wake.set()

    @property
    def complete(self) -> bool:
        """True once the tick has been answered."""
        return next(self._missing(), None) is None

    def _missing(self) -> Iterator[str]:
        """Yield what has not come yet, in words."""
        if self._echo < self._tick or self._echo_basis < self._basis:
            yield "a command"
        if self._judged < self._basis or self._seen < self._wanted:
            yield "a verdict of safety"
        for name, tick in self._exposed.items():
            if self._pictures.get(name, 0) < tick:
                yield f"a picture of the camera {name}"
            elif self._contours.get(name, tick) < tick:
                yield f"the contours of the camera {name}"

    async def wait(self, timeout_s: float) -> bool:
        """Wait for the answer; return whether it came in time."""
        try:
            async with asyncio.timeout(timeout_s):
                while not self.complete:
                    self._wake.clear()
                    await self._wake.wait()
        except TimeoutError:
            return False
        return True

    async def answered(self, again: Callable[[], object]) -> None:
        """Wait as long as a tick waits, and count where that was in vain.

        Meanwhile `again` announces the tick again, so that its state does not grow stale.
        """
        left_s = self._timeout_s
        while not await self.wait(min(left_s, ANNOUNCE_S)):
            left_s -= ANNOUNCE_S
            if left_s > 0:
                again()
                continue
            self.timeouts += 1
            missing = ", ".join(self._missing())
            self._fault.begin(
                f"tick {self._newest} went on after {self._timeout_s:g} s without {missing}"
            )
            return


class RoundTrip:
    """Times each scan from its departure to the first command that rests on it, or on a newer one.

    A scan that the brain has skipped counts as well, else slow answers would flatter the figures.
    """

    def __init__(self) -> None:
        self.scan_tick = 0  # newest tick that carried a scan
        self._waiting: deque[tuple[int, int]] = deque(maxlen=MAX_UNANSWERED)  # tick, sent at [ns]
        self._times_ms = NewestValues(MAX_TIMES)

    def sent(self, tick: int, now_ns: int) -> None:
        """The scan of `tick` is on its way."""
        self.scan_tick = tick
        self._waiting.append((tick, now_ns))

    def answered(self, basis: int, now_ns: int, *, counts: bool) -> None:
        """Note a command that rests on `basis`; only those with `counts` are timed."""
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
