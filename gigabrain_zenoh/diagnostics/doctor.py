"""What is wrong with a machine and its robot, and the cure. Pure, over what was looked at."""

import itertools
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from msgspec import Struct

from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, SAFETY, SCAN, STATE, WORLD, Topic
from gigabrain_zenoh.diagnostics.doctor_facts import Machine, Robot

Grade = Literal["ok", "hint", "bad"]
SYSTEMS = ("router", "driver", "perception", "decision", "control", "safety")
LEAST = {"eclipse-zenoh": (1, 10), "msgspec": (0, 19), "numpy": (1, 26), "cyclopts": (5, 0)}
NEEDED = ("eclipse-zenoh", "msgspec", "numpy", "pyserial", "pyyaml", "cyclopts", "rich")
EXTRAS = {
    "mujoco-core": "sim", "cryptography": "keys", "mcap": "record", "textual": "view",
    "uvloop": "fast",
}  # fmt: skip
FREE_MB, CLOCK_MS, DAYS = 500.0, 500.0, 30.0
SENT_BY: dict[Topic[Any], str] = {
    STATE: "driver", SCAN: "driver", BODY: "driver", WORLD: "perception", INTENT: "decision",
    CMD_VEL: "control", SAFETY: "safety",
}  # fmt: skip
SLOW = 0.5  # of the promised rate
BUSY = 0.9  # of one core


class Finding(Struct, frozen=True, kw_only=True):
    """One thing that was looked at."""

    about: str
    grade: Grade
    text: str
    cure: str = ""


def examine(machine: Machine, robot: Robot) -> list[Finding]:
    """Everything, in the order in which it matters."""
    looks = (
        _python(machine), _libraries(machine), _folders(machine), _serial(machine),
        _multicast(machine), _certificate(machine), _router(robot), _processes(robot),
        _rates(robot), _clocks(robot), _load(robot),
    )  # fmt: skip
    return list(itertools.chain.from_iterable(looks))


def exit_code(findings: Sequence[Finding]) -> int:
    """0 where nothing is bad; hints do not count."""
    return int(any(finding.grade == "bad" for finding in findings))


def _ok(about: str, text: str) -> Finding:
    return Finding(about=about, grade="ok", text=text)


def _bad(about: str, text: str, cure: str) -> Finding:
    return Finding(about=about, grade="bad", text=text, cure=cure)


def _hint(about: str, text: str, cure: str) -> Finding:
    return Finding(about=about, grade="hint", text=text, cure=cure)


def _python(machine: Machine) -> Iterator[Finding]:
    version = ".".join(map(str, machine.python))
    if machine.python < (3, 11):
        yield _bad("python", f"{version} is too old", "install Python 3.11 or newer")
    else:
        yield _ok("python", f"{version} on {machine.system}")


def _libraries(machine: Machine) -> Iterator[Finding]:
    for name, version in machine.libraries.items():
        extra = EXTRAS.get(name)
        if version is None and extra:
            cure = f"pip install 'gigabrain-zenoh[{extra}]', if you want it"
            yield _hint(name, "is not installed", cure)
        elif version is None:
            yield _bad(name, "is not installed", "pip install gigabrain-zenoh")
        elif _numbers(version) < LEAST.get(name, ()):
            least = ".".join(map(str, LEAST[name]))
            yield _bad(name, f"{version} is too old", f"pip install -U '{name}>={least}'")
        else:
            yield _ok(name, version)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", version)[:3]))


def _folders(machine: Machine) -> Iterator[Finding]:
    for folder in machine.folders:
        if not folder.writable:
            cure = f"chown or chmod {folder.path}, or set XDG_STATE_HOME and XDG_RUNTIME_DIR"
            yield _bad("folder", f"{folder.path} cannot be written by this user", cure)
        elif folder.free_mb < FREE_MB:
            cure = "delete old runs and recordings"
            yield _bad("disk", f"{folder.free_mb:.0f} MB left for {folder.path}", cure)
        else:
            yield _ok("folder", f"{folder.path} can be written, {folder.free_mb / 1e3:.0f} GB left")


def _serial(machine: Machine) -> Iterator[Finding]:
    if not machine.ports:
        yield _ok("serial", "no USB serial device is plugged in")
    for port in machine.ports:
        what = f"{port.path} ({port.usb} {port.about})"
        if port.usable:
            yield _ok("serial", f"{what} can be opened")
        else:
            vendor, _, product = port.usb.partition(":")
            rule = (
                f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{vendor}", '
                f'ATTRS{{idProduct}}=="{product}", MODE="0660", GROUP="dialout"'
            )
            cure = (
                "add yourself to its group (`sudo usermod -aG dialout $USER`, then log in again); "
                f"if that does not help, this udev rule: {rule}"
            )
            yield _bad("serial", f"{what} may not be opened by this user", cure)


def _multicast(machine: Machine) -> Iterator[Finding]:
    if machine.multicast:
        yield _bad("multicast", "sessions look for others by themselves", "reinstall the package")
    else:
        yield _ok("multicast", "off: nobody joins but who is told the router's address")


def _certificate(machine: Machine) -> Iterator[Finding]:
    mine = machine.certificate
    if mine is None:
        return
    cure = "make a new identity with `gigabrain keys issue` and copy its folder here"
    if mine.problem:
        yield _bad("keys", mine.problem, cure)
    elif mine.days_left < DAYS:
        yield _bad("keys", f"{mine.name} in {mine.folder}: {mine.days_left:.0f} days left", cure)
    else:
        yield _ok("keys", f"{mine.name} in {mine.folder}: {mine.days_left:.0f} days left")


def _router(robot: Robot) -> Iterator[Finding]:
    if robot.problem and robot.port_open:
        cure = "use the robot's --keys, or stop what else has that port"
        yield _bad("router", f"{robot.problem} Something listens on that port.", cure)
    elif robot.problem and robot.router:
        cure = "start the robot there, open its port in the firewall, or name it with --connect"
        yield _bad("router", f"{robot.problem} Nothing listens on that port.", cure)
    elif robot.problem:
        problem, _, cure = robot.problem.partition("; ")
        yield _hint("router", problem, cure)
    else:
        yield _ok("router", f"answers at {robot.router}")


def _processes(robot: Robot) -> Iterator[Finding]:
    if robot.problem:
        return
    for name in SYSTEMS:
        if name not in robot.there:
            cure = f"start it, or read its log: gigabrain log --process {name}"
            yield _bad(name, "does not answer", cure)
    for name, one in robot.there.items():
        health = robot.health.get(name)
        if health is None:
            cure = f"it may hang; read its log: gigabrain log --process {name}"
            yield _bad(name, f"pid {one.pid} on {one.host}, but reports no health", cure)
        else:
            memory = f"{health.rss_bytes / 1e6:.0f} MB"
            yield _ok(
                name, f"{one.version}, pid {one.pid} on {one.host}, {health.cpu:.1%}, {memory}"
            )
    versions = {one.version for one in robot.there.values()}
    if len(versions) > 1:
        cure = "install the same version on all hosts"
        yield _bad("versions", f"the processes differ: {', '.join(sorted(versions))}", cure)


def _rates(robot: Robot) -> Iterator[Finding]:
    pace = min(robot.pace or 1.0, 1.0)
    for topic, process in SENT_BY.items():
        health = robot.health.get(process)
        if health is None:
            continue
        key = robot.control_topic if topic is CMD_VEL else topic.key
        hz, promised = health.sent_hz.get(key, 0.0), topic.hz * pace
        if hz < SLOW * promised and topic.key != BODY.key:
            cure = f"relieve this computer, or read the log: gigabrain log --process {process}"
            yield _bad(key, f"{hz:g} Hz from {process}, promised {promised:g}", cure)
    for process, health in robot.health.items():
        for key, count in health.rejected.items():
            cure = f"find out who sends it: gigabrain topic info {key.removeprefix('robot/')}"
            yield _hint(key, f"{process} has thrown away {count} invalid messages", cure)


def _clocks(robot: Robot) -> Iterator[Finding]:
    for host, lead_ms in robot.lead_ms.items():
        if abs(lead_ms) > CLOCK_MS:
            side = "behind" if lead_ms > 0 else "ahead of"
            cure = f"run an NTP client, such as chrony, on {host} and here"
            yield _bad("clock", f"{host} is {abs(lead_ms) / 1e3:.1f} s {side} this one", cure)
        else:
            yield _ok("clock", f"{host} differs by {abs(lead_ms):.0f} ms at most")
    if robot.pace is not None:
        yield _ok("ticks", f"the robot's time goes by at ×{robot.pace:.2f}")


def _load(robot: Robot) -> Iterator[Finding]:
    for process, health in robot.health.items():
        if health.cpu > BUSY:
            cure = "see what it does with `gigabrain top`, or give it a faster computer"
            yield _hint(process, f"takes {health.cpu:.0%} of a core", cure)
