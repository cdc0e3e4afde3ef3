"""A router's door: strangers and denials are seen, and written down within a second."""

from pathlib import Path

import pytest

from gigabrain_schemas.logs import AuditRecord
from gigabrain_schemas.topics import AUDIT
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Link, LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.runtime import audit
from gigabrain_zenoh.runtime.audit import AuditTrail
from gigabrain_zenoh.runtime.router import AccessAudit, Denied, TurnedAway, ZenohLog

ZID = "4869ee9928fa158cf819ad0d7cad9dc4"
ACCESS = "2026-11-21T03:07:13.9Z TRACE  rx-0 ThreadId(11) zenoh::net::routing::interceptor"
WHO = f"{ZID} on Interface(lo)+CertCommonName(viewer)+Transport(Tls)+{ZID}"


def read(*lines: str) -> list[object]:
    return list(ZenohLog().feed("".join(f"{line}\n" for line in lines).encode()))


def test_a_denial_is_two_lines_of_one_thread() -> None:
    denied = f"{ACCESS}::access_control: {WHO} is unauthorized to Put (ingress) on robot/cmd_vel"
    dropped = f"{ACCESS}: Msg intercepted!"
    assert read(denied, dropped) == [Denied(ZID, "Put", "robot/cmd_vel")]
    assert read(denied) == read(dropped) == []  # what it works out beforehand is no denial
    assert read(denied, dropped.replace("(11)", "(12)")) == []
    cached = f"{ACCESS}::access_control: Using cached result: {ZID} is unauthorized to Put "
    assert read(f"{cached}(ingress) on a/b", dropped) == [Denied(ZID, "Put", "a/b")]
    assert read(f"{cached}(egress) on a/b", dropped) == []
    assert read(denied.replace("cmd_vel", "\x1b[31mx\x07"), dropped) == [
        Denied(ZID, "Put", "robot/x\N{REPLACEMENT CHARACTER}")
    ]


def test_who_is_turned_away_is_reported_and_what_is_not_zenohs_is_left_out() -> None:
    line = (
        "2026-11-21T02:53:18.4Z \x1b[33m WARN\x1b[0m acc-0 ThreadId(05) zenoh_link_tls::unicast: "
        "peer sent no certificates. Hint: increase the system open file limit."
    )
    assert read(line) == [TurnedAway("peer sent no certificates")]
    assert read('{"event":"progress"}') == []


class Rig:
    """A door on a fake clock, where viewer@red has come in, and what it writes down."""

    def __init__(self, folder: Path) -> None:
        self.clock, network = FakeClock(), LocalNetwork()
        self.folder, self.bus = folder, Bus(network.transport(), self.clock, "router")
        self.received: list[AuditRecord] = []
        other = Bus(network.transport(), self.clock, "other")
        other.subscribe(AUDIT, lambda _key, record: self.received.append(record))
        self.trail = AuditTrail(self.bus, folder)
        self.door = AccessAudit(self.trail, {"viewer@red"})
        self.door.note_link(Link(ZID, "viewer@red", "tls/127.0.0.1:5", open=True))


@pytest.mark.long
async def test_40000_denials_are_one_record_a_minute_and_push_out_no_estop(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for what in ("boot", "estop", "release", "enable"):
        rig.trail.note(what, "ann", "before the flood")
    for number in range(40_000):
        rig.door.note_denial(Denied(ZID, "Put", f"red/robot/{number}"))
        if number % 10_000 == 9_999:  # 20 s
            await rig.clock.advance(20_000_000_000)
            rig.trail.flush()
    rig.door.note_denial(Denied(ZID, "Query", "red/robot/release/x"))
    refused = [record for record in rig.received if record.what == "refused"]
    assert [(r.source, r.code, r.times) for r in refused] == [
        ("viewer@red", "put other", 1),
        ("viewer@red", "put other", 29_999),
    ]
    assert len(rig.trail._recent[False]) == 1
    await rig.trail.close()
    assert [(r.what, r.text[:16]) for r in audit.read_audit(tmp_path, 10)][:4] == [
        ("boot", "before the flood"),
        ("estop", "before the flood"),
        ("release", "before the flood"),
        ("enable", "before the flood"),
    ]
    last = rig.received[-1]
    assert (last.code, last.times) == ("put other", 10_001)
    assert last.text == (
        "viewer@red at tls/127.0.0.1:5 may not query red/robot/release/x; "
        "put other 10000, query robot/release 1"
    )


@pytest.mark.long
async def test_why_strangers_are_turned_away_is_reported_without_what_they_choose(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path)
    for port in range(40_000):
        rig.door.note_denial(TurnedAway(f"invalid peer at 10.0.0.1:{port} says {port:x}1"))
    assert [(r.source, r.code) for r in rig.received] == [("unknown", "invalid peer at … says …")]
    await rig.trail.close()


def test_a_flood_of_threads_in_zenohs_log_takes_no_memory() -> None:
    log = ZenohLog()
    line = f"{ACCESS}::access_control: {WHO} is unauthorized to Put (ingress) on robot/cmd_vel\n"
    for thread in range(1000):
        assert list(log.feed(line.replace("(11)", f"({thread})").encode())) == []
    assert len(log._unconfirmed) <= 100
