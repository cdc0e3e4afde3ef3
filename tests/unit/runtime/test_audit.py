"""The audit trail: on disk before long, never overwritten, bounded, and not to be flooded."""

import asyncio
import threading
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from gigabrain_schemas.logs import AuditPage, AuditRecord, AuditRequest
from gigabrain_schemas.topics import AUDIT, AUDIT_LOG
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.runtime.audit import AuditFile, AuditTrail, in_order, read_audit


def entry(number: int, stamp_ns: int = 0) -> AuditRecord:
    return AuditRecord(
        process="driver", what="estop", source="ann", text=str(number), stamp_ns=stamp_ns or number
    )


def texts(records: Sequence[AuditRecord]) -> list[str]:
    return [record.text for record in records]


class Rig:
    """A trail on a fake clock, and what others hear of it."""

    def __init__(self, folder: Path) -> None:
        self.clock, self.network = FakeClock(), LocalNetwork()
        self.bus = Bus(self.network.transport(), self.clock, "driver")
        self.other = Bus(self.network.transport(), self.clock, "other")
        self.received: list[AuditRecord] = []
        self.other.subscribe(AUDIT, lambda _key, record: self.received.append(record))
        self.trail = AuditTrail(self.bus, folder)

    async def after(self, seconds: float) -> None:
        await self.clock.advance(round(seconds * 1e9))
        self.trail.flush()


def test_entries_survive_a_restart_and_are_appended_to(tmp_path: Path) -> None:
    assert AuditFile(tmp_path, "driver").append([entry(1), entry(2)]) == ""
    assert AuditFile(tmp_path, "driver").append([entry(3)]) == ""
    assert texts(read_audit(tmp_path, 10)) == ["1", "2", "3"]
    assert texts(AuditFile(tmp_path, "driver").newest(2)) == ["2", "3"]
    assert read_audit(tmp_path / "nowhere", 10) == ()


def test_a_full_file_is_followed_by_another_and_only_the_oldest_goes(tmp_path: Path) -> None:
    file = AuditFile(tmp_path, "driver", max_bytes=1000, kept=3)
    for number in range(1, 41):
        file.append([entry(number)])
    names = sorted(path.name for path in (tmp_path / "audit").iterdir())
    assert len(names) == 3
    assert all(path.stat().st_size <= 1000 for path in (tmp_path / "audit").iterdir())
    found = texts(read_audit(tmp_path, 1000))
    assert found == [str(number) for number in range(41 - len(found), 41)]
    assert len(found) >= 10


def test_a_torn_line_costs_no_other(tmp_path: Path) -> None:
    file = AuditFile(tmp_path, "driver")
    file.append([entry(1)])
    path = tmp_path / "audit" / "driver-000001.jsonl"
    path.write_bytes(path.read_bytes() + msgspec.json.encode(entry(2))[:20])
    file.append([entry(3)])
    assert texts(read_audit(tmp_path, 10)) == ["1", "3"]


def test_logs_of_several_processes_become_one_and_keep_their_own_order(tmp_path: Path) -> None:
    AuditFile(tmp_path, "driver").append([entry(1, 100), entry(2, 300)])
    AuditFile(tmp_path, "router").append([entry(3, 200)])
    assert texts(read_audit(tmp_path, 10)) == ["1", "3", "2"]
    assert texts(read_audit(tmp_path, 1)) == ["2"]
    assert texts(in_order([[entry(1, 300), entry(2, 100)], [entry(3, 400)]])) == ["1", "2", "3"]


def test_what_follows_a_step_back_of_the_clock_is_the_newest(tmp_path: Path) -> None:
    file = AuditFile(tmp_path, "driver")
    refusal = replace(entry(2, 900), what="refused", ok=False)
    file.append([entry(1, 800), refusal])
    file.append([entry(3, 10), replace(refusal, text="4", stamp_ns=20), entry(5, 30)])
    assert texts(read_audit(tmp_path, 3)) == ["2", "4", "5"]
    assert texts(read_audit(tmp_path, 2)) == ["4", "5"]


def test_a_place_that_cannot_be_written_is_reported_and_does_not_raise(tmp_path: Path) -> None:
    (tmp_path / "audit").write_text("")
    problem = AuditFile(tmp_path, "driver").append([entry(1)])
    assert problem == f"cannot write the audit log in {tmp_path / 'audit'}: File exists"


async def test_an_entry_is_published_at_once_written_and_can_be_asked_for(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.bus.time.boot, rig.bus.time.tick = 7, 205
    rig.trail.note("take", "ann", "ann drives, taken over from control")
    assert rig.received == [
        AuditRecord(
            stamp_ns=1_000_000_000_000_000_000, seq=1, boot=7, tick=205,
            process="driver", what="take", source="ann",
            text="ann drives, taken over from control",
        )
    ]  # fmt: skip
    await rig.trail.close()
    assert read_audit(tmp_path, 10) == tuple(rig.received)
    assert await rig.other.ask(AUDIT_LOG, AuditRequest()) == [
        AuditPage(records=tuple(rig.received))
    ]


async def test_what_happens_again_within_a_second_is_counted(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for _ in range(21):
        rig.trail.note("estop", "ann", "stopped")
    rig.trail.note("estop", "bob", "stopped")
    assert [(r.source, r.times) for r in rig.received] == [("ann", 1), ("bob", 1)]
    await rig.after(0.9)
    assert len(rig.received) == 2
    await rig.after(0.1)
    assert [(r.source, r.times) for r in rig.received[2:]] == [("ann", 20)]
    await rig.after(1.0)
    rig.trail.note("estop", "bob", "stopped")
    assert [(r.source, r.times) for r in rig.received[3:]] == [("bob", 1)]
    await rig.trail.close()


async def test_who_keeps_trying_is_reported_once_a_minute(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for _ in range(59):
        rig.trail.note("refused", "script", "control drives", code="commander", ok=False)
        await rig.after(1.0)
    assert [(r.what, r.times) for r in rig.received] == [("refused", 1)]
    await rig.after(1.0)
    assert [(r.what, r.times) for r in rig.received] == [("refused", 1), ("refused", 58)]
    await rig.trail.close()


async def test_a_crowd_is_reported_as_others(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for number in range(10_000):
        rig.trail.note("refused", f"source-{number}", ok=False)
    assert len(rig.received) == 101
    assert rig.received[-1].source == "others"
    await rig.trail.close()
    assert (rig.received[-1].source, rig.received[-1].times) == ("others", 9899)


@pytest.mark.long
async def test_a_crowd_of_sources_takes_the_place_of_nobody_who_was_obeyed(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for second in range(120):
        for number in range(1000):
            rig.trail.note("refused", f"source-{second}-{number}", code=str(number), ok=False)
        await rig.after(1.0)
    assert len(rig.received) == 100 + 99 + 3  # the others are told at once and after each minute
    rig.trail.note("estop", "ann", "stopped")
    assert rig.received[-1].source == "ann"
    assert sum(map(len, rig.trail._recent.values())) <= 102
    await rig.trail.close()


@pytest.mark.long
async def test_refusals_and_events_push_no_act_of_a_person_out_of_the_log(tmp_path: Path) -> None:
    file = AuditFile(tmp_path, "driver", max_bytes=1000, kept=3)
    file.append([entry(1)])
    for number in range(2, 1000):
        refused = msgspec.structs.replace(entry(number), what="refused", ok=False)
        raised = msgspec.structs.replace(entry(number), what="raised")
        file.append([refused, raised, msgspec.structs.replace(entry(number), ok=False)])
    assert texts(read_audit(tmp_path, 1000))[0] == "1"
    assert texts(file.newest(1000))[0] == "1"
    assert len(list((tmp_path / "audit").iterdir())) == 4


async def test_a_disk_that_hangs_holds_nobody_up_and_the_oldest_give_way() -> None:
    goes_on, batches = threading.Event(), list[Sequence[int]]()

    def write(items: Sequence[int]) -> str:
        goes_on.wait(10)
        batches.append(items)
        return "the disk is full" if 5 in items else ""

    writer = BackgroundWriter(write, room=3)
    first = writer.put(1)
    await asyncio.sleep(0)  # the first batch is on its way
    others = [writer.put(number) for number in (2, 3, 4, 5)]
    assert not first.done()
    goes_on.set()
    assert await first == ""
    assert [await other for other in others] == ["the disk is full"] * 4
    assert batches == [(1,), (3, 4, 5)]
    assert writer.lost == 1
    await writer.close()
