"""The gate of one body: its file on disk, the requests to it, and its audit log."""

import logging
import secrets
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Cause
from gigabrain_schemas.logs import What
from gigabrain_schemas.requests import (
    EnableRequest,
    EstopRequest,
    GateReply,
    LimpRequest,
    ReleaseRequest,
)
from gigabrain_schemas.topics import ENABLE, ESTOP, ESTOP_TOPIC, LIMP, RELEASE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.errors import ConfigError, DiskFull, GigabrainError, Refused
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.gate.gate import GateState
from gigabrain_zenoh.geometry.limits import Limits
from gigabrain_zenoh.host.files import cannot_write, make_folder, read_bounded, replace_file
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.runtime.audit import AuditTrail

log = logging.getLogger(__name__)

MAX_LATCH_BYTES = 65_536
UNREADABLE = Cause(
    code="latch_unreadable",
    text="the file with the gate's latched causes cannot be read",
    latching=True,
    remedy="check the robot, then release it",
)

CausesByCode = dict[str, tuple[str, Cause]]  # by code: origin (gate, driver or safety) and cause
ON_TIME_NS = TICK_NS // 2  # a tick at least this long after the previous one is on time
DISK_RETRY_TICKS = 50  # failed writes are retried once a second
REMEDY = "make it writable, or name another with --state-dir or XDG_STATE_HOME"
Stop = Callable[[], Awaitable[None]]
SetLimp = Callable[[bool], Awaitable[None]]


class Latched(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of a latch file."""

    causes: tuple[Cause, ...] = ()
    estop_generation: Annotated[int, Meta(ge=0, le=2**62)] = 0  # leaves room to count on


class LatchFile:
    """A small file, replaced as a whole and synced."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder / "latch.json"
        self._written = Latched()

    def read(self) -> Latched:
        """Return the latched state of the last driver; an unreadable file counts as latched.

        Raises ConfigError if the folder cannot be written, and DiskFull.
        """
        try:
            make_folder(self._folder)
            found = msgspec.json.decode(read_bounded(self._path, MAX_LATCH_BYTES), type=Latched)
            self._written = found  # it need not be written, even if the disk is full
        except FileNotFoundError:
            found = Latched()
        except (ConfigError, *DECODE_ERRORS):
            found = Latched(causes=(UNREADABLE,))
        except OSError as error:
            raise cannot_write(self._folder, error, REMEDY) from None
        self.write(found)
        return found

    def try_write(self, latched: Latched) -> str:
        """Write; return the problem in one line, or an empty text. Not thread-safe."""
        try:
            self.write(latched)
        except ConfigError as error:
            return str(error)
        return ""

    def write(self, latched: Latched) -> None:
        """Write to disk, synced. Raises ConfigError and DiskFull like `read`."""
        if latched == self._written and self._path.exists():
            return
        try:
            replace_file(self._path, msgspec.json.encode(latched))
        except OSError as error:
            raise cannot_write(self._folder, error, REMEDY) from None
        self._written = latched


async def wait_for_disk(folder: Path, clock: Clock) -> None:
    """Wait until the disk has space for the latch; otherwise a restart would forget an e-stop.

    Raises ConfigError if the folder cannot be written for another reason.
    """
    logged = False
    while True:
        try:
            LatchFile(folder).read()
        except DiskFull as error:
            if not logged:
                log.warning("%s; waiting for it", error, extra={"data": {"event": "disk full"}})
            logged = True
            await clock.sleep_ns(DISK_RETRY_TICKS * TICK_NS)
        else:
            return


class CauseWatch:
    """Audits the causes that appear and disappear."""

    def __init__(self, trail: AuditTrail) -> None:
        self._trail = trail
        self._known: CausesByCode = {}

    def audit_changes(self, state: GateState) -> None:
        """Audit new causes, and those that are gone."""
        before = self._known
        now = {code: before.get(code, found) for code, found in present_causes(state).items()}
        for code, (who, cause) in now.items():
            if code not in before:
                self._trail.note("raised", who, cause.text, code=code)
        for code, (who, cause) in before.items():
            if code not in now:
                self._trail.note("cleared", who, cause.text, code=code)
        self._known = now


def present_causes(state: GateState) -> CausesByCode:
    """Return every present cause by its code, with its origin: gate, driver or safety."""
    safety = state.safety
    found: CausesByCode = {cause.code: ("gate", cause) for cause in state.causes}
    found |= {cause.code: ("driver", cause) for cause in state.faults}
    for cause in (*safety.causes, *safety.warnings) if safety else ():
        found[cause.code] = ("safety", cause)
    return found


class Gatekeeper:
    """Steps the gate, and serves requests to it. An e-stop is on disk before it is confirmed.

    `changed` is called for each new command to the body.
    """

    def __init__(
        self,
        config: gate.GateConfig,
        robot_type: str,
        bus: Bus,
        folder: Path,
        changed: Callable[[], None],
    ) -> None:
        self._config, self._robot_type, self._bus = config, robot_type, bus
        self._output_changed = changed
        file = LatchFile(folder)
        latched = file.read()
        self._writer: BackgroundWriter[Latched] = BackgroundWriter(
            lambda newest: file.try_write(newest[-1]), room=1
        )
        self._latched, self._on_disk = latched, self._writer.put(latched)
        self._last_on_time_ns = -ON_TIME_NS  # of the newest tick that was not late
        self._disk_fault = Fault(log, logging.ERROR)
        self.state = gate.GateState(
            boot=secrets.randbits(47) + 1,
            causes=latched.causes or (why.BOOT,),
            estop_generation=latched.estop_generation,
        )
        bus.time.boot = self.state.boot
        self._trail = AuditTrail(bus, folder)
        self._causes = CauseWatch(self._trail)
        self._trail.note("boot", bus.process, f"the driver of {robot_type} has started")

    def serve(self, stop: Stop) -> None:
        """Serve requests; `stop` brings the body to rest."""
        self._stop = stop
        self._bus.serve(ESTOP, self._on_estop)
        self._bus.subscribe(
            ESTOP_TOPIC,
            lambda _, request: self._stop_without_reply(request),
            self._on_undecodable_estop,
        )
        self._bus.serve(RELEASE, self._on_release)
        self._bus.serve(ENABLE, self._on_enable)

    def serve_limp(self, set_limp: SetLimp) -> None:
        """Serve requests to make an arm limp or hold it, while the gate is not enabled.

        `set_limp` raises a GigabrainError with the reason if that is impossible.
        """

        async def answer(request: LimpRequest) -> GateReply:
            outcome = await self._try_limp(set_limp, request.limp)
            self._audit("limp" if request.limp else "hold", request.source, outcome)
            return self._reply(outcome)

        self._bus.serve(LIMP, answer)

    async def _try_limp(self, set_limp: SetLimp, limp: bool) -> gate.Outcome:
        """Make the joints limp or hold them; return the outcome."""
        try:
            self.refuse_if_enabled()
            await set_limp(limp)
        except GigabrainError as error:
            return gate.Outcome(ok=False, text=str(error))
        done = "all joints are limp" if limp else "the joints hold their positions"
        return gate.Outcome(text=done)

    def refuse_if_enabled(self) -> None:
        """Raise Refused while the gate is enabled or stopping."""
        if self.state.mode in ("enabled", "stopping"):
            holder = self.state.commander or "the gate"
            raise Refused(f"{holder} holds the arm; press the e-stop first")

    def limit(self, limits: Limits) -> None:
        """Replace the limits of commands. A body that is faster slows down with its ramp."""
        self._config = replace(self._config, limits=limits)

    def step(self, event: gate.Event) -> gate.Outcome:
        """Step the gate by one event."""
        before = self.state
        self.state, outcome = gate.step(self._config, before, event)
        if self.state.output != before.output:
            self._output_changed()
        if _has_visible_change(before, self.state):
            self._note_change(before)
        return outcome

    def command(self, event: gate.VelocityCommand | gate.JointsCommand) -> gate.Outcome:
        """Step the gate by a command; a refused one is counted and audited."""
        outcome = self.step(event)
        reason, source = outcome.refused, event.command.source
        if reason:
            self._bus.counters[f"refused_{reason}"] += 1
        if reason and source != gate.BRAIN:  # the brain keeps sending while others drive
            drives = self.state.commander or "nobody"
            text = f"its commands are not obeyed ({reason}); {drives} drives"
            self._trail.note("refused", source or "anonymous", text, code=reason, ok=False)
        return outcome

    def ticks(self, passed: int, tick: gate.Tick) -> None:
        """Step the gate by the `passed` ticks since the last call; all but one were missed."""
        for _ in range(passed):
            late = self._is_late(tick.wall_ns)
            self._bus.counters["late_ticks"] += late
            self.step(replace(tick, late=True) if late else tick)
            self._retry_disk()

    def _is_late(self, wall_ns: int | None) -> bool:
        """Return whether a tick was missed, and is processed in a burst after another one."""
        if wall_ns is None:
            return False
        late = wall_ns - self._last_on_time_ns < ON_TIME_NS
        self._last_on_time_ns = self._last_on_time_ns if late else wall_ns
        return late

    def _retry_disk(self) -> None:
        if self.state.tick % DISK_RETRY_TICKS == 0:
            self._trail.flush()
            if self._on_disk.done() and self._on_disk.result():
                self._store(self._latched)

    async def close(self) -> None:
        """Write everything that is pending, and stop."""
        self._trail.note("end", self._bus.process, "the driver ends")
        await self._trail.close()
        await self._writer.close()

    def _note_change(self, before: gate.GateState) -> None:
        now = self.state
        latched = Latched(causes=why.latching(now.causes), estop_generation=now.estop_generation)
        if latched != self._latched:
            self._store(latched)
        self._causes.audit_changes(now)
        if now.mode != before.mode:
            reason = why.in_words(now.causes) or f"commander {now.commander or 'nobody'}"
            data = {"event": "gate", "mode": now.mode, "tick": now.tick, "reason": reason}
            log.info("gate %s: %s", now.mode, reason, extra={"data": data})
            who = now.commander or before.commander or "gate"
            self._trail.note("mode", who, f"{before.mode} -> {now.mode}: {reason}", code=now.mode)

    def _store(self, latched: Latched) -> None:
        self._latched, self._on_disk = latched, self._writer.put(latched)

    async def _disk_problem(self) -> str:
        """Wait for the disk; return the text to add to a reply if it failed."""
        problem = await self._on_disk
        if not problem:
            self._disk_fault.end("latched causes are stored again")
            return ""
        self._disk_fault.begin(problem)
        return f"; but a restart would lose it: {problem}"

    def press(self, text: str) -> None:
        """Latch and stop, as this robot's e-stop button is pressed."""
        self._stop_without_reply(EstopRequest(source="button", reason=text))

    def _stop_without_reply(self, request: EstopRequest) -> None:
        """Latch and stop for a sender that expects no answer."""
        outcome = self.step(gate.Estop(request.source))
        self._output_changed()
        log.warning("e-stop by %s %s", request.source, request.reason)
        self._audit("estop", request.source, outcome, request.reason)

    def _on_undecodable_estop(self, payload: bytes) -> None:
        if not payload:
            self._stop_without_reply(EstopRequest())

    async def _on_estop(self, request: EstopRequest) -> GateReply:
        outcome = self.step(gate.Estop(request.source))
        await self._stop()  # before disk and log
        log.warning("e-stop by %s %s", request.source, request.reason)
        self._audit("estop", request.source, outcome, request.reason)
        return self._reply(outcome, await self._disk_problem())

    async def _on_release(self, request: ReleaseRequest) -> GateReply:
        outcome = self.step(gate.Release(request.estop_generation))
        self._audit("release", request.source, outcome)
        return self._reply(outcome, await self._disk_problem())

    async def _on_enable(self, request: EnableRequest) -> GateReply:
        before = self.state.commander
        outcome = self.step(gate.Enable(request.source, request.take, request.by))
        taken = outcome.ok and before not in ("", request.source)
        detail = f"taken over from {before}" if taken else ""
        who = request.by or request.source
        self._audit("take" if taken else "enable", who, outcome, detail)
        return self._reply(outcome)

    def _audit(self, what: What, source: str, outcome: gate.Outcome, detail: str = "") -> None:
        text = ", ".join(part for part in (outcome.text, detail) if part)
        self._trail.note(what, source or "anonymous", text, ok=outcome.ok)

    def _reply(self, outcome: gate.Outcome, suffix: str = "") -> GateReply:
        return GateReply(
            ok=outcome.ok,
            text=(outcome.text + suffix)[:500],
            robot_type=self._robot_type,
            gate=gate.status(self.state),
        )


def _has_visible_change(before: gate.GateState, now: gate.GateState) -> bool:
    """Return whether causes or mode differ, to be logged; after most events they do not."""
    return (
        now.mode != before.mode
        or now.estop_generation != before.estop_generation
        or now.causes is not before.causes
        or now.faults is not before.faults
        or _safety_causes(now) != _safety_causes(before)
    )


def _safety_causes(state: gate.GateState) -> tuple[tuple[Cause, ...], ...]:
    return (state.safety.causes, state.safety.warnings) if state.safety else ()
