"""The driver process: connects a body to the bus, through the gate. The same for all bodies."""

import asyncio
import functools
import logging
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import msgspec
from msgspec.structs import replace

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.button import ButtonWatch
from gigabrain_drivers.driver.catalog import make_driver, ports_folder
from gigabrain_drivers.driver.clipping import clipped, fault_of
from gigabrain_drivers.driver.gatekeeper import Gatekeeper, wait_for_disk
from gigabrain_drivers.driver.lockstep import REPEAT_S, Lockstep, RoundTrip
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.driver.world_requests import serve_world
from gigabrain_drivers.links.frames import describe_command
from gigabrain_drivers.sim import exposes
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.base import TICK_NS, Message
from gigabrain_schemas.body import Body, BodyDescription, RobotState, SafeState
from gigabrain_schemas.brain import CmdVel, JointCommand
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import (
    ARM_MODEL,
    BODY,
    CAMERA,
    DEPTH,
    IMAGE,
    JOINT_CMD,
    SAFETY,
    SCAN,
    SIM_POSES,
    SIM_SCENE,
    STATE,
    WORLD,
    Topic,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.params import shown
from gigabrain_zenoh.bus.restoring import RestoringPublisher
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.body_settings import SETTINGS, restricted, setting_of, split
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.geometry.limits import ZERO, limits_of
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.runtime.heartbeat import Progress

log = logging.getLogger(__name__)

ERROR_PATH = r" - at `[^`]*`$"  # the end that msgspec adds to an error
BODY_EVERY_TICKS = 50  # once a second
STATE_TOPICS = (SIM_SCENE, SIM_POSES)  # emitted before their tick, so that they wait for it
CAMERAS_S = 30.0  # the first tick in lock-step waits this long for pictures
MAX_HOLD_TICKS = 25  # 0.5 s; limp joints have to hold within this time
# the echo's 150 ms plus the watchdog's 100 ms: no older command may move the body
STALE_NS = 250_000_000


class DriverProcess:
    """One body on the bus."""

    def __init__(self, config: DriverConfig, robot: RobotFile, driver: Driver, bus: Bus) -> None:
        self._config, self._robot, self._driver, self._bus = config, robot, driver, bus
        self._settings, _ = split(config.robot)  # replaced settings of the body, by path
        description = restricted(robot.description(), self._settings)
        self._body = Body(description=description, link=config.link)
        gate_config = gate.GateConfig(
            limits=limits_of(description),
            joints=description.joints,
            basis_ns=scan_limit_ns(robot),
            auto_resume=config.resume == "auto",
        )
        self._wake = asyncio.Event()
        self._gatekeeper = Gatekeeper(
            gate_config, robot.robot_type, bus, Path(config.state_dir), self._wake.set
        )
        press = self._gatekeeper.press
        self._button = ButtonWatch(bus, press) if config.button else None
        wait_s = config.lockstep_timeout_s
        self._lockstep = Lockstep(robot.control.period_ticks, wait_s) if driver.lockstep else None
        self._sensors: list[tuple[Topic[Any], Message]] = []  # to be published with the next tick
        self._poses: Message | None = None  # newest ones of the simulated world
        self._restoring = RestoringPublisher(bus)
        # restored each tick, as a wrong body latches the gate
        self._bodies = RestoringPublisher(bus)
        self._round_trip = RoundTrip()
        self._line = asyncio.Lock()  # held during each call to the body
        self._sent = ZERO  # the newest command to the body
        self._joints_sent: tuple[float, ...] = ()
        self._state: RobotState | None = None  # newest one of the driver, without gate and commands
        self._limp = False  # in the newest state, or by request
        self._limp_requested = False  # until the joints are moved or held again
        self._body_tick = 0  # when BODY was last published
        self._clipped = QuietFault(log)
        driver.emit = self._emit
        bus.report = self.report
        bus.progress = Progress(self._progress_inputs, lambda: bus.sent[STATE.key])

    async def run(self, ready: Callable[[], None]) -> None:
        """Serve the body until cancelled. In any case the body is safe at the end."""
        try:
            async with self._driver:
                await self._serve(ready)
        finally:
            await self._gatekeeper.close()

    async def _serve(self, ready: Callable[[], None]) -> None:
        bus = self._bus
        bus.subscribe(command_topic(self._robot), self._on_command, self._on_bad_command)
        bus.subscribe(JOINT_CMD, self._on_joint_command, self._on_bad_command)
        bus.latest(SAFETY, self._on_safety)
        self._gatekeeper.serve(self._driver.stop)
        if self._robot.joints:
            self._gatekeeper.serve_limp(self._on_limp)
        if self._lockstep and self._robot.cameras:
            self._await_cameras(self._lockstep)
        if self._config.link != "emulated":  # then the emulator has the world
            serve_world(bus, self._driver.change_world)
        self._serve_settings()
        self._bodies.publish(BODY, self._body)
        if model := self._driver.arm_model():
            self._restoring.publish(ARM_MODEL, model)
        ready()
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._run_ticks())
            tasks.create_task(self._apply_commands())

    def _await_cameras(self, lockstep: Lockstep) -> None:
        """Let ticks wait for pictures, and for their contours."""

        def receive(key: str, message: Message) -> None:
            if message.boot == self._gate.boot:
                lockstep.picture(key.rpartition("/")[2], message.basis)

        topics: tuple[Topic[Any], ...] = (DEPTH, IMAGE, CAMERA)
        for topic in topics:
            self._bus.subscribe(topic, receive)
        self._bus.latest(WORLD, lockstep.world)

    def _serve_settings(self) -> None:
        """Serve the settings of the body that may change while it runs."""
        file = self._robot.description()
        for path, one in SETTINGS.items():
            bound = setting_of(file, path)
            if not one.live or not bound:  # the body has no such motion
                continue
            side = "at least" if one.at_least else "above 0, at most"
            expected = f"a number, {side} {bound:g} [{one.unit}], the body's own {one.kind}"
            self._bus.params.add(
                path.rpartition(".")[2],
                expected,
                functools.partial(self._setting, path),
                functools.partial(self._change_setting, path),
                key=f"robot.{path}",
            )

    def _setting(self, path: str) -> str:
        return shown(setting_of(self._body.description, path))

    def _change_setting(self, path: str, text: str) -> None:
        """Change a setting for gate, safety, planner and control.

        Raises Refused for a value less safe than the body's own, and ValueError.
        """
        settings = self._settings | {path: float(text)}
        try:
            description = restricted(self._robot.description(), settings)
        except ValueError as error:
            if re.search(ERROR_PATH, str(error)):  # invalid for any body
                raise  # `Params` says what is expected
            raise Refused(str(error)) from None
        self._settings, self._body = settings, replace(self._body, description=description)
        self._gatekeeper.limit(limits_of(description))
        self._bodies.publish(BODY, self._body)

    async def _run_ticks(self) -> None:
        async for passed in self._driver.ticks(self._bus.clock):
            await self._tick(passed)
        self._update_figures()
        log.info("the simulation has ended", extra={"data": {"event": "finished"}})
        await self._bus.failed

    async def _apply_commands(self) -> None:
        """Apply commands between ticks as well, as soon as they arrive."""
        while True:
            await self._wake.wait()
            await self._apply_command()

    def report(self) -> Mapping[str, float | int | str | None]:
        """Return the figures of the whole run, of the body and of this process."""
        figures: dict[str, float | int | str | None] = {
            "stale_commands_executed": self._bus.counters["stale_commands_executed"],
            "lockstep_timeouts": self._lockstep.timeouts if self._lockstep else 0,
            "ticks": self._gate.tick,
        }
        return {**self._driver.report(), **self._round_trip.report(), **figures}

    def _progress_inputs(self) -> tuple[object, ...]:
        """Return the inputs of progress: the clock, until a simulation is over."""
        return () if self._driver.finished else (self._bus.clock.now_ns(),)

    async def _tick(self, passed: int) -> None:
        """Process a tick of the body; several if this process was late."""
        self._state = state = self._checked(await self._driver.read_state())
        self._limp = state.limp or self._limp_requested
        if self._wake.is_set():
            await self._apply_command()  # the gate continues from the body's newest command
        button = self._button.faults() if self._button else ()
        faults = button if state.link.connected else (why.LINK_LOST, *button)
        tick = gate.Tick(
            state.velocity,
            self._wall_ns(),
            faults,
            joints=commanded_joints(self._body.description, state),
            held=state.joints_sent,
            limp=self._limp,
        )
        self._gatekeeper.ticks(passed, tick)
        self._bus.time.tick = self._gate.tick
        if self._lockstep:
            await self._step_in_lockstep(self._lockstep, state)
        else:
            self._publish_tick(state)
        await self._apply_command()

    def _checked(self, reported: RobotState) -> RobotState:
        """Return the state clipped to its bounds; log which value was beyond them."""
        state, now_ns = clipped(reported), self._bus.clock.now_ns()
        if state is reported:
            self._clipped.end("the body's values are within their bounds again", now_ns)
        else:
            what = f"{fault_of(reported)}; is it in another unit?"
            self._clipped.begin(f"the body's state was clipped to its bounds: {what}", now_ns)
        return state

    def _emit(self, topic: Topic[Any], message: Message) -> None:
        """Publish a sensor's message: at once, or with the next tick, as always in lock-step."""
        self._poses = message if topic is SIM_POSES else self._poses
        message = clipped(message)
        if self._lockstep or not self._gate.tick or topic in STATE_TOPICS:
            self._sensors.append((topic, message))
        else:
            self._send(topic, message)

    def _send(self, topic: Topic[Any], message: Message) -> None:
        tick = self._gate.tick
        if topic is SCAN:
            self._round_trip.sent(tick, self._bus.clock.now_ns())
        publisher = self._restoring if topic is SIM_SCENE else self._bus
        publisher.publish(topic, message, basis=tick)

    def _publish_tick(self, state: RobotState) -> None:
        bus, tick = self._bus, self._gate.tick
        state = replace(
            state, gate=gate.status(self._gate), sent=self._sent, joints_sent=self._joints_sent
        )
        bus.publish(STATE, state, basis=tick)
        for topic, message in self._sensors:
            self._send(topic, message)
        self._sensors.clear()
        self._bodies.restore()
        if tick - self._body_tick >= BODY_EVERY_TICKS:
            self._body_tick = tick
            self._bodies.publish(BODY, self._body)
            self._restoring.restore(basis=tick)
            self._update_figures()

    async def _step_in_lockstep(self, lockstep: Lockstep, state: RobotState) -> None:
        """Announce the tick and wait until it is answered.

        The first one waits until the whole brain answers a scan, so that runs are repeatable.
        """
        if self._gate.tick > 1:
            self._begin(lockstep, state)
            await lockstep.answered(lambda: self._publish_tick(state))
            return
        scan, answered, cameras_s = await self._newest_scan(), False, CAMERAS_S
        while not answered:
            if scan:
                self._sensors.append((SCAN, scan))
            if self._poses and self._robot.cameras:  # late subscribers do not get the old ones
                self._sensors.append((SIM_POSES, self._poses))
            self._begin(lockstep, state)
            if cameras_s <= 0:
                lockstep.forget_pictures()
            answered = await lockstep.wait(REPEAT_S)
            cameras_s -= REPEAT_S

    def _begin(self, lockstep: Lockstep, state: RobotState) -> None:
        """Announce the tick; on a network in memory, answers arrive before this returns."""
        tick = self._gate.tick
        with_scan = any(topic is SCAN for topic, _ in self._sensors)
        basis = tick if with_scan else self._round_trip.scan_tick
        lockstep.begin(tick, basis, self._exposed(tick))
        self._publish_tick(state)

    def _exposed(self, tick: int) -> list[str]:
        """Return the cameras that take a picture in a tick; all of them in the first one."""
        cameras = self._robot.cameras
        return [one.name for one in cameras if tick == 1 or exposes(one.rate_hz, tick)]

    async def _newest_scan(self) -> Message | None:
        return await self._driver.get_sensor_data("scan") if self._robot.lidar else None

    @property
    def _gate(self) -> gate.GateState:
        return self._gatekeeper.state

    async def _apply_command(self) -> None:
        """Send the output of the gate to the body."""
        async with self._line:
            self._wake.clear()
            await self._apply_joints(self._gate)
            now = self._gate  # it may have changed while the joints were sent
            if now.mode == "latched" and not now.joints:  # `now.joints` would be held
                self._sent = ZERO
                await self._driver.stop()
                return
            if self._robot.drive_type == "arm":
                return
            to = now.output
            sent = await self._driver.set_base_velocity(to.linear_x, to.linear_y, to.angular_z)
            self._sent = sent
            if log.isEnabledFor(logging.DEBUG):
                log.debug("%s", describe_command(to, sent))
        if now.mode == "enabled" and now.command and to != ZERO:
            late = gate.age_ns(now, now.command.tick, self._wall_ns()) > STALE_NS
            self._bus.counters["stale_commands_executed"] += late

    async def _apply_joints(self, now: gate.GateState) -> None:
        """Send the joints to the positions of the gate, unless the body is limp."""
        if not now.joints or (self._limp and now.mode != "enabled"):
            return
        self._limp_requested = False
        await self._send_joints(now)

    async def _send_joints(self, now: gate.GateState) -> None:
        names = [joint.name for joint in self._body.description.joints]
        wanted = [joint.position for joint in now.joints]
        sent = await self._driver.set_joint_positions(dict(zip(names, wanted, strict=True)))
        self._joints_sent = tuple(sent[name] for name in names)

    async def _on_limp(self, limp: bool) -> None:
        """Make the joints limp, or hold them where they are. Raises BodyLost if they do not hold.

        If the gate is enabled meanwhile, hold the joints again and raise Refused.
        """
        async with self._line:
            if limp:
                self._gatekeeper.refuse_if_enabled()
                await self._driver.limp()
                self._limp_requested = self._limp = True
                try:
                    self._gatekeeper.refuse_if_enabled()
                except Refused:
                    self._limp_requested = False
                    if self._gate.joints:
                        await self._send_joints(self._gate)
                    raise
                return
            if self._gate.joints:
                await self._send_joints(self._gate)
            self._state = None  # only a later state shows whether they hold
        for _ in range(MAX_HOLD_TICKS):
            await self._bus.clock.sleep_ns(TICK_NS)
            if self._state and holds(self._body.description, self._state):
                self._limp_requested = self._limp = False
                return
        raise BodyLost(self._driver.problem or "the joints do not hold")

    def _on_command(self, _key: str, command: CmdVel) -> None:
        arrived_ns = self._bus.clock.now_ns()
        self._gatekeeper.command(gate.VelocityCommand(command, self._wall_ns()))
        if command.boot == self._gate.boot:
            counts = self._gate.mode == "enabled"
            self._round_trip.answered(command.basis, arrived_ns, counts=counts)
            if self._lockstep and command.source == (self._gate.commander or gate.BRAIN):
                self._lockstep.command(command)

    def _on_joint_command(self, _key: str, command: JointCommand) -> None:
        self._gatekeeper.command(gate.JointsCommand(command, self._wall_ns()))
        from_commander = command.source == (self._gate.commander or gate.BRAIN)
        if self._lockstep and from_commander and command.boot == self._gate.boot:
            self._lockstep.command(command)

    def _on_bad_command(self, payload: bytes) -> None:
        """Step the gate if an invalid command has NaN or infinity."""
        if sender := not_finite(payload):
            self._gatekeeper.step(gate.NotFinite(*sender))

    def _on_safety(self, verdict: SafetyState) -> None:
        self._gatekeeper.step(gate.Safety(verdict))
        if self._lockstep and verdict.boot == self._gate.boot:
            self._lockstep.verdict(verdict)

    def _wall_ns(self) -> int | None:
        """Return the host's clock [ns]; None in lock-step, where it has no meaning."""
        return None if self._lockstep else self._bus.clock.now_ns()

    def _update_figures(self) -> None:
        figures = self._round_trip.report()
        for name in ("scan_to_cmd_p50", "scan_to_cmd_p99"):
            value = figures[f"{name}_ms"]
            if value is not None:
                self._bus.latency_ms[name] = value
        if self._lockstep:
            self._bus.counters["lockstep_timeouts"] = self._lockstep.timeouts


async def run(config: DriverConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Drive one body until the process ends. Raises ConfigError for a wrong configuration."""
    if config.link != "sim" and config.speed != 1.0:
        raise ConfigError(f"link {config.link!r} runs in real time; --speed is for simulation")
    if config.link == "real" and config.resume == "auto":
        raise ConfigError("resume: auto is not allowed with link real; use manual")
    if config.link != "real":
        load_world(config.world, config.seed)  # checked here, as a mock accepts any world
    where = Run(
        folder=Path(),
        link=config.link,
        world=config.world,
        seed=config.seed,
        speed=config.speed,
        seconds=config.seconds,
        emulator=config.emulator or str(ports_folder(config.body)),
        cameras=config.cameras,
        checkpoint=config.checkpoint,
        changes=split(config.robot)[1],
    )
    robot, driver = make_driver(config.body, where)
    if not driver.can(robot.safe_state):
        known = ", ".join(name for name in get_args(SafeState) if driver.can(name))
        raise ConfigError(
            f"safe_state: {robot.safe_state} is not supported by {type(driver).__name__}; "
            f"expected one of: {known}"
        )
    await wait_for_disk(Path(config.state_dir), bus.clock)
    try:
        process = DriverProcess(config, robot, driver, bus)
    except ValueError as error:
        raise ConfigError(f"robot: {re.sub(ERROR_PATH, '', str(error))}") from None
    await process.run(ready)


class RawCommand(msgspec.Struct):
    """A command before its numbers are checked."""

    linear_x: float = 0.0
    linear_y: float = 0.0
    angular_z: float = 0.0
    position: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    source: str = ""
    boot: int = 0


def not_finite(payload: bytes) -> tuple[str, int] | None:
    """Return source and boot of a command with NaN or infinity; None for anything else."""
    try:
        raw = msgspec.msgpack.decode(payload, type=RawCommand)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    numbers = (raw.linear_x, raw.linear_y, raw.angular_z, *raw.position, *raw.velocity)
    if all(map(math.isfinite, numbers)):
        return None
    return raw.source, raw.boot


def holds(body: BodyDescription, state: RobotState) -> bool:
    """Return whether all commandable joints are reported and hold."""
    return state.link.connected and not state.limp and bool(commanded_joints(body, state))


def commanded_joints(body: BodyDescription, state: RobotState) -> tuple[JointMotion, ...]:
    """Return the commandable joints as measured; empty while one is missing."""
    measured = {joint.name: joint for joint in state.joints}
    if any(joint.name not in measured for joint in body.joints):
        return ()
    found = (measured[joint.name] for joint in body.joints)
    return tuple(JointMotion(joint.position, joint.velocity) for joint in found)
