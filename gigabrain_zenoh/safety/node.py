"""Safety node: publishes a verdict for each scan, every second state, and each change."""

import logging
import shutil
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from gigabrain_schemas.base import Cause, Message
from gigabrain_schemas.body import Arm, ArmModel, Body, BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel, JointCommand
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.sensors import Imu
from gigabrain_schemas.topics import (
    ARM_MODEL,
    BODY,
    CMD_VEL,
    DEPTH,
    HEALTH,
    IMAGE,
    IMU,
    INTENT,
    JOINT_CMD,
    LOG,
    MAP,
    POSE,
    SAFETY,
    SCAN,
    STATE,
    WORLD,
    Topic,
    command_topic,
)
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.bus.freshness import LEAD_TICKS, PreviousTick
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate.causes import in_words
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.stopping import REPEAT_TICKS, scan_limit_ns
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.runtime.heartbeat import Progress
from gigabrain_zenoh.safety.arm_motion import ArmShape
from gigabrain_zenoh.safety.cameras import Picture, Pictures, depth_cameras
from gigabrain_zenoh.safety.health import SYSTEMS, Bases, Host, horizontal
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step

HOST_PERIOD_NS = 1_000_000_000
HOST_SAMPLES = 10  # of the CPU load, averaged over ten seconds
log = logging.getLogger("gigabrain_zenoh.safety")


async def run(bus: Bus, ready: Callable[[], None], probe: "HostProbe | None" = None) -> None:
    """Publish verdicts until the process ends; `probe` reads the computer's resources."""
    memory, last, last_tick = SafetyMemory(), SafetyState(verdict="stop"), 0

    def judge(_: Message) -> None:
        nonlocal memory, last, last_tick
        body = collector.bodies.current
        inputs = collector.inputs(body.description) if body else None
        if body is None or inputs is None:
            return
        before, state = memory, inputs.state
        memory, verdict = step(body.description, memory, inputs)
        # joints need a verdict of the newest tick
        repeat = 1 if body.description.joints else REPEAT_TICKS
        due = state.tick - last_tick >= repeat or state.boot != before.boot
        new = memory.field.basis != before.field.basis
        if due or new or _differs(verdict, last):
            _log_changes(state, last, verdict)
            basis = memory.field.basis
            last, last_tick = bus.publish(SAFETY, verdict, basis=basis), state.tick

    def received() -> tuple[object, ...]:
        return (bus.arrived.get(STATE.key),) if collector.bodies.current else ()

    collector = InputCollector(bus, judge, probe or HostMonitor(state_dir()).read)
    bus.progress = Progress(received, lambda: bus.sent[SAFETY.key])
    ready()
    await bus.failed


def _differs(now: SafetyState, before: SafetyState) -> bool:
    return (now.causes, now.caps, now.joints) != (before.causes, before.caps, before.joints)


def _log_changes(state: RobotState, before: SafetyState, now: SafetyState) -> None:
    """Log causes and warnings that begin or end, once the robot has been enabled."""
    if not state.gate.enables:
        return
    level = logging.WARNING if now.verdict == "stop" else logging.INFO
    if begun := _missing(now.causes, before.causes):
        _log(level, f"{now.verdict}: {in_words(begun)}", "held back", begun)
    if begun := _missing(now.warnings, before.warnings):
        _log(logging.WARNING, f"warning: {in_words(begun)}", "warned", begun)
    ended = _missing((*before.causes, *before.warnings), (*now.causes, *now.warnings))
    if ended:
        _log(logging.INFO, f"over: {'; '.join(cause.text for cause in ended)}", "over", ended)


def _missing(causes: tuple[Cause, ...], known: tuple[Cause, ...]) -> tuple[Cause, ...]:
    codes = {cause.code for cause in known}
    return tuple(cause for cause in causes if cause.code not in codes)


def _log(level: int, text: str, event: str, causes: tuple[Cause, ...]) -> None:
    data = {"event": event, "causes": ",".join(cause.code for cause in causes)}
    log.log(level, "%s", text, extra={"data": data})


HostProbe = Callable[[int], Host]  # takes the monotonic time [ns]


class HostMonitor:
    """Reads the computer's resources once a second at most, in about 0.2 ms.

    `folder` is on the disk with logs, maps and the latch. A disk may hang, so it is read in a
    thread; the last value stays until the next one arrives.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._disk_mb: float | None = None
        self._reader: threading.Thread | None = None
        self._next_ns = 0
        self._busy: deque[float] = deque(maxlen=HOST_SAMPLES)  # [%] of all cores, one a second
        psutil.cpu_percent()  # starts its first interval
        self._host = Host()

    def read(self, now_ns: int) -> Host:
        """Return the resources at monotonic time `now_ns`, at most a second old."""
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + HOST_PERIOD_NS
            if self._reader is None or not self._reader.is_alive():
                self._reader = threading.Thread(target=self._read_disk, name="disk", daemon=True)
                self._reader.start()
            self._busy.append(psutil.cpu_percent())
            cpu = sum(self._busy) / HOST_SAMPLES if len(self._busy) == HOST_SAMPLES else None
            memory = psutil.virtual_memory().percent
            self._host = Host(disk_mb=self._disk_mb, cpu=cpu, memory=memory)
        return self._host

    def _read_disk(self) -> None:
        self._disk_mb = _free_mb(self._folder)


def _free_mb(folder: Path) -> float | None:
    """Return the free space [MB] on the disk of a folder that may not exist yet."""
    for place in (folder, *folder.parents):
        try:
            return shutil.disk_usage(place).free / 1e6
        except FileNotFoundError:
            continue
        except OSError:
            return None
    return None


# subscribed only so that invalid messages on topics without another subscriber are counted
COUNTED_TOPICS: tuple[Topic[Any], ...] = (IMAGE, POSE, MAP, HEALTH, LOG)
MAX_QUEUED = 256  # messages between two states
WORLD_MARGIN_NS = 50_000_000  # added to the age limit of scans: a world comes after its scan


class InputCollector:
    """Keeps the newest messages; calls `on_new` with each state and each scan."""

    def __init__(self, bus: Bus, on_new: Callable[[Message], None], probe: HostProbe) -> None:
        self._bus, self._probe, self._on_new = bus, probe, on_new
        self._pictures: dict[str, Latest[DepthImage]] = {}  # by camera of the body
        self._depth_subscribed = False
        self._by_commander: dict[str, PreviousTick[CmdVel]] = {}
        # echoes: age [ticks], source; shocks: tick, horizontal acceleration [m/s2]
        self._echoes: deque[tuple[int, str]] = deque(maxlen=MAX_QUEUED)
        self._shocks: deque[tuple[int, float]] = deque(maxlen=MAX_QUEUED)
        self._commands = Latest(CMD_VEL, bus.clock, bus.time)  # the brain's
        self._joint_commands = Latest(JOINT_CMD, bus.clock, bus.time)
        self._command_key, self._unsubscribe = CMD_VEL.key, _no_subscription
        self._shape: tuple[ArmModel, Arm | None, ArmShape | None, str] | None = None
        self._arm_models = bus.latest(ARM_MODEL)
        self.bodies = bus.latest(BODY, self._on_body)
        self._states = bus.latest(STATE, on_new)
        self._scans = bus.latest(SCAN, on_new)
        bus.subscribe(CMD_VEL, self._on_command, lazy=True)
        bus.subscribe(JOINT_CMD, self._on_joint_command, lazy=True)
        bus.subscribe(IMU, self._on_imu, lazy=True)
        for topic in COUNTED_TOPICS:
            bus.subscribe(topic, lambda _key, _message: None, lazy=True)
        self._worlds = bus.latest(WORLD, lazy=True)
        self._intents = bus.latest(INTENT, lazy=True)

    def inputs(self, body: BodyDescription) -> SafetyInputs | None:
        """Return the present inputs; None without a state.

        It also returns None while the newest state is older than the newest scan.
        """
        state = self._states.fresh()
        if state is None or state.tick < self._bus.time.tick:
            return None
        commander = state.gate.commander
        received = self._by_commander.get(commander)
        arm, arm_problem = self._arm(body)
        return SafetyInputs(
            state=state,
            scan=self._scans.current,
            scan_age_ns=self._scans.age_ns(),
            pictures=self._newest_pictures(),
            silent=self._silent(body),
            bases=self._bases(body),
            command=(
                received.at(state.boot, state.tick, STATE.stale_after_ns) if received else None
            ),
            echo_ages=self._echo_ages(commander),
            shock=self._shock(state),
            host=self._probe(self._bus.clock.now_ns()),
            arm=arm,
            arm_problem=arm_problem,
        )

    def _arm(self, body: BodyDescription) -> tuple[ArmShape | None, str]:
        """Return the shapes of the body's arm, or the problem; each model is compiled once."""
        model = self._arm_models.current
        if body.arm is None or model is None:
            return None, "no model of the arm has come yet" if body.arm else ""
        cached = self._shape
        if cached is None or cached[:2] != (model, body.arm):
            cached = self._shape = (model, body.arm, *arm_shape(model.mjcf, body))
        return cached[2:]

    def _newest_pictures(self) -> Pictures:
        newest = ((name, each.current, each.age_ns()) for name, each in self._pictures.items())
        return {name: Picture(image=image, age_ns=age or 0) for name, image, age in newest if image}

    def _silent(self, body: BodyDescription) -> tuple[str, ...]:
        beat_ns = round(body.thresholds.heartbeat * 1e9)
        limits_ns = (scan_limit_ns(body) + WORLD_MARGIN_NS, beat_ns, beat_ns)
        commands = self._control(body)
        systems: tuple[Latest[Any], ...] = (self._worlds, self._intents, commands)
        return tuple(
            name
            for name, system, limit_ns in zip(SYSTEMS, systems, limits_ns, strict=True)
            if not system.fresh(limit_ns)
        )

    def _control(self, body: BodyDescription) -> Latest[Any]:
        """Return the commands that show whether control works."""
        return self._commands if body.has_base else self._joint_commands

    def _bases(self, body: BodyDescription) -> Bases:
        def basis(of: Latest[Any]) -> int:
            return of.current.basis if of.current else 0

        return Bases(
            scan=basis(self._scans),
            world=basis(self._worlds),
            intent=basis(self._intents),
            command=basis(self._control(body)),
        )

    def _echo_ages(self, commander: str) -> tuple[int, ...]:
        ages = tuple(age for age, source in self._echoes if source == commander)
        self._echoes.clear()
        return ages

    def _shock(self, state: RobotState) -> float:
        """Return the hardest shock before this tick; keep later ones for the next call.

        A message of the same tick may arrive before or after the state.
        """
        shock = max((value for tick, value in self._shocks if tick < state.tick), default=0.0)
        later = [(tick, value) for tick, value in self._shocks if tick >= state.tick]
        self._shocks = deque(later, maxlen=MAX_QUEUED)
        return shock

    def _on_command(self, _key: str, command: CmdVel) -> None:
        if command.source == BRAIN:
            self._commands.store(command)
        state = self._states.current
        if state and command.source == state.gate.commander:
            if command.source not in self._by_commander:  # forget the last commander
                self._by_commander = {command.source: PreviousTick()}
            self._by_commander[command.source].receive(command)
        self._note_echo(command)

    def _on_joint_command(self, _key: str, command: JointCommand) -> None:
        if command.source == BRAIN:
            self._joint_commands.store(command)
        self._note_echo(command)

    def _note_echo(self, command: CmdVel | JointCommand) -> None:
        if command.boot == self._bus.time.boot:
            self._echoes.append((max(0, self._bus.time.tick - command.tick), command.source))

    def _on_imu(self, _key: str, imu: Imu) -> None:
        time = self._bus.time
        if imu.boot == time.boot and imu.tick <= time.tick + LEAD_TICKS:
            self._shocks.append((imu.tick, horizontal(imu.linear_acceleration)))

    def _on_picture(self, key: str, image: DepthImage) -> None:
        """Store a picture. One of the future is refused: it would make present ones look old."""
        latest = self._pictures.get(key.removeprefix(f"{DEPTH.key}/"))
        if latest is None or max(image.basis, image.tick) > self._bus.time.tick + LEAD_TICKS:
            self._bus.counters["refused_pictures"] += 1
            return
        before = latest.current
        if before is not None and image.basis <= before.basis:
            self._bus.counters["repeated_pictures"] += 1
        elif latest.store(image):
            self._on_new(image)

    def _on_body(self, body: Body) -> None:
        """Subscribe to the body's cameras, and to its command topic if it is not CMD_VEL."""
        names = [camera.name for camera in depth_cameras(body.description)]
        if names != list(self._pictures):
            self._pictures = {n: Latest(DEPTH, self._bus.clock, self._bus.time) for n in names}
        if names and not self._depth_subscribed:
            self._depth_subscribed = True
            self._bus.subscribe(DEPTH, self._on_picture)
        topic = command_topic(body.description)
        if topic.key == self._command_key:
            return
        self._unsubscribe()
        self._command_key, self._unsubscribe = topic.key, _no_subscription
        if topic.key != CMD_VEL.key:
            self._unsubscribe = self._bus.subscribe(topic, self._on_command, lazy=True)


def arm_shape(mjcf: str, body: BodyDescription) -> tuple[ArmShape | None, str]:
    """Return the shapes of an arm, or the problem with them. Only this imports MuJoCo."""
    try:
        from gigabrain_zenoh.safety.arm_shape import MujocoArm

        return MujocoArm(mjcf, body), ""
    except ImportError as error:
        return None, f"safety of an arm needs MuJoCo: {error}"
    except ConfigError as error:
        return None, str(error)


def _no_subscription() -> None:
    """Do nothing; the unsubscribe function without a subscription."""
