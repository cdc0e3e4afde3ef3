"""The audit trail of one process: on `robot/audit`, on disk, and for whoever asks for it later."""

import asyncio
import logging
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from gigabrain_schemas.audit import AuditPage, AuditRecord, AuditRequest, What
from gigabrain_schemas.topics import AUDIT, AUDIT_LOG
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.host.scribe import Scribe
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.runtime.audit_file import AuditFile

log = logging.getLogger(__name__)

AGAIN_NS = 1_000_000_000  # what happens again within this time is counted, not told anew
LASTING_NS = 60_000_000_000  # the same for what goes on for as long as somebody keeps trying
LASTING: tuple[What, ...] = ("refused", "stranger")
MAX_SOURCES = 100  # entries told apart within that time, of what was granted and of what was not
MAX_CODES = 20  # that one entry counts apart
ROOM = 1000  # entries that may wait for the disk
OTHERS, OTHER = "others", "other"

Key = tuple[What, str, str]  # what, source, code; no code where all codes of a source are one entry


@dataclass
class _Recent:
    """What has happened since it was last told, by code."""

    told_ns: int
    codes: Counter[str] = field(default_factory=Counter)
    text: str = ""

    def add(self, code: str, text: str) -> None:
        known = code in self.codes or len(self.codes) < MAX_CODES
        self.codes[code if known else OTHER] += 1
        self.text = text


class AuditTrail:
    """Writes entries down. Never waits for the disk, and cannot be flooded.

    `flush` is to be called about as often as a second goes by.
    """

    def __init__(self, bus: Bus, folder: Path) -> None:
        self._bus = bus
        self._file = AuditFile(folder, bus.process)
        self._scribe: Scribe[AuditRecord] = Scribe(self._file.append, ROOM)
        self._recent: dict[bool, dict[Key, _Recent]] = {True: {}, False: {}}  # by `ok`
        self._unwritable = Fault(log)
        self._reading = asyncio.Lock()  # many threads that decode would hold up the loop
        bus.serve(AUDIT_LOG, self._history)

    def note(
        self, what: What, source: str, text: str = "", *, code: str = "", ok: bool = True
    ) -> None:
        """Write down that something has happened, and who did it.

        Of refusals a source has one entry a minute, however many codes it comes with.
        """
        now_ns = self._bus.clock.now_ns()
        source, code, text = source[:64], code[:64], text[:500]
        known = self._recent[ok]
        key: Key = (what, source, "" if what == "refused" else code)
        if key not in known and len(known) >= MAX_SOURCES:
            key = (what, OTHERS, "")
        recent = known.get(key)
        new = recent is None
        if recent is None:
            recent = known[key] = _Recent(now_ns)
        recent.add(code, text)
        if new or now_ns - recent.told_ns >= _quiet_ns(key):
            self._tell(key, recent, ok)

    def flush(self) -> None:
        """Tell what has happened again, and how often."""
        now_ns = self._bus.clock.now_ns()
        for ok, known in self._recent.items():
            for key, recent in list(known.items()):
                age_ns = now_ns - recent.told_ns
                if recent.codes and age_ns >= _quiet_ns(key):
                    self._tell(key, recent, ok)
                elif age_ns >= LASTING_NS:
                    del known[key]

    async def close(self) -> None:
        """Write down what is still waiting."""
        for ok, known in self._recent.items():
            for key, recent in known.items():
                if recent.codes:
                    self._tell(key, recent, ok)
            known.clear()
        await self._scribe.close()

    def _tell(self, key: Key, recent: _Recent, ok: bool) -> None:
        what, source, _ = key
        (code, _), *others = recent.codes.most_common()
        kinds = f"; {_tally(recent.codes)}" if others else ""
        record = AuditRecord(
            process=self._bus.process,
            what=what,
            source=source,
            ok=ok,
            code=code,
            text=recent.text[: 500 - len(kinds)] + kinds,
            times=recent.codes.total(),
        )
        recent.told_ns, recent.codes = self._bus.clock.now_ns(), Counter()
        written = self._scribe.put(self._bus.publish(AUDIT, record))
        written.add_done_callback(self._written)

    def _written(self, written: asyncio.Future[str]) -> None:
        self._bus.counters["audit_lost"] = self._scribe.lost
        if problem := written.result():
            self._unwritable.begin(problem)
        else:
            self._unwritable.end("the audit log is written again")

    async def _history(self, request: AuditRequest) -> AuditPage:
        async with self._reading:
            records = await asyncio.to_thread(self._file.newest, request.newest)
        return AuditPage(records=records)


def _quiet_ns(key: Key) -> int:
    what, source, _ = key
    return LASTING_NS if what in LASTING or source == OTHERS else AGAIN_NS


def _tally(codes: Counter[str]) -> str:
    """`put robot/cmd_vel 199, query robot/release 1`, as far as there is room."""
    return ", ".join(f"{code} {times}" for code, times in codes.most_common())[:200]
