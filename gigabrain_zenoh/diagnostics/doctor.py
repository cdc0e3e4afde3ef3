"""`gigabrain doctor`: checks this machine and its robot. `examine` is pure."""

import asyncio
import datetime
import importlib.metadata
import itertools
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct
from serial.tools import list_ports

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.requests import Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    INTENT,
    JOINT_CMD,
    SAFETY,
    SCAN,
    STATE,
    WORLD,
    Topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.config import session_config
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.diagnostics.discovery import discover
from gigabrain_zenoh.diagnostics.listener import CLIENT_NAME
from gigabrain_zenoh.diagnostics.robot_view import MAX_PROCESSES, ProcessHealth
from gigabrain_zenoh.diagnostics.ros2_check import Shell, check_ros2, inspect_shell
from gigabrain_zenoh.errors import BusError, ConfigError
from gigabrain_zenoh.host.bounded import put_newest
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.runtime import running
from gigabrain_zenoh.runtime.connect import Where, connect
from gigabrain_zenoh.security.identity_files import identity_in

Grade = Literal["ok", "hint", "bad"]
SYSTEMS = ("router", "driver", "perception", "decision", "control", "safety")
LIBRARIES: Mapping[str, tuple[int, ...]] = {  # name and lowest version
    "eclipse-zenoh": (1, 10), "msgspec": (0, 19), "numpy": (1, 26), "pyserial": (), "pyyaml": (),
    "cyclopts": (5, 0), "rich": (), "mujoco-core": (), "ruckig": (0, 17), "cryptography": (),
    "mcap": (), "textual": (), "uvloop": (), "rosbags": (0, 11), "xxhash": (3,),
    "cyclonedds": (11,),
}  # fmt: skip
EXTRAS = {  # optional libraries, and the extras of the package that install them
    "mujoco-core": "sim", "ruckig": "arm", "cryptography": "keys", "mcap": "record",
    "textual": "view", "uvloop": "fast", "rosbags": "ros2", "xxhash": "ros2", "cyclonedds": "dds",
}  # fmt: skip
SENDERS: dict[Topic[Any], str] = {
    STATE: "driver", SCAN: "driver", BODY: "driver", WORLD: "perception", INTENT: "decision",
    CMD_VEL: "control", SAFETY: "safety",
}  # fmt: skip
MIN_PYTHON = (3, 11)
MIN_FREE_MB = 500.0
MIN_KEY_DAYS = 30.0
MAX_CLOCK_OFFSET_MS = 500.0
MIN_RATE = 0.5  # share of the promised rate
MAX_CPU = 0.9  # share of one core
WINDOW_S = 2.5  # in which every process reports its health twice


class Diagnosis(Struct, frozen=True, kw_only=True):
    """Result of one check."""

    about: str
    grade: Grade
    text: str
    cure: str = ""


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
    """An identity, or the problem with it."""

    folder: str
    name: str = ""
    days_left: float = 0.0
    problem: str = ""


class MachineFacts(Struct, frozen=True, kw_only=True):
    """State of this computer."""

    python: tuple[int, int, int]
    system: str
    libraries: Mapping[str, str | None]  # version by name; None if it is not installed
    folders: tuple[Folder, ...]
    ports: tuple[Port, ...]
    multicast: bool  # sessions search for others by multicast
    certificate: Certificate | None = None
    shell: Shell = Shell()


class RobotFacts(Struct, frozen=True, kw_only=True):
    """State of the robot, or the problem in reaching it."""

    problem: str = ""
    router: str = ""
    port_open: bool = False  # another program listens at `router`
    described: Mapping[str, Description] = {}
    health: Mapping[str, Health] = {}  # newest, by process
    namesakes: Mapping[str, tuple[str, ...]] = {}  # places of processes with one name, by name
    lead_ms: Mapping[str, float] = {}  # smallest lead of our clock over a host's, by host
    control_topic: str = CMD_VEL.key  # key that the body obeys
    unneeded: frozenset[str] = frozenset()  # keys that the body does not need
    pace: float | None = None  # robot's time over real time


def examine(machine: MachineFacts, robot: RobotFacts) -> list[Diagnosis]:
    """Return the results of all checks, the basic ones first."""
    checks = (
        _python(machine), _libraries(machine), _folders(machine), _serial(machine),
        _multicast(machine), _certificate(machine), _router(robot), _processes(robot),
        _namesakes(robot), _problems(robot), _rates(robot), _clocks(robot), _load(robot),
        _ros2(machine, robot),
    )  # fmt: skip
    return list(itertools.chain.from_iterable(checks))


def exit_code(results: Sequence[Diagnosis]) -> int:
    """Return 1 if any result is bad; hints do not count."""
    return int(any(result.grade == "bad" for result in results))


def _ok(about: str, text: str) -> Diagnosis:
    return Diagnosis(about=about, grade="ok", text=text)


def _bad(about: str, text: str, cure: str) -> Diagnosis:
    return Diagnosis(about=about, grade="bad", text=text, cure=cure)


def _hint(about: str, text: str, cure: str) -> Diagnosis:
    return Diagnosis(about=about, grade="hint", text=text, cure=cure)


def _python(machine: MachineFacts) -> Iterator[Diagnosis]:
    version = ".".join(map(str, machine.python))
    if machine.python < MIN_PYTHON:
        yield _bad("python", f"{version} is too old", "install Python 3.11 or newer")
    else:
        yield _ok("python", f"{version} on {machine.system}")


def _libraries(machine: MachineFacts) -> Iterator[Diagnosis]:
    for name, version in machine.libraries.items():
        extra, lowest = EXTRAS.get(name), LIBRARIES.get(name, ())
        if version is None and extra:
            cure = f"optional; to install it: pip install 'gigabrain-zenoh[{extra}]'"
            yield _hint(name, "is not installed", cure)
        elif version is None:
            yield _bad(name, "is not installed", "pip install gigabrain-zenoh")
        elif tuple(map(int, re.findall(r"\d+", version)[:3])) < lowest:
            cure = f"pip install -U '{name}>={'.'.join(map(str, lowest))}'"
            yield _bad(name, f"{version} is too old", cure)
        else:
            yield _ok(name, version)


def _folders(machine: MachineFacts) -> Iterator[Diagnosis]:
    for folder in machine.folders:
        if not folder.writable:
            cure = f"chown or chmod {folder.path}, or set XDG_STATE_HOME and XDG_RUNTIME_DIR"
            yield _bad("folder", f"this user cannot write to {folder.path}", cure)
        elif folder.free_mb < MIN_FREE_MB:
            cure = "delete old runs and recordings"
            yield _bad("disk", f"only {folder.free_mb:.0f} MB free for {folder.path}", cure)
        else:
            yield _ok("folder", f"{folder.path} is writable, {folder.free_mb / 1e3:.0f} GB free")


def _serial(machine: MachineFacts) -> Iterator[Diagnosis]:
    if not machine.ports:
        yield _ok("serial", "no USB serial device is connected")
    for port in machine.ports:
        device = f"{port.path} ({port.usb} {port.about})"
        if port.usable:
            yield _ok("serial", f"{device} can be opened")
            continue
        vendor, _, product = port.usb.partition(":")
        rule = (
            f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{vendor}", '
            f'ATTRS{{idProduct}}=="{product}", MODE="0660", GROUP="dialout"'
        )
        cure = (
            "add yourself to its group (`sudo usermod -aG dialout $USER`, then log in again); "
            f"if that does not help, add this udev rule: {rule}"
        )
        yield _bad("serial", f"this user may not open {device}", cure)


def _multicast(machine: MachineFacts) -> Iterator[Diagnosis]:
    if machine.multicast:
        yield _bad("multicast", "Zenoh multicast scouting is on", "reinstall the package")
    else:
        yield _ok("multicast", "off: a process joins only by the router's address")


def _certificate(machine: MachineFacts) -> Iterator[Diagnosis]:
    certificate = machine.certificate
    if certificate is None:
        return
    cure = "issue a new identity with `gigabrain keys issue`, and copy its folder here"
    if certificate.problem:
        yield _bad("keys", certificate.problem, cure)
        return
    text = f"{certificate.name} in {certificate.folder}: {certificate.days_left:.0f} days left"
    expires_soon = certificate.days_left < MIN_KEY_DAYS
    yield _bad("keys", text, cure) if expires_soon else _ok("keys", text)


def _router(robot: RobotFacts) -> Iterator[Diagnosis]:
    if robot.problem and robot.port_open:
        cure = "name the robot's keys with --keys, or stop the program on that port"
        yield _bad("router", f"{robot.problem} Something listens on that port.", cure)
    elif robot.problem and robot.router:
        cure = "start the robot there, open its port in the firewall, or name it with --connect"
        yield _bad("router", f"{robot.problem} Nothing listens on that port.", cure)
    elif robot.problem:
        yield _hint("router", robot.problem, "")
    else:
        yield _ok("router", f"answers at {robot.router}")


def _processes(robot: RobotFacts) -> Iterator[Diagnosis]:
    if robot.problem:
        return
    for name in SYSTEMS:
        if name not in robot.described:
            cure = f"start it, or read its log: gigabrain log --process {name}"
            yield _bad(name, "does not answer", cure)
    for name, description in robot.described.items():
        health = robot.health.get(name)
        if health is None:
            cure = f"it may hang; read its log: gigabrain log --process {name}"
            place = f"pid {description.pid} on {description.host}"
            yield _bad(name, f"{place} reports no health", cure)
        else:
            memory = f"{health.rss_bytes / 1e6:.0f} MB"
            place = f"pid {description.pid} on {description.host}"
            yield _ok(name, f"{description.version}, {place}, {health.cpu:.1%}, {memory}")
    versions = {description.version for description in robot.described.values()}
    if len(versions) > 1:
        cure = "install the same version on all hosts"
        yield _bad("versions", f"the processes differ: {', '.join(sorted(versions))}", cure)


def _namesakes(robot: RobotFacts) -> Iterator[Diagnosis]:
    for name, places in robot.namesakes.items():
        text = f"{len(places)} processes have this name: {', '.join(places)}"
        if name in SYSTEMS:
            yield _bad(name, text, "stop all but one: each acts on the messages of the others")
        else:
            yield _hint(name, text, "its health and logs are those of all of them in turn")


def _problems(robot: RobotFacts) -> Iterator[Diagnosis]:
    for process, health in robot.health.items():
        for problem in health.problems:
            yield _bad(process, problem.text, problem.remedy)


def _rates(robot: RobotFacts) -> Iterator[Diagnosis]:
    pace = min(robot.pace or 1.0, 1.0)
    for topic, process in SENDERS.items():
        health = robot.health.get(process)
        if health is None:
            continue
        key = robot.control_topic if topic is CMD_VEL else topic.key
        if key in robot.unneeded:
            continue
        hz, promised = health.sent_hz.get(key, 0.0), topic.hz * pace
        if hz < MIN_RATE * promised and topic.key != BODY.key:
            cure = f"reduce the load here, or read its log: gigabrain log --process {process}"
            yield _bad(key, f"{hz:g} Hz from {process}, expected {promised:g}", cure)
    for process, health in robot.health.items():
        for key, count in health.rejected.items():
            cure = f"find the sender: gigabrain topic info {key.removeprefix('robot/')}"
            yield _hint(key, f"{process} has dropped {count} invalid messages", cure)


def _clocks(robot: RobotFacts) -> Iterator[Diagnosis]:
    for host, lead_ms in robot.lead_ms.items():
        if abs(lead_ms) > MAX_CLOCK_OFFSET_MS:
            side = "behind" if lead_ms > 0 else "ahead of"
            cure = f"run an NTP client, such as chrony, on {host} and here"
            yield _bad("clock", f"{host} is {abs(lead_ms) / 1e3:.1f} s {side} this one", cure)
        else:
            yield _ok("clock", f"{host} differs by at most {abs(lead_ms):.0f} ms")
    if robot.pace is not None:
        yield _ok("ticks", f"the robot's time runs at ×{robot.pace:.2f}")


def _load(robot: RobotFacts) -> Iterator[Diagnosis]:
    for process, health in robot.health.items():
        if health.cpu > MAX_CPU:
            cure = "look at `gigabrain top`, or use a faster computer"
            yield _hint(process, f"uses {health.cpu:.0%} of a core", cure)


def _ros2(machine: MachineFacts, robot: RobotFacts) -> Iterator[Diagnosis]:
    if gateway := robot.described.get("ros2"):
        for grade, text, cure in check_ros2(gateway, machine.shell):
            yield Diagnosis(about="ros2", grade=grade, text=text, cure=cure)


def inspect_machine(keys: str = "") -> MachineFacts:
    """Return the state of this computer; `keys` is the folder of an identity."""
    major, minor, micro = platform.python_version_tuple()
    config = session_config(Endpoint(connect=("tcp/127.0.0.1:1",)))
    return MachineFacts(
        python=(int(major), int(minor), int("".join(filter(str.isdigit, micro)) or 0)),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        libraries={name: _version(name) for name in LIBRARIES},
        folders=tuple(map(_folder, (state_dir(), running.folder(), Path(tempfile.gettempdir())))),
        ports=tuple(_ports()),
        multicast=bool(config["scouting/multicast/enabled"]),
        certificate=_load_certificate(keys) if keys else None,
        shell=inspect_shell(),
    )


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _folder(path: Path) -> Folder:
    existing = path
    while not os.path.exists(existing):  # also false without permission
        existing = existing.parent
    free_mb = shutil.disk_usage(existing).free / 1e6
    return Folder(path=str(path), writable=os.access(existing, os.W_OK), free_mb=free_mb)


def _ports() -> Iterator[Port]:
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        if port.vid is None:
            continue  # built into the computer, so it is not a robot
        usable = os.access(port.device, os.R_OK | os.W_OK)
        usb, about = f"{port.vid:04x}:{port.pid:04x}", str(port.description or "")
        yield Port(path=port.device, about=about, usb=usb, usable=usable)


def _load_certificate(keys: str) -> Certificate:
    try:
        identity = identity_in(expanded(keys))
    except ConfigError as error:
        return Certificate(folder=keys, problem=str(error))
    days = identity.days_left(datetime.datetime.now(datetime.UTC))
    return Certificate(folder=keys, name=identity.name, days_left=days)


async def inspect_robot(where: Where, seconds: float = WINDOW_S) -> tuple[RobotFacts, str]:
    """Return the state of the robot, and the folder of the identity used to connect."""
    try:
        endpoint = running.find_endpoint(where.connect, where.namespace, where.keys)
    except (BusError, ConfigError) as error:
        return RobotFacts(problem=str(error)), where.keys
    router = endpoint.connect[-1]
    try:
        async with connect(where, CLIENT_NAME) as bus:
            return await _collect(bus, router, seconds), endpoint.keys
    except (BusError, ConfigError) as error:
        problem, port_open = str(error), await _port_open(router)
        return RobotFacts(problem=problem, router=router, port_open=port_open), endpoint.keys


async def _port_open(endpoint: str) -> bool:
    """Return whether a program accepts connections at an endpoint such as tcp/127.0.0.1:7447."""
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


async def _collect(bus: Bus, router: str, seconds: float) -> RobotFacts:
    lead_ms: dict[str, float] = {}
    states: list[RobotState] = []
    places: dict[str, list[str]] = {}  # in the order of the messages, by process

    def add(newest: Health) -> None:
        place = f"pid {newest.pid} on {newest.host}"
        put_newest(places, newest.process, [*places.get(newest.process, ()), place], MAX_PROCESSES)
        lead = (bus.clock.unix_ns() - newest.stamp_ns) / 1e6
        lead_ms[newest.host] = min(lead, lead_ms.get(newest.host, lead), key=abs)

    health = ProcessHealth(bus, add)
    bodies = bus.latest(BODY)
    bus.subscribe(STATE, lambda _key, state: states.append(state))
    described, _ = await asyncio.gather(discover(bus), asyncio.sleep(seconds))
    body = bodies.current
    return RobotFacts(
        router=router,
        described=described,
        health=health.newest,
        namesakes=_alternating(places),
        lead_ms=lead_ms,
        control_topic=_control_topic(body),
        unneeded=_unneeded(body),
        pace=_pace(states),
    )


def _alternating(places: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return the places of processes that publish in turn; those of a restart do not return."""
    return {
        name: tuple(dict.fromkeys(found))
        for name, found in places.items()
        if any(a != b and a in found[n + 2 :] for n, (a, b) in enumerate(itertools.pairwise(found)))
    }


def _control_topic(body: Body | None) -> str:
    if body is None:
        return CMD_VEL.key
    return body.description.control_topic if body.description.has_base else JOINT_CMD.key


def _unneeded(body: Body | None) -> frozenset[str]:
    """Return the keys of scans and worlds if the body is a fixed arm without a lidar."""
    fixed = body is not None and not body.description.has_base and not body.description.lidar
    return frozenset((SCAN.key, WORLD.key)) if fixed else frozenset()


def _pace(states: list[RobotState]) -> float | None:
    """Return the robot's time over real time; None with fewer than two states."""
    same_boot = [state for state in states if state.boot == states[-1].boot]
    if len(same_boot) < 2:
        return None
    seconds = (same_boot[-1].stamp_ns - same_boot[0].stamp_ns) / 1e9
    ticks = same_boot[-1].tick - same_boot[0].tick
    return ticks * TICK_S / seconds if seconds > 0 else None
