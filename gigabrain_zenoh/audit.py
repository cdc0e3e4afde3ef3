"""The audit trail of one process: on `robot/audit`, on disk, and for whoever asks for it later."""

import asyncio
import logging
from dataclasses import dataclass
from pathlib import Path

from gigabrain_schemas.audit import AuditPage, AuditRecord, AuditRequest, What
from gigabrain_schemas.topics import AUDIT, AUDIT_LOG
from gigabrain_zenoh.audit_file import AuditFile
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.scribe import Scribe

log = logging.getLogger(__name__)

AGAIN_NS = 1_000_000_000  # what happens again within this time is counted, not told anew
LASTING_NS = 60_000_000_000  # the same for what goes on for as long as somebody keeps trying
LASTING: tuple[What, ...] = ("refused", "stranger")
MOST = 100  # different entries within that time; beyond them nobody is told apart
ROOM = 1000  # entries that may wait for the disk
OTHERS = "others"

Key = tuple[What, str, str, bool]  # what, source, code, ok


@dataclass
class _Recent:
    """What was told a short while ago, and how often it has happened since."""

    told_ns: int
    times: int = 0
    text: str = ""


class AuditTrail:
    """Writes entries down. Never waits for the disk, and cannot be flooded.

    `flush` is to be called about as often as a second goes by.
    """

    def __init__(self, bus: Bus, folder: Path) -> None:
        self._bus = bus
        self._file = AuditFile(folder, bus.process)
        self._scribe: Scribe[AuditRecord] = Scribe(self._file.append, ROOM)
        self._recent: dict[Key, _Recent] = {}
        self._unwritable = Fault(log)
        bus.serve(AUDIT_LOG, self._history)

    def note(
        self, what: What, source: str, text: str = "", *, code: str = "", ok: bool = True
    ) -> None:
        """Write down that something has happened, and who did it."""
        now_ns = self._bus.clock.now_ns()
        key: Key = (what, source, code, ok)
        if key not in self._recent and len(self._recent) >= MOST:
            key = (what, OTHERS, code, ok)
        recent = self._recent.get(key)
        if recent and now_ns - recent.told_ns < _quiet_ns(key):
            recent.times, recent.text = recent.times + 1, text
            return
        self._recent[key] = _Recent(now_ns)
        self._write(key, text, (recent.times if recent else 0) + 1)

    def flush(self) -> None:
        """Tell what has happened again, and how often."""
        now_ns = self._bus.clock.now_ns()
        for key, recent in list(self._recent.items()):
            if now_ns - recent.told_ns < _quiet_ns(key):
                continue
            if recent.times:
                self._recent[key] = _Recent(now_ns)
                self._write(key, recent.text, recent.times)
            else:
                del self._recent[key]

    async def close(self) -> None:
        """Write down what is still waiting."""
        for key, recent in self._recent.items():
            if recent.times:
                self._write(key, recent.text, recent.times)
        self._recent.clear()
        await self._scribe.close()

    def _write(self, key: Key, text: str, times: int) -> None:
        what, source, code, ok = key
        record = AuditRecord(
            process=self._bus.process,
            what=what,
            source=source[:64],
            ok=ok,
            code=code[:64],
            text=text[:500],
            times=times,
        )
        written = self._scribe.put(self._bus.publish(AUDIT, record))
        written.add_done_callback(self._tell)

    def _tell(self, written: asyncio.Future[str]) -> None:
        self._bus.counters["audit_lost"] = self._scribe.lost
        if problem := written.result():
            self._unwritable.begin(problem)
        else:
            self._unwritable.end("the audit log is written again")

    async def _history(self, request: AuditRequest) -> AuditPage:
        records = await asyncio.to_thread(self._file.newest, request.newest)
        return AuditPage(records=records)


def _quiet_ns(key: Key) -> int:
    return LASTING_NS if key[0] in LASTING else AGAIN_NS
