"""People on the network who have no business driving: with keys they do not."""

import asyncio
from pathlib import Path

import msgspec

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import EnableRequest
from gigabrain_schemas.topics import CMD_VEL, ENABLE
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.forger import forging
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.with_keys import make_fleet
from gigabrain_zenoh.runtime.deployment import client_endpoint
from gigabrain_zenoh.runtime.running import folder

SPEED, MOVES = 0.15, 0.01  # [m/s], [m/s] and [rad/s]
COMMANDS, AT_ONCE = 5_000, 40  # from each intruder who gets a session
PATIENCE_S = 2.0  # within which somebody without the right keys would have a session
TOLD_S = 3.0  # until an audit log has been written
LISTENS = "0A"  # in Linux's table of TCP sockets


async def unauthorised_publisher(rig: Rig) -> Measured:
    """A viewer and a brain who forge commands, and two without the right keys.

    An operator holds the body still; the forged commands are in its name, and have all else that
    the gate asks for.
    """
    await rig.give_up()
    folder().mkdir(mode=0o700, parents=True, exist_ok=True)  # for the router's Unix socket
    fleet = make_fleet(rig.fresh_folder() / "fleet")
    other = make_fleet(rig.fresh_folder() / "fleet")
    deployment = msgspec.structs.replace(deployment_of(rig.options, "sim"), keys=str(fleet))
    async with rig.new(deployment) as subject:
        await subject.settle()
        await subject.drive()
        await subject.person.enable(take=True)
        await subject.person.set_base_velocity(0.0)
        await subject.onlooker.still()
        start = subject.onlooker.state
        for role in ("viewer", "brain"):
            await _forge(subject, role)
        near = client_endpoint(subject.deployment, "operator")
        await _knock(msgspec.structs.replace(near, keys=str(other / "operator")))
        plain = near.connect[0].replace("tls/", "tcp/")
        await _knock(msgspec.structs.replace(near, keys="", connect=(plain,)))
        await asyncio.sleep(TOLD_S)
        states = [s for s in subject.onlooker.states if s.tick > start.tick]
        ports = _open_ports(subject) - {int(near.connect[0].rpartition(":")[2])}
        return {
            "wheels moved": sum(
                max(abs(s.velocity.linear_x), abs(s.velocity.angular_z)) > MOVES for s in states
            ),
            "denials unseen": await _unseen(subject),
            "open ports besides the router": len(ports),
        }


async def _forge(subject: Subject, role: str) -> None:
    """Ask for the body, and command it, with the keys of `role`."""
    time, me = subject.onlooker.bus.time, subject.onlooker.bus.process
    where = client_endpoint(subject.deployment, role)
    stranger = await ZenohTransport.open(where)
    request = encode(EnableRequest(source=role, take=True))
    replies = await stranger.query(ENABLE.key, request, "", 1.0, ENABLE.priority)
    await stranger.close()
    if any(isinstance(reply, bytes) for reply in replies):
        raise Failed(f"a {role} was answered when it asked for the body")
    async with forging(where) as forger:
        for number in range(COMMANDS):
            command = CmdVel(
                linear_x=SPEED, source=me, boot=time.boot, tick=time.tick, basis=time.tick,
                seq=1_000_000_000 + number,
            )  # fmt: skip
            forger.send(CMD_VEL, command)
            if number % AT_ONCE == 0:
                await subject.person.set_base_velocity(0.0)
                await asyncio.sleep(0.02)


async def _knock(endpoint: Endpoint) -> None:
    """Try to get a session without the right keys. Raises Failed where that succeeds."""
    try:
        transport = await asyncio.wait_for(ZenohTransport.open(endpoint), PATIENCE_S)
    except (TimeoutError, GigabrainError):
        return
    await transport.close()
    raise Failed("somebody without keys of this fleet got a session")


async def _unseen(subject: Subject) -> int:
    """Of the four intruders, how many the audit log does not know."""
    audit = await subject.person.audit()
    refused = {record.source for record in audit if record.what == "refused"}
    strangers = sum(record.times for record in audit if record.what == "stranger")
    return len({"viewer", "brain"} - refused) + max(0, 2 - strangers)


def _open_ports(subject: Subject) -> set[int]:
    """The TCP ports on which the robot's processes listen, where Linux tells."""
    inodes = {
        link.readlink().name
        for status in subject.supervisor.statuses.values()
        for link in Path(f"/proc/{status.pid}/fd").glob("*")
        if link.is_symlink()
    }
    found = set()
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            _, address, _, state, *_ = fields = line.split()
            if state == LISTENS and f"socket:[{fields[9]}]" in inodes:
                found.add(int(address.rpartition(":")[2], 16))
    return found
