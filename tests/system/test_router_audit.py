"""The audit of a router: strangers and denied requests are logged within a second."""

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

from gigabrain_schemas.logs import AuditRecord
from gigabrain_zenoh.client.connection import connect
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import NotConfirmed
from gigabrain_zenoh.runtime import audit
from gigabrain_zenoh.testing.processes import CommandProcess, Home, free_port, robot_of
from gigabrain_zenoh.testing.waiting import until
from tests.system.keys import make_fleet, raw


class RouterOfRed:
    """`gigabrain up` with only a router, for the robot red."""

    def __init__(self, home: Home, fleet: Path) -> None:
        self.port, self.fleet = free_port(), fleet
        file = home.deployment(
            router=f"tcp/127.0.0.1:{self.port}",
            namespace="red",
            keys=str(fleet / "robot@red"),
            hosts={"robot": ["router"]},
        )
        self._robot = home.folder / "state" / "gigabrain" / "robots" / "red"
        self.command: CommandProcess = home.start("up", str(file))

    def endpoint_of(self, name: str) -> Endpoint:
        return Endpoint(
            connect=(f"tcp/127.0.0.1:{self.port}",), keys=str(self.fleet / name) if name else ""
        )

    @property
    def audited(self) -> dict[tuple[str, str, str], AuditRecord]:
        records = audit.read_audit(self._robot, 1000)
        return {(record.what, record.source, record.code): record for record in records}


@pytest.fixture(scope="module")
def started(shared_home: Home, fleet: Path) -> Iterator[RouterOfRed]:
    made = RouterOfRed(shared_home, fleet)
    yield made
    made.command.close()


@pytest.fixture
async def gate(started: RouterOfRed) -> RouterOfRed:
    await until(lambda: "ready" in started.command.out, "the router is ready")
    return started


async def test_denied_requests_and_strangers_are_in_the_audit_log(
    gate: RouterOfRed, tmp_path: Path
) -> None:
    with raw(gate.endpoint_of("viewer@red")) as viewer, raw(gate.endpoint_of("robot@blue")) as blue:
        for _ in range(200):
            viewer.put("red/robot/cmd_vel", b"x")
        # must not reach the supervisor
        viewer.put('red/robot/x\n{"event":"ready","pid":1}\n', b"x")
        assert list(viewer.get("red/robot/release", timeout=5.0)) == []
        blue.put("red/robot/cmd_vel", b"x")
        assert list(blue.get("red/robot/estop", timeout=5.0)) == []
        wanted = {
            ("refused", "viewer@red", "put robot/cmd_vel"),
            ("stranger", "robot@blue", "no rights"),
        }
        await until(lambda: wanted <= set(gate.audited), "they are written down")
    for keys in (make_fleet(tmp_path / "other", "other") / "operator", None):
        at = Endpoint(connect=gate.endpoint_of("").connect, keys=str(keys) if keys else "")
        with pytest.raises(zenoh.ZError), raw(at):
            pass
    # the rest of TLS's error depends on the bytes: one session id in 256 is a byte shorter
    whys = ("received fatal alert: UnknownCA", "received corrupt message of type ")

    def are_audited() -> bool:
        codes = [code for what, who, code in gate.audited if (what, who) == ("stranger", "unknown")]
        return all(any(code.startswith(why) for code in codes) for why in whys)

    await until(are_audited, "so are those outside")
    record = gate.audited["refused", "viewer@red", "put robot/cmd_vel"]
    assert record.text.startswith("viewer@red at tls/127.0.0.1:")
    assert record.text.endswith(" may not put red/robot/cmd_vel")
    assert not record.ok
    assert gate.command.out.count("ready") == 1


async def test_allowed_requests_are_not_audited(gate: RouterOfRed) -> None:
    before = set(gate.audited)
    with (
        raw(gate.endpoint_of("robot@red")) as robot,
        raw(gate.endpoint_of("operator@red")) as operator,
    ):
        received: list[bytes] = []
        operator.declare_subscriber("red/robot/**", lambda s: received.append(s.payload.to_bytes()))
        async with asyncio.timeout(30):
            while not received:
                robot.put("red/robot/state", b"x")
                await asyncio.sleep(0.02)
        operator.put("red/robot/teleop", b"x")
        operator.put("red/robot/state", b"denied")  # its audit record comes last
        last = ("refused", "operator@red", "put robot/state")
        await until(lambda: last in gate.audited, "the denial is written down")
    assert set(gate.audited) - before == {last}


async def test_only_the_router_port_and_a_private_socket_listen(
    gate: RouterOfRed, shared_home: Home
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


async def test_a_client_without_rights_gets_an_error_with_that_reason(gate: RouterOfRed) -> None:
    at = f"tls/127.0.0.1:{gate.port}"
    keys = str(gate.fleet / "viewer@red")
    with pytest.raises(NotConfirmed, match=r"or viewer@red may not request it"):
        async with connect(at, namespace="red", keys=keys, wait=False) as robot:
            await robot.estop()


async def test_1100_failing_tls_connections_do_not_block_the_local_socket(
    gate: RouterOfRed, shared_home: Home
) -> None:
    """Must run last: Zenoh rejects ten connections a second, so TLS is busy for two minutes."""
    near = await robot_of(shared_home, gate.command)
    local = Endpoint(connect=near.connect[:1])
    with raw(gate.endpoint_of("operator@red")) as operator:
        received: list[bytes] = []
        operator.declare_subscriber(
            "red/robot/state", lambda s: received.append(s.payload.to_bytes())
        )

        async def robot_is_received() -> None:
            received.clear()
            with raw(local) as robot:  # would be refused at once without a free slot
                async with asyncio.timeout(30):
                    while not received:
                        robot.put("red/robot/state", b"x")
                        await asyncio.sleep(0.02)

        with contextlib.ExitStack() as crowd:
            for _ in range(1100):
                crowd.enter_context(socket.create_connection(("127.0.0.1", gate.port)))
            await robot_is_received()
        await robot_is_received()  # while the router handles their ends
    assert gate.command.out.count("ready") == 1
