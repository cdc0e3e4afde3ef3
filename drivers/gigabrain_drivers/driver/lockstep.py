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
TIMEOUT_S = 0.15  # wall time per tick
ANNOUNCE_S = 0.2  # period of announcing a tick again, as states are stale after 0.25 s
REPEAT_S = 0.1  # period of announcing the first tick, until the brain answers

MAX_TIMES = 20_000  # newest durations, for the percentiles
MAX_UNANSWERED = 1_000  # scans without an answer that are remembered


class Lockstep:
    """Tracks whether everything that a tick waits for has arrived.

    A tick waits for a command that echoes it. A tick with a scan waits for the command, and for the
    verdict of safety, that are based on that scan. Ticks between scans wait for safety as well: on
    a slow machine, an old verdict would stop the robot. So decisions do not depend on the speed of
    the machine.

    A tick in which cameras take pictures waits for these pictures, or for notice that they are
    withheld. Once perception publishes contours, it also waits for the world with their contours.

    A verdict that misses a part of the brain does not count: that part answered before safety
    subscribed, so it would depend on chance whether safety gets its next answer in time.
    """

    def __init__(self, period_ticks: int = 1, timeout_s: float = TIMEOUT_S) -> None:
        self._timeout_s = timeout_s
        self._period_ticks = period_ticks  # from one command of control to the next
        self._announced_tick = 0
        self._command_tick = 0  # tick that a command has to echo
        self._scan_tick = 0  # tick that it has to be based on
        self._echoed = self._echo_basis = self._judged_basis = 0  # the newest received
        self._safety_tick = 0  # tick of the newest verdict
        self._required_tick = 0  # oldest tick of a verdict that suffices
        self._exposed: dict[str, int] = {}  # tick of each camera's newest exposure
        self._pictures: dict[str, int] = {}  # tick of its newest picture
        self._contours: dict[str, int] = {}  # tick of its newest contours
        self._wake = asyncio.Event()
        self.timeouts = 0  # ticks that ended without an answer
        self._fault = Fault(log)  # never ended, so only the first timeout is logged

    def begin(self, tick: int, basis: int, exposed: Iterable[str] = ()) -> None:
        """Begin to wait for `tick`; `basis` is the tick of the newest scan, or 0.

        `exposed` are the cameras that take a picture in this tick.
        """
        self._exposed.update(dict.fromkeys(exposed, tick))
        self._announced_tick, self._scan_tick = tick, basis
        self._command_tick = tick - tick % self._period_ticks
        # safety need not repeat its verdict in every tick
        self._required_tick = max(1, tick - REPEAT_TICKS + 1)
        self._wake.clear()

    def command(self, command: CmdVel | JointCommand) -> None:
        """Note a command. Without a basis, it is of a commander that needs no scan.

        A command that echoes a future tick is ignored.
        """
        if max(command.tick, command.basis) > self._announced_tick:
            return
        self._echoed = max(self._echoed, command.tick)
        basis = command.basis if command.source == BRAIN else command.tick
        self._echo_basis = max(self._echo_basis, basis)
        self._wake.set()

    def verdict(self, verdict: SafetyState) -> None:
        """Note a verdict of safety."""
        silent = any(cause.code in BRAIN_SILENT for cause in verdict.causes)
        if silent or max(verdict.tick, verdict.basis) > self._announced_tick:
            return
        self._judged_basis = max(self._judged_basis, verdict.basis)
        self._safety_tick = max(self._safety_tick, verdict.tick)
        self._wake.set()

    def picture(self, camera: str, basis: int) -> None:
        """Note a picture, or the notice that it is withheld."""
        if basis <= self._announced_tick:
            self._pictures[camera] = max(self._pictures.get(camera, 0), basis)
            self._wake.set()

    def forget_pictures(self) -> None:
        """Stop waiting for pictures that have not arrived."""
        self._exposed.clear()

    def world(self, world: WorldModel) -> None:
        """Note the contours of a world."""
        for camera in world.cameras:
            if camera.ok and 0 < camera.exposure <= self._announced_tick:
                self._contours[camera.name] = camera.exposure
            elif not camera.ok:  # it will get no contours
                self._contours.pop(camera.name, None)
        self._wake.set()

    @property
    def complete(self) -> bool:
        """True once everything has arrived."""
        return next(self._missing(), None) is None

    def _missing(self) -> Iterator[str]:
        """Yield descriptions of what has not arrived."""
        if self._echoed < self._command_tick or self._echo_basis < self._scan_tick:
            yield "a command"
        if self._judged_basis < self._scan_tick or self._safety_tick < self._required_tick:
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
        """Wait for the answer, and count a timeout if it does not come.

        Meanwhile `again` announces the tick again, so that its state does not become stale.
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
                f"tick {self._announced_tick} went on after {self._timeout_s:g} s without {missing}"
            )
            return


class RoundTrip:
    """Measures the time from each scan to the first command based on it or on a newer one.

    Scans that the brain skipped count as well; otherwise slow answers would improve the figures.
    """

    def __init__(self) -> None:
        self.scan_tick = 0  # newest tick that carried a scan
        self._waiting: deque[tuple[int, int]] = deque(maxlen=MAX_UNANSWERED)  # tick, sent at [ns]
        self._durations_ms = NewestValues(MAX_TIMES)

    def sent(self, tick: int, now_ns: int) -> None:
        """Note that the scan of `tick` was published."""
        self.scan_tick = tick
        self._waiting.append((tick, now_ns))

    def answered(self, basis: int, now_ns: int, *, counts: bool) -> None:
        """Note a command based on `basis`; only those with `counts` are measured."""
        while self._waiting and self._waiting[0][0] <= basis:
            _, sent_ns = self._waiting.popleft()
            if counts:
                self._durations_ms.add((now_ns - sent_ns) / 1e6)

    def report(self) -> Mapping[str, float | int | None]:
        """Return the figures for reports [ms]; None before the first scan is answered."""
        durations = self._durations_ms
        return {
            "scan_to_cmd_n": len(durations),
            "scan_to_cmd_p50_ms": durations.percentile(0.50),
            "scan_to_cmd_p99_ms": durations.percentile(0.99),
        }
