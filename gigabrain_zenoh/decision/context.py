"""Inputs of the navigator: poses, map, commands and body, as known at the time of a scan."""

from collections import deque
from dataclasses import dataclass

from msgspec.structs import asdict, replace

from gigabrain_schemas.base import TICK_NS, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import (
    ActuationModel,
    CmdVel,
    JointCommand,
    OccupancyGrid,
    PoseInMap,
    WorldModel,
)
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import BODY, JOINT_CMD, MAP, POSE, STATE, command_topic
from gigabrain_schemas.zones import Zone
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.decision.actuation_model import ActuationEstimator
from gigabrain_zenoh.decision.behaviours import WaitReason, battery_nearly_empty
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.limits import SentCommand, clamp, limits_of
from gigabrain_zenoh.geometry.pose import PoseHistory, compose, inverse, velocity_of

MAX_POSE_AGE_NS = 1_000_000_000
SENT_TICKS = 25  # local planning uses the commands of the last half second
OPERATOR_HOLDS = "an operator drives; `gigabrain enable` lets the brain drive again"
USUAL_LATENCY_TICKS = 2  # from a scan to the first state that follows its intent
LATENCY_MEMORY_TICKS = 100
STOPPED_AHEAD_TICKS = 75  # then the local planner looks for another way out


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationContext:
    """All inputs of one step of the navigator."""

    tick: int  # of the scan
    world: WorldModel | None  # None while perception is silent
    pose: Pose  # in the odometry frame
    must_charge: bool
    late_ticks: int  # age of the scan
    delayed_s: float  # [s], recent latency of intents beyond the usual one
    velocity: Velocity  # measured at the scan
    may_reverse: bool
    stopped_ahead: bool  # safety forbids driving forward, since at least STOPPED_AHEAD_TICKS
    body: BodyDescription | None
    map_from_odom: Pose | None
    lost: WaitReason | None  # why `map_from_odom` is None
    actuation: ActuationModel
    sent: tuple[SentCommand, ...]
    held: str  # reason, shown to users, why the body ignores decision; else empty
    slowed_by: str  # causes that safety reports, shown to users
    zones: tuple[Zone, ...]

    @property
    def here(self) -> Pose | None:
        """The robot's pose in the map, for planning."""
        if self.world is None or self.body is None or self.map_from_odom is None:
            return None
        return compose(self.map_from_odom, self.pose)


class ScanLatency:
    """Measures the latency from scans to their intents in the last two seconds.

    It is measured up to the next state that is processed: states wait while the process computes or
    is not scheduled. In lock-step there is no excess latency.
    """

    def __init__(self) -> None:
        self._boot = 0
        self._pending: tuple[int, int] | None = None  # ticks of the open step and its scan
        self._latencies: deque[tuple[int, int]] = deque()  # tick, and latency [ticks]

    def observe_state(self, boot: int, tick: int) -> None:
        """Record that a state is being processed."""
        if boot != self._boot:
            self._boot, self._pending = boot, None
            self._latencies.clear()
        if self._pending and tick > self._pending[0]:
            self._latencies.append((tick, tick - 1 - self._pending[1]))
            self._pending = None
        while self._latencies and tick - self._latencies[0][0] > LATENCY_MEMORY_TICKS:
            self._latencies.popleft()

    def begin(self, tick: int, basis: int) -> None:
        """Record that the step for the scan of tick `basis` begins at `tick`."""
        self._pending = tick, basis

    @property
    def excess_s(self) -> float:
        """The largest latency beyond the usual one [s], or 0."""
        longest = max((latency for _, latency in self._latencies), default=0)
        return max(0, longest - USUAL_LATENCY_TICKS) * TICK_NS / 1e9


class ContextSource:
    """Collects the navigator's inputs from the bus."""

    def __init__(self, bus: Bus, zones: ZoneSource) -> None:
        self._bus, self._zones = bus, zones
        self._estimator, self._history = ActuationEstimator(), PoseHistory()
        self._states: deque[RobotState] = deque(maxlen=SENT_TICKS)
        self._latency = ScanLatency()
        self._poses: PreviousTick[PoseInMap] = PreviousTick()
        self._maps: deque[OccupancyGrid] = deque(maxlen=2)
        self._commands: PreviousTick[CmdVel] = PreviousTick()
        self._joint_commands: PreviousTick[JointCommand] = PreviousTick()
        self._subscribed_commands = False
        self._stopped_since: int | None = None  # tick; None while safety lets the body advance
        self._bodies = bus.latest(BODY)
        bus.latest(POSE, self._poses.receive)
        bus.latest(MAP, self._maps.append)

    def observe(self, state: RobotState) -> None:
        """Record a robot state; to be called with every state."""
        self._history = self._history.then(state)
        self._states.append(state)
        self._latency.observe_state(state.boot, state.tick)
        self._estimator.add_state(state)
        body = self._bodies.current
        if body and not self._subscribed_commands:
            self._subscribed_commands = True
            if body.description.has_base:
                self._bus.subscribe(command_topic(body.description), self._on_command)
            if body.description.joints:
                self._bus.subscribe(JOINT_CMD, self._on_joint_command)

    def at_scan(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> NavigationContext:
        """Return the inputs at the scan of `world`, or at `state` if `world` is None."""
        tick = world.basis if world else state.tick
        if world:
            self._latency.begin(state.tick, tick)
        pose = self._history.at(state.boot, tick)
        map_from_odom, lost = self._map_from_odom(state.boot, tick)
        if pose is None:
            map_from_odom, lost = None, WaitReason.NO_ODOMETRY_OF_SCAN
        sent = self._estimator.sent(tick - SENT_TICKS, tick - 1)
        if verdict is None or not any(cause.code == "zone_ahead" for cause in verdict.causes):
            self._stopped_since = None
        elif self._stopped_since is None or tick < self._stopped_since:
            self._stopped_since = tick
        return NavigationContext(
            tick=tick,
            world=world,
            pose=pose or state.pose,
            must_charge=battery_nearly_empty(verdict),
            late_ticks=state.tick - tick,
            delayed_s=self._latency.excess_s,
            velocity=self._velocity(state, tick),
            may_reverse=verdict is None or verdict.caps.backward != 0.0,
            stopped_ahead=self._stopped_since is not None
            and tick - self._stopped_since >= STOPPED_AHEAD_TICKS,
            body=self.body,
            map_from_odom=map_from_odom,
            lost=lost,
            actuation=self._estimator.response,
            sent=tuple(SentCommand(*fields) for fields in sent),
            held=self.held(state),
            slowed_by="; ".join(cause.text for cause in verdict.causes)[:300] if verdict else "",
            zones=self._zones.at(state.boot, tick).zones,
        )

    @property
    def body(self) -> BodyDescription | None:
        """The body's description, once received."""
        body = self._bodies.current
        return body.description if body else None

    @property
    def lost(self) -> WaitReason | None:
        """Return why the robot's current pose in the map is unknown; None if it is known."""
        return self._map_from_odom(self._bus.time.boot, self._bus.time.tick)[1]

    def here(self, boot: int, tick: int) -> Pose | None:
        """Return the robot's pose in the map at `tick`; None if it is unknown."""
        map_from_odom, _ = self._map_from_odom(boot, tick)
        pose = self._history.at(boot, tick)
        return compose(map_from_odom, pose) if map_from_odom and pose else None

    def oriented(self, state: RobotState) -> bool:
        """Return whether the map and the robot's pose in it are known."""
        lost = self._map_from_odom(state.boot, state.tick)[1]
        return lost is None and self.grid(state.boot, state.tick) is not None

    def grid(self, boot: int, tick: int) -> OccupancyGrid | None:
        """Return the newest map of before `tick`, or of an earlier start of the driver.

        A map is published only when it changes, and stays valid when the driver restarts.
        """
        earlier = (grid for grid in reversed(self._maps) if grid.boot != boot or grid.tick < tick)
        return next(earlier, None)

    def _on_command(self, _key: str, command: CmdVel) -> None:
        """Record a command, clamped like in the gate: the body follows the clamped one."""
        if body := self.body:
            clamped = clamp(velocity_of(command), limits_of(body))
            self._estimator.add_command(replace(command, **asdict(clamped)))
        if command.source == BRAIN:
            self._commands.receive(command)

    def _velocity(self, state: RobotState, tick: int) -> Velocity:
        """Return the newest velocity measured until `tick`; if none is stored, that of `state`."""
        states = (past for past in reversed(self._states) if past.boot == state.boot)
        return next((past.velocity for past in states if past.tick <= tick), state.velocity)

    def _map_from_odom(self, boot: int, tick: int) -> tuple[Pose | None, WaitReason | None]:
        """Return the odometry frame's pose in the map, or None and the reason."""
        in_map = self._poses.at(boot, tick, MAX_POSE_AGE_NS)
        if in_map is None:
            return None, WaitReason.NO_LOCALIZATION
        if not in_map.localized:
            return None, WaitReason.NOT_LOCALIZED
        in_odom = self._history.at(boot, in_map.basis)
        if in_odom is None:
            return None, WaitReason.NO_ODOMETRY_OF_POSE
        return compose(Pose(x=in_map.x, y=in_map.y, yaw=in_map.yaw), inverse(in_odom)), None

    def held(self, state: RobotState) -> str:
        """Return a reason, shown to users, why the body ignores decision; else an empty text."""
        gate = state.gate
        if gate.mode != "enabled":
            why = "; ".join(cause.text for cause in gate.causes)
            return f"the gate is {gate.mode}{f': {why}' if why else ''}"[:300]
        if gate.commander != BRAIN:
            return f"{gate.commander} drives"
        for commands in (self._commands, self._joint_commands):
            command = commands.at(state.boot, state.tick, STATE.stale_after_ns)
            if command and command.operator:
                return OPERATOR_HOLDS
        return ""

    def _on_joint_command(self, _key: str, command: JointCommand) -> None:
        if command.source == BRAIN:
            self._joint_commands.receive(command)
