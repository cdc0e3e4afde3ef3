"""Attacks: forged commands, replayed traffic, idle and random connections."""

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from msgspec.structs import replace

from gigabrain_schemas.requests import EnableRequest
from gigabrain_schemas.topics import (
    CMD_VEL,
    ENABLE,
    ESTOP,
    INTENT,
    SAFETY,
    SCAN,
    STATE,
    TELEOP,
    WORLD,
)
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.client.connection import connect
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.posix import resource
from gigabrain_zenoh.launch.deployment import client_endpoint
from gigabrain_zenoh.qa.faults.rig import (
    PERIOD_ADDED,
    Rig,
    address_of,
    deployment_of,
    forged_command,
    forging,
)
from gigabrain_zenoh.qa.faults.rows.network import make_fleet
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, Skipped, fault_row
from gigabrain_zenoh.qa.probe import moving, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.runtime.running import folder

SPEED, MOVES = 0.15, 0.01  # [m/s], [m/s] and [rad/s]
COMMANDS, AT_ONCE = 5_000, 40  # from each intruder that gets a session
PATIENCE_S = 2.0  # within which a client without the right keys would have a session
AUDIT_S = 3.0  # until an audit log has been written
LISTENS = "0A"  # in Linux's table of TCP sockets
REPLAYED = (SCAN, STATE, WORLD, INTENT, CMD_VEL, SAFETY, TELEOP)
RECORD_S, LONG_RECORD_S = 2.0, 60.0
REPLAYED_AT_ONCE = 20  # messages between two pauses
IDLE_SOCKETS, SPARE_FILES = 1100, 200
CALLS, LONG_CALLS = 2_000, 100_000
PAUSE_S = 0.002  # between two calls: the router is judged, not the speed of the caller
LONGEST_NOISE = 2_000  # bytes
BOMBS = (  # to a port that speaks Zenoh: a length of 64 kB and nothing, and other protocols
    b"\xff\xff" + bytes(64), b"\xff" * 65_537, b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n",
    bytes.fromhex("16030100ff010000fb0303") + bytes(244),
)  # fmt: skip
WATCH_S = 5.0

WHEELS_MOVED = Figure("wheels moved")
DENIALS_UNSEEN = Figure("denials missing in the audit log")
OPEN_PORTS = Figure("open ports besides the router")
ACCEPTED = Figure("accepted")
REFUSED_ESTOPS = Figure("e-stops refused after it")
CONNECTS = Figure("operator connects after", "s", wall=True)
ROUTER_DEATHS = Figure("router deaths")


@fault_row(
    40, "", WHEELS_MOVED.at_most(0), DENIALS_UNSEEN.at_most(0), OPEN_PORTS.at_most(0),
    needs=("keys",),
)  # fmt: skip
async def unauthorised_publisher(rig: Rig) -> Measured:
    """Forge commands as a viewer and as a brain, and knock twice without the right keys.

    An operator holds the body still; the forged commands are in its name, and have all else that
    the gate asks for.
    """
    folder().mkdir(mode=0o700, parents=True, exist_ok=True)  # for the router's Unix socket
    fleet = make_fleet(rig.fresh_folder() / "fleet")
    other = make_fleet(rig.fresh_folder() / "fleet")
    deployment = replace(deployment_of(rig.options, "sim"), keys=str(fleet))
    async with rig.own_robot(deployment, checked=False) as robot:
        await robot.until_driving()
        await robot.operator.enable(take=True)
        await robot.operator.set_base_velocity(0.0)
        await robot.probe.at_rest()
        start = robot.probe.state
        for role in ("viewer", "brain"):
            await _forge(robot, role)
        near = client_endpoint(robot.deployment, "operator")
        await _knock(replace(near, keys=str(other / "operator")))
        plain = near.connect[0].replace("tls/", "tcp/")
        await _knock(replace(near, keys="", connect=(plain,)))
        await asyncio.sleep(AUDIT_S)
        states = [s for s in robot.probe.states if s.tick > start.tick]
        ports = _open_ports(robot) - {int(near.connect[0].rpartition(":")[2])}
        return {
            WHEELS_MOVED: moving(states, MOVES),
            DENIALS_UNSEEN: await _denials_unseen(robot),
            OPEN_PORTS: len(ports),
        }


async def _forge(robot: RobotUnderTest, role: str) -> None:
    """Ask for the body, and command it, with the keys of `role`."""
    endpoint = client_endpoint(robot.deployment, role)
    stranger = await ZenohTransport.open(endpoint)
    request = encode(EnableRequest(source=role, take=True))
    replies = await stranger.query(ENABLE.key, request, "", 1.0, ENABLE.priority)
    await stranger.close()
    if any(isinstance(reply, bytes) for reply in replies):
        raise Failed(f"a {role} was answered when it asked for the body")
    async with forging(endpoint) as forger:
        for number in range(COMMANDS):
            forger.send(CMD_VEL, forged_command(robot.probe, SPEED, 1_000_000_000 + number))
            if number % AT_ONCE == 0:
                await robot.operator.set_base_velocity(0.0)
                await asyncio.sleep(0.02)


async def _knock(endpoint: Endpoint) -> None:
    """Try to get a session without the right keys. Raises Failed where that succeeds."""
    try:
        transport = await asyncio.wait_for(ZenohTransport.open(endpoint), PATIENCE_S)
    except (TimeoutError, GigabrainError):
        return
    await transport.close()
    raise Failed("a client without keys of this fleet got a session")


async def _denials_unseen(robot: RobotUnderTest) -> int:
    """Return how many of the four intruders are missing in the audit log."""
    audit = await robot.operator.audit()
    refused = {record.source for record in audit if record.what == "refused"}
    strangers = sum(record.times for record in audit if record.what == "stranger")
    return len({"viewer", "brain"} - refused) + max(0, 2 - strangers)


def _open_ports(robot: RobotUnderTest) -> set[int]:
    """Return the TCP ports on which the robot's processes listen, on Linux."""
    inodes = {
        link.readlink().name
        for pid in robot.pids.values()
        for link in Path(f"/proc/{pid}/fd").glob("*")
        if link.is_symlink()
    }
    found = set()
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            _, address, _, state, *_ = fields = line.split()
            if state == LISTENS and f"socket:[{fields[9]}]" in inodes:
                found.add(int(address.rpartition(":")[2], 16))
    return found


@fault_row(41, "sim", ACCEPTED.at_most(0), REFUSED_ESTOPS.at_most(0))
async def replayed_traffic(rig: Rig) -> Measured:
    """Record all traffic while an operator drives; send it again at once, and after a restart."""
    robot = await rig.robot("sim")
    endpoint = robot.endpoint
    traffic = await _recorded(robot, endpoint, LONG_RECORD_S if rig.long else RECORD_S)
    accepted = await _replayed(robot, endpoint, traffic)
    boot = robot.probe.state.boot
    await robot.kill_and_restart("driver")
    await until(lambda: robot.probe.state.boot != boot, "the driver's new boot")
    accepted += await _replayed(robot, endpoint, traffic)
    refused = await _refused_estops(robot, endpoint)
    await robot.settle()
    return {ACCEPTED: accepted, REFUSED_ESTOPS: refused}


async def _recorded(
    robot: RobotUnderTest, endpoint: Endpoint, seconds: float
) -> list[tuple[str, bytes]]:
    """Return the traffic while an operator drives slowly and turns."""
    await robot.until_driving()
    traffic: list[tuple[str, bytes]] = []
    listener = await ZenohTransport.open(endpoint)
    for topic in REPLAYED:
        listener.subscribe(topic.key, lambda key, payload: traffic.append((key, payload)), 256)
    async with connect(endpoint.connect[0], source="driver-of-old", take=True) as operator:
        await operator.drive(0.02, SPEED * 4, seconds=seconds)
    await listener.close()
    return traffic


async def _replayed(
    robot: RobotUnderTest, endpoint: Endpoint, traffic: list[tuple[str, bytes]]
) -> int:
    """Replay traffic while its operator holds the body still; count ticks in which it moves."""
    await robot.until_driving()  # all is well, and a client may take over
    probe, topics = robot.probe, {topic.key: topic for topic in REPLAYED}
    sender = await ZenohTransport.open(endpoint)
    try:
        async with connect(endpoint.connect[0], source="driver-of-old", take=True) as operator:
            await operator.set_base_velocity(0.0)
            await probe.at_rest()
            start = probe.state
            for number, (key, payload) in enumerate(traffic):
                sender.publish(topics[key], key, payload, "")
                if number % REPLAYED_AT_ONCE == 0:
                    with contextlib.suppress(GigabrainError):  # the client may refuse old states
                        await operator.set_base_velocity(0.0)
                    await asyncio.sleep(0.01)
            await probe.ticks(10)
    finally:
        await sender.close()
    return moving(probe.since(start)[1:], MOVES)


async def _refused_estops(robot: RobotUnderTest, endpoint: Endpoint) -> int:
    """Send an e-stop, the very same request again, and a new one; count those that do not latch."""
    probe, stranger = robot.probe, await ZenohTransport.open(endpoint)
    refused = 0
    try:
        for payload in (b'{"source": "old"}', b'{"source": "old"}', b"{}"):
            generation = probe.state.gate.estop_generation
            replies = await stranger.query(ESTOP.key, payload, "", 1.0, ESTOP.priority)
            await probe.ticks(3)
            gate = probe.state.gate
            latched = gate.mode == "latched" and gate.estop_generation > generation
            refused += not (latched and any(isinstance(reply, bytes) for reply in replies))
    finally:
        await stranger.close()
    return refused


@fault_row(
    42, "sim", PERIOD_ADDED.at_most(20), CONNECTS.at_most(5), ROUTER_DEATHS.at_most(0), loads=True
)
async def idle_and_random_connections(rig: Rig) -> Measured:
    """Open idle sockets to the router's port, and send it noise and other protocols."""
    robot = await rig.robot("sim")
    endpoint = robot.endpoint
    host, port = address_of(endpoint)
    pid, loop = robot.pid("router"), asyncio.get_running_loop()
    await robot.until_driving()
    start = robot.probe.state
    await asyncio.sleep(WATCH_S)
    calm_ms = robot.probe.control_period_ms(start)
    async with _idle_connections(host, port):
        began_s = loop.time()
        async with connect(endpoint.connect[0], source="operator"):
            took_s = loop.time() - began_s
    start = robot.probe.state
    for number in range(LONG_CALLS if rig.long else CALLS):
        noise = os.urandom(1 + number % LONGEST_NOISE)
        await _call(host, port, BOMBS[number % 100] if number % 100 < len(BOMBS) else noise)
        await asyncio.sleep(PAUSE_S)
    period_ms = robot.probe.control_period_ms(start)
    return {
        PERIOD_ADDED: period_ms - calm_ms,
        CONNECTS: took_s,
        ROUTER_DEATHS: int(robot.supervisor.statuses["router"].pid != pid),
    }


@asynccontextmanager
async def _idle_connections(host: str, port: int) -> AsyncIterator[None]:
    """Keep 1100 idle connections open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = IDLE_SOCKETS + SPARE_FILES
    if hard < wanted:
        raise Skipped(f"a process may open {hard} files here; {wanted} are needed")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted), hard))
    loop, sockets = asyncio.get_running_loop(), list[socket.socket]()
    try:
        for _ in range(IDLE_SOCKETS):
            sockets.append(socket.socket())
            sockets[-1].setblocking(False)
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(0.2):
                    await loop.sock_connect(sockets[-1], (host, port))
        yield
    finally:
        for one in sockets:
            one.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def _call(host: str, port: int, payload: bytes) -> None:
    """Connect, send this, and leave; the router may refuse."""
    loop = asyncio.get_running_loop()
    with socket.socket() as one:
        one.setblocking(False)
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(1.0):
                await loop.sock_connect(one, (host, port))
                await loop.sock_sendall(one, payload)
