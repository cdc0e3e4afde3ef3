"""What `gigabrain doctor` goes by: this machine, and the robot where there is one."""

import asyncio
import datetime
import importlib.metadata
import os
import platform
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from msgspec import Struct
from serial.tools import list_ports

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.requests import Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import BODY, CMD_VEL, HEALTH, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.diagnostics.hearing import NAME
from gigabrain_zenoh.diagnostics.roll_call import roll_call
from gigabrain_zenoh.errors import BusError, ConfigError
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.runtime import running
from gigabrain_zenoh.runtime.connect import Where, joined
from gigabrain_zenoh.security.identity_files import identity_in

LOOK_S = 2.5  # so that every process has reported its health twice
LIBRARIES = (
    "eclipse-zenoh", "msgspec", "numpy", "pyserial", "pyyaml", "cyclopts", "rich",
    "mujoco-core", "cryptography", "mcap", "textual", "uvloop",
)  # fmt: skip


class Folder(Struct, frozen=True, kw_only=True):
    """A folder that the robot writes to."""

    path: str
    writable: bool
    free_mb: float


class Port(Struct, frozen=True, kw_only=True):
    """A serial device."""

    path: str
    about: str
    usb: str = ""  # VID:PID
    usable: bool


class Certificate(Struct, frozen=True, kw_only=True):
    """An identity, or why it is none."""

    folder: str
    name: str = ""
    days_left: float = 0.0
    problem: str = ""


class Machine(Struct, frozen=True, kw_only=True):
    """This computer."""

    python: tuple[int, int, int]
    system: str
    libraries: Mapping[str, str | None]  # version; None where it is not installed
    folders: tuple[Folder, ...]
    ports: tuple[Port, ...]
    multicast: bool  # whether our sessions would look for others by themselves
    certificate: Certificate | None = None


class Robot(Struct, frozen=True, kw_only=True):
    """The robot that can be reached, or why none can."""

    problem: str = ""
    router: str = ""
    port_open: bool = False  # where the router does not answer: whether anything does
    there: Mapping[str, Description] = {}
    health: Mapping[str, Health] = {}  # newest, by process
    lead_ms: Mapping[str, float] = {}  # by host: how far its clock seems behind ours, at least
    state: RobotState | None = None
    control_topic: str = CMD_VEL.key  # what its body obeys
    pace: float | None = None  # of the robot's ticks against its stamps; 1 in real time


def this_machine(keys: str = "") -> Machine:
    """Look at this computer."""
    major, minor, micro = platform.python_version_tuple()
    return Machine(
        python=(int(major), int(minor), int("".join(filter(str.isdigit, micro)) or 0)),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        libraries={name: _version(name) for name in LIBRARIES},
        folders=tuple(map(_folder, (state_dir(), running.folder(), Path(tempfile.gettempdir())))),
        ports=tuple(_ports()),
        multicast=bool(
            session_config(Endpoint(connect=("tcp/127.0.0.1:1",)))["scouting/multicast/enabled"]
        ),
        certificate=_certificate(keys) if keys else None,
    )


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _folder(path: Path) -> Folder:
    there = path
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free / 1e6
    return Folder(path=str(path), writable=os.access(there, os.W_OK), free_mb=free)


def _ports() -> list[Port]:
    found = []
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else ""
        about = str(port.description or "")
        usable = os.access(port.device, os.R_OK | os.W_OK)
        if usb:  # a computer's built-in ports are nobody's robot
            found.append(Port(path=port.device, about=about, usb=usb, usable=usable))
    return found


def _certificate(keys: str) -> Certificate:
    try:
        identity = identity_in(Path(keys).expanduser())
    except ConfigError as error:
        return Certificate(folder=keys, problem=str(error))
    days = identity.days_left(datetime.datetime.now(datetime.UTC))
    return Certificate(folder=keys, name=identity.name, days_left=days)


async def this_robot(where: Where, seconds: float = LOOK_S) -> tuple[Robot, str]:
    """Look at the robot, and where its keys are."""
    try:
        endpoint = running.find_endpoint(where.connect, where.namespace, where.keys)
    except BusError as error:
        return Robot(problem=str(error)), where.keys
    try:
        async with joined(where, NAME) as (bus, _):
            return await _look(bus, endpoint.connect[-1], seconds), endpoint.keys
    except (BusError, ConfigError) as error:
        router = endpoint.connect[-1]
        problem, port_open = str(error), await _port_open(router)
        return Robot(problem=problem, router=router, port_open=port_open), endpoint.keys


async def _port_open(endpoint: str) -> bool:
    """Whether anybody accepts connections at tcp/127.0.0.1:7447."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    if not port.isdigit():
        return False
    try:
        _, writer = await asyncio.wait_for(
            asyncio.open_connection(host.strip("[]"), int(port)), 1.0
        )
    except (OSError, TimeoutError):
        return False
    writer.close()
    return True


async def _look(bus: Bus, router: str, seconds: float) -> Robot:
    health: dict[str, Health] = {}
    lead_ms: dict[str, float] = {}
    states: list[RobotState] = []

    def hear(_key: str, told: Health) -> None:
        health[told.process] = told
        lead = (bus.clock.unix_ns() - told.stamp_ns) / 1e6
        lead_ms[told.host] = min(lead, lead_ms.get(told.host, lead), key=abs)

    bus.subscribe(HEALTH, hear)
    bodies = bus.latest(BODY)
    bus.subscribe(STATE, lambda _key, state: states.append(state))
    there, _ = await asyncio.gather(roll_call(bus), asyncio.sleep(seconds))
    body = bodies.current
    return Robot(
        router=router,
        there=there,
        health=health,
        lead_ms=lead_ms,
        state=states[-1] if states else None,
        control_topic=body.description.control_topic if body else CMD_VEL.key,
        pace=_pace(states),
    )


def _pace(states: list[RobotState]) -> float | None:
    """How fast the robot's time goes by."""
    of_now = [state for state in states if state.boot == states[-1].boot]
    if len(of_now) < 2:
        return None
    seconds = (of_now[-1].stamp_ns - of_now[0].stamp_ns) / 1e9
    return (of_now[-1].tick - of_now[0].tick) * 0.02 / seconds if seconds > 0 else None
