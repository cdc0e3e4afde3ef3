"""A router's door: strangers and denials are seen, and written down within a second."""

import asyncio
import contextlib
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import zenoh

from gigabrain_schemas.audit import AuditRecord
from gigabrain_schemas.topics import AUDIT
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Link, LocalNetwork
from gigabrain_zenoh.client.robot import connect
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import NotConfirmed
from gigabrain_zenoh.runtime import audit_file
from gigabrain_zenoh.runtime.audit import AuditTrail
from gigabrain_zenoh.runtime.door import Door
from gigabrain_zenoh.runtime.zenoh_log import Denied, TurnedAway, ZenohLog
from tests.keys_rig import make_fleet, raw
from tests.stack import Command, Home, free_port, robot_of, until

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


def test_who_is_turned_away_is_told_and_what_is_not_zenohs_is_left_out() -> None:
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
        self.heard: list[AuditRecord] = []
        other = Bus(network.transport(), self.clock, "other")
        other.subscribe(AUDIT, lambda _key, record: self.heard.append(record))
        self.trail = AuditTrail(self.bus, folder)
        self.door = Door(self.trail, {"viewer@red"})
        self.door.link(Link(ZID, "viewer@red", "tls/127.0.0.1:5", there=True))


async def test_40000_denials_are_one_record_a_minute_and_push_out_no_estop(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for what in ("boot", "estop", "release", "enable"):
        rig.trail.note(what, "ann", "before the flood")
    for number in range(40_000):
        rig.door.seen(Denied(ZID, "Put", f"red/robot/{number}"))
        if number % 10_000 == 9_999:  # 20 s
            await rig.clock.advance(20_000_000_000)
            rig.trail.flush()
    rig.door.seen(Denied(ZID, "Query", "red/robot/release/x"))
    refused = [record for record in rig.heard if record.what == "refused"]
    assert [(r.source, r.code, r.times) for r in refused] == [
        ("viewer@red", "put other", 1),
        ("viewer@red", "put other", 29_999),
    ]
    assert len(rig.trail._recent[False]) == 1
    await rig.trail.close()
    assert [(r.what, r.text[:16]) for r in audit_file.read(tmp_path, 10)][:4] == [
        ("boot", "before the flood"),
        ("estop", "before the flood"),
        ("release", "before the flood"),
        ("enable", "before the flood"),
    ]
    last = rig.heard[-1]
    assert (last.code, last.times) == ("put other", 10_001)
    assert last.text == (
        "viewer@red at tls/127.0.0.1:5 may not query red/robot/release/x; "
        "put other 10000, query robot/release 1"
    )


async def test_why_strangers_are_turned_away_is_told_without_what_they_choose(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path)
    for port in range(40_000):
        rig.door.seen(TurnedAway(f"invalid peer at 10.0.0.1:{port} says {port:x}1"))
    assert [(r.source, r.code) for r in rig.heard] == [("unknown", "invalid peer at … says …")]
    await rig.trail.close()


def test_a_flood_of_threads_in_zenohs_log_takes_no_memory() -> None:
    log = ZenohLog()
    line = f"{ACCESS}::access_control: {WHO} is unauthorized to Put (ingress) on robot/cmd_vel\n"
    for thread in range(1000):
        assert list(log.feed(line.replace("(11)", f"({thread})").encode())) == []
    assert len(log._last) <= 100


class Gate:
    """`gigabrain up` with a router and nothing else, for the robot red."""

    def __init__(self, home: Home, fleet: Path) -> None:
        self.port, self.fleet = free_port(), fleet
        file = home.deployment(
            router=f"tcp/127.0.0.1:{self.port}",
            namespace="red",
            keys=str(fleet / "robot@red"),
            hosts={"robot": ["router"]},
        )
        self._robot = home.folder / "state" / "gigabrain" / "robots" / "red"
        self.command: Command = home.start("up", str(file))

    def as_(self, name: str) -> Endpoint:
        return Endpoint(
            connect=(f"tcp/127.0.0.1:{self.port}",), keys=str(self.fleet / name) if name else ""
        )

    @property
    def audited(self) -> dict[tuple[str, str, str], AuditRecord]:
        records = audit_file.read(self._robot, 1000)
        return {(record.what, record.source, record.code): record for record in records}


@pytest.fixture(scope="module")
def started(shared_home: Home, fleet: Path) -> Iterator[Gate]:
    made = Gate(shared_home, fleet)
    yield made
    made.command.close()


@pytest.fixture
async def gate(started: Gate) -> Gate:
    await until(lambda: "ready" in started.command.out, "the router is ready")
    return started


async def test_denials_and_strangers_are_in_the_audit_log(gate: Gate, tmp_path: Path) -> None:
    with raw(gate.as_("viewer@red")) as viewer, raw(gate.as_("robot@blue")) as blue:
        for _ in range(200):
            viewer.put("red/robot/cmd_vel", b"x")
        viewer.put('red/robot/x\n{"event":"ready","pid":1}\n', b"x")  # no word to the supervisor
        assert list(viewer.get("red/robot/release", timeout=5.0)) == []
        blue.put("red/robot/cmd_vel", b"x")
        assert list(blue.get("red/robot/estop", timeout=5.0)) == []
        wanted = {
            ("refused", "viewer@red", "put robot/cmd_vel"),
            ("stranger", "robot@blue", "no rights"),
        }
        await until(lambda: wanted <= set(gate.audited), "they are written down")
    for keys in (make_fleet(tmp_path / "other", "other") / "operator", None):
        at = Endpoint(connect=gate.as_("").connect, keys=str(keys) if keys else "")
        with pytest.raises(zenoh.ZError), raw(at):
            pass
    # How TLS names what is no TLS hangs on a few bytes: one session id in 256 is a byte shorter.
    whys = ("received fatal alert: UnknownCA", "received corrupt message of type ")

    def turned_away() -> bool:
        codes = [code for what, who, code in gate.audited if (what, who) == ("stranger", "unknown")]
        return all(any(code.startswith(why) for code in codes) for why in whys)

    await until(turned_away, "so are those outside")
    record = gate.audited["refused", "viewer@red", "put robot/cmd_vel"]
    assert record.text.startswith("viewer@red at tls/127.0.0.1:")
    assert record.text.endswith(" may not put red/robot/cmd_vel")
    assert not record.ok
    assert gate.command.out.count("ready") == 1


async def test_what_is_allowed_is_not_audited(gate: Gate) -> None:
    before = set(gate.audited)
    with raw(gate.as_("robot@red")) as robot, raw(gate.as_("operator@red")) as operator:
        heard: list[bytes] = []
        operator.declare_subscriber("red/robot/**", lambda s: heard.append(s.payload.to_bytes()))
        async with asyncio.timeout(30):
            while not heard:
                robot.put("red/robot/state", b"x")
                await asyncio.sleep(0.02)
        operator.put("red/robot/teleop", b"x")
        operator.put("red/robot/state", b"denied")  # comes last, so what was before is known
        last = ("refused", "operator@red", "put robot/state")
        await until(lambda: last in gate.audited, "the denial is written down")
    assert set(gate.audited) - before == {last}


async def test_nothing_listens_but_the_router_and_a_socket_of_its_user(
    gate: Gate, shared_home: Home
) -> None:
    pids = [gate.command.pid, *shared_home.processes()]
    listening = [
        connection.laddr.port
        for pid in pids
        for connection in psutil.Process(pid).net_connections("inet")
        if connection.status == psutil.CONN_LISTEN or connection.type == socket.SOCK_DGRAM
    ]
    assert listening == [gate.port]
    endpoint = await robot_of(shared_home, gate.command)
    path = endpoint.connect[0].partition("/")[2]
    assert stat.S_ISSOCK(os.stat(path).st_mode)
    assert stat.S_IMODE(os.stat(os.path.dirname(path)).st_mode) == 0o700


async def test_who_may_not_ask_is_told_so(gate: Gate) -> None:
    at = f"tls/127.0.0.1:{gate.port}"
    keys = str(gate.fleet / "viewer@red")
    with pytest.raises(NotConfirmed, match=r"or viewer@red may not ask for it"):
        async with connect(at, namespace="red", keys=keys, wait=False) as robot:
            await robot.estop()


async def test_1100_connections_that_fail_keep_nobody_out_who_comes_by_the_socket(
    gate: Gate, shared_home: Home
) -> None:
    """Comes last: Zenoh lets no more than ten a second fail, so TLS is busy for two minutes."""
    near = await robot_of(shared_home, gate.command)
    local = Endpoint(connect=near.connect[:1])
    with raw(gate.as_("operator@red")) as operator:
        heard: list[bytes] = []
        operator.declare_subscriber("red/robot/state", lambda s: heard.append(s.payload.to_bytes()))

        async def is_heard() -> None:
            heard.clear()
            with raw(local) as robot:  # refused at once where there is no room
                async with asyncio.timeout(30):
                    while not heard:
                        robot.put("red/robot/state", b"x")
                        await asyncio.sleep(0.02)

        with contextlib.ExitStack() as crowd:
            for _ in range(1100):
                crowd.enter_context(socket.create_connection(("127.0.0.1", gate.port)))
            await is_heard()
        await is_heard()  # while the door deals with their ends
    assert gate.command.out.count("ready") == 1
