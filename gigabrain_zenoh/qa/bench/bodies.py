"""`gigabrain bench bodies`: one brain drives all bodies in turn, without a restart."""

import asyncio
import dataclasses
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import CMD_VEL, HEALTH, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.gate.causes import in_words
from gigabrain_zenoh.launch.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.robot_under_test import ProcessGroup, client
from gigabrain_zenoh.runtime.managed_process import ProcessSpec
from gigabrain_zenoh.ui.run_report import RunMonitor

BODY = ("emulator", "driver")  # processes that are replaced for each body; the others stay
POLL_S = 0.05
START_TIMEOUT_S = 60.0  # until a body is enabled, on a busy machine
STALL_TIMEOUT_S = 20.0
MOTION = (("linear_x", 0.05), ("angular_z", 0.2))  # least speed that counts as motion


class BodyFigures(Struct, frozen=True, kw_only=True):
    """The figures of one body."""

    body: str
    seconds: float  # of the robot's time, while enabled
    contacts: int | None  # true value of the simulation, like the next two
    distance_m: float | None
    min_clearance_m: float | None
    commanded: float  # [m/s], mean forward speed
    measured: float  # [m/s]
    latency_ticks: float | None  # median, from a command to move to measured motion
    motions: int  # number of latencies
    reconnects: int
    stops: int  # how often the gate was shut
    driver_cpu: float | None  # [%] of a core; includes a body that the driver simulates


class BodiesResult(Struct, frozen=True, kw_only=True):
    """The figures of all bodies, and the process ids and restarts of the brain."""

    link: LinkName
    world: str
    seed: int
    brain_pids: dict[str, int]
    brain_restarts: int
    bodies: tuple[BodyFigures, ...]

    @property
    def ok(self) -> bool:
        """True without a contact or a restart of the brain."""
        return self.brain_restarts == 0 and all(body.contacts == 0 for body in self.bodies)


async def measure_bodies(
    names: Sequence[str],
    deployment: Deployment,
    seconds: float,
    folder: Path,
    show: Callable[[str], None],
) -> BodiesResult:
    """Drive each body for `seconds` of its time. Raises GigabrainError.

    `deployment` has all settings except the body.
    """
    deployment = with_free_port(deployment)
    specs = process_specs(deployment, "robot", folder / "brain", folder / "state")
    brain_specs = [spec for spec in specs if spec.name not in BODY]
    async with ProcessGroup(brain_specs, strict=False) as brain:
        await brain.until_ready(START_TIMEOUT_S)
        pids = brain.pids
        figures = []
        for name in names:
            show(name)
            one = msgspec.structs.replace(deployment, body=name)
            figures.append(await _drive(one, seconds, folder / Path(name).stem, brain))
        statuses = brain.supervisor.statuses
        restarts = brain.supervisor.deaths + sum(s.restarts for s in statuses.values())
        same = brain.pids == pids
    return BodiesResult(
        link=deployment.link,
        world=deployment.world,
        seed=deployment.seed,
        brain_pids=pids,
        brain_restarts=restarts if same else max(restarts, 1),
        bodies=tuple(figures),
    )


async def _drive(
    deployment: Deployment, seconds: float, folder: Path, brain: ProcessGroup
) -> BodyFigures:
    """Drive one body, from its driver's start to its end."""
    specs = [
        _independent(spec)
        for spec in process_specs(deployment, "robot", folder, folder / "state")
        if spec.name in BODY
    ]
    async with client(client_endpoint(deployment)) as bus:
        motion, watch = MotionProbe(bus), RunMonitor(bus)
        async with ProcessGroup(specs, strict=False) as body:
            await _until_driven(motion, seconds, body, brain)
            answers = await asyncio.gather(
                *(watch.describe(name, 1.0) for name in body.supervisor.statuses)
            )
    truth = {key: value for one in answers if one for key, value in one.report.items()}
    return _figures(deployment.body, motion, truth)


def _independent(spec: ProcessSpec) -> ProcessSpec:
    """Return the same process, without dependencies on those of another supervisor."""
    return dataclasses.replace(spec, after=tuple(name for name in spec.after if name in BODY))


async def _until_driven(
    motion: "MotionProbe", seconds: float, body: ProcessGroup, brain: ProcessGroup
) -> None:
    """Wait until the gate was open for `seconds`. Raises BodyLost when the robot stalls."""
    loop = asyncio.get_running_loop()
    seen, seen_s = motion.enabled_ticks, loop.time()
    while motion.enabled_ticks * TICK_S < seconds:
        await asyncio.sleep(POLL_S)
        if given_up := body.supervisor.given_up or brain.supervisor.given_up:
            raise BodyLost(f"{', '.join(given_up)} does not run")
        if motion.enabled_ticks != seen:
            seen, seen_s = motion.enabled_ticks, loop.time()
        elif loop.time() - seen_s > (STALL_TIMEOUT_S if seen else START_TIMEOUT_S):
            gate = motion.state.gate if motion.state else None
            cause = f"its gate is {gate.mode} {in_words(gate.causes)}" if gate else "no robot/state"
            raise BodyLost(f"the robot has stalled: {cause.strip()}")


def _figures(
    body: str, motion: "MotionProbe", truth: dict[str, float | int | str | None]
) -> BodyFigures:
    def number(name: str) -> float | None:
        value = truth.get(name)
        return float(value) if isinstance(value, int | float) else None

    contacts, latencies, cpu = number("contacts"), motion.latencies, motion.driver_cpu
    return BodyFigures(
        body=Path(body).stem if body.endswith((".yaml", ".yml")) else body,
        seconds=round(motion.enabled_ticks * TICK_S, 2),
        contacts=None if contacts is None else int(contacts),
        distance_m=number("distance_m"),
        min_clearance_m=number("min_clearance_m"),
        commanded=round(_mean(motion.commanded), 4),
        measured=round(_mean(motion.measured), 4),
        latency_ticks=statistics.median(latencies) if latencies else None,
        motions=len(latencies),
        reconnects=motion.state.link.reconnects if motion.state else 0,
        stops=motion.stops,
        driver_cpu=round(100 * statistics.fmean(cpu), 1) if cpu else None,
    )


def _mean(speeds: Sequence[float]) -> float:
    return statistics.fmean(speeds) if speeds else 0.0


class MotionProbe:
    """Compares commands and motion, tick by tick, while the gate is open."""

    def __init__(self, bus: Bus) -> None:
        self.enabled_ticks = self.stops = 0
        self.state: RobotState | None = None
        self.latencies: list[int] = []
        self.driver_cpu: list[float] = []  # share of a core, once a second
        self.commanded: list[float] = []  # [m/s], forward
        self.measured: list[float] = []
        self._command: CmdVel | None = None
        self._begun: dict[str, int | None] = {}  # tick of a command to move, until it is followed
        self._was_moving: dict[str, bool] = {}
        self._open = False
        bus.subscribe(STATE, self._on_state)
        bus.subscribe(CMD_VEL, self._on_command)
        bus.subscribe(HEALTH, self._on_health)

    def _on_health(self, _key: str, health: Health) -> None:
        if self._open and health.process == "driver":
            self.driver_cpu.append(health.cpu)

    def _on_command(self, _key: str, command: CmdVel) -> None:
        self._command = command
        for axis, min_speed in MOTION:
            moves = abs(getattr(command, axis)) >= min_speed
            if moves and not self._was_moving.get(axis, False):
                self._begun[axis] = None if self._moves(axis, min_speed) else command.tick
            elif not moves:
                self._begun[axis] = None
            self._was_moving[axis] = moves

    def _on_state(self, _key: str, state: RobotState) -> None:
        self.state = state
        opened = state.gate.mode == "enabled"
        self.stops += self._open and not opened
        self._open = opened
        if not opened or self._command is None or self._command.boot != state.boot:
            return
        self.enabled_ticks += 1
        self.commanded.append(self._command.linear_x)
        self.measured.append(state.velocity.linear_x)
        for axis, min_speed in MOTION:
            begun = self._begun.get(axis)
            if begun is not None and self._moves(axis, min_speed):
                self.latencies.append(state.tick - begun)
                self._begun[axis] = None

    def _moves(self, axis: str, min_speed: float) -> bool:
        return self.state is not None and abs(getattr(self.state.velocity, axis)) >= min_speed
