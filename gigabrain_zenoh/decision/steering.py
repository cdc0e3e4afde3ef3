"""Localization and routing for decision: the robot's pose in the map, and a route for each order.

The import takes long; until it is done, `navigating` already serves goals.
"""

import asyncio
from collections import deque

import numpy as np
from msgspec.structs import asdict, replace

from gigabrain_schemas.arrays import hits
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel, OccupancyGrid, PoseInMap, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import BODY, MAP, POSE, STATE, command_topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.behaviours import Behaviour, Situation, must_charge
from gigabrain_zenoh.decision.behaviours.bearings import Bearings, Driven, Route
from gigabrain_zenoh.decision.behaviours.guide import Asked, Guide
from gigabrain_zenoh.decision.behaviours.navigate import Navigate, moved
from gigabrain_zenoh.decision.lateness import Lateness
from gigabrain_zenoh.decision.response import ResponseEstimator, velocity_of
from gigabrain_zenoh.decision.tasks.orders import Order, Outcome
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.limits import clamp, limits_of
from gigabrain_zenoh.geometry.planar import compose, inverse
from gigabrain_zenoh.geometry.pose_history import PoseHistory
from gigabrain_zenoh.host.threads import ScheduledWorker, Take
from gigabrain_zenoh.navigation import local, planner
from gigabrain_zenoh.navigation.moment import Sent

POSE_NS = 1_000_000_000  # maximum age of the last pose in the map
SENT_TICKS = 25  # local planning uses the commands of the last half second
SMALL = 60_000  # cells; routes in larger maps are planned in a worker thread,
LARGE = 250_000  # every this many cells add one scan until a plan is due
DUE_SCANS = 2  # scans until a plan is due, at least
HUNG_SCANS = 200  # a plan that is overdue for this many scans will never finish
PATIENCE_S = 0.05  # how long a scan waits for a due plan; control waits no longer
AGAIN_TICKS = 25  # a route is checked at least twice a second
OPERATOR_HOLDS = "an operator holds the body; `gigabrain enable` hands it back"
NO_MAP = "nobody says yet where in a map the robot is; perception: {mapping: slam} would"

ANY_BODY = BodyDescription(
    robot_type="any", drive_type="differential",
    footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)),
    max_linear_speed=1.0, max_angular_speed=1.0, max_linear_acceleration=1.0,
    max_linear_deceleration=1.0, max_angular_acceleration=1.0,
)  # fmt: skip


class Steering:
    """Tracks the robot's pose in the map, and plans a route for each order."""

    def __init__(self, config: DecisionConfig, bus: Bus) -> None:
        self._bus, self._config = bus, config
        self._response, self._history = ResponseEstimator(), PoseHistory()
        self._states: deque[RobotState] = deque(maxlen=SENT_TICKS)
        self._lateness = Lateness()
        self._places: PreviousTick[PoseInMap] = PreviousTick()
        self._maps: deque[OccupancyGrid] = deque(maxlen=2)
        self._bodies = bus.latest(BODY)
        bus.latest(POSE, self._places.receive)
        bus.latest(MAP, self._maps.append)
        self._hears_commands = False
        self._guide = Guide(config.unknown)
        self._route: Route | None = None
        self._beside = ScheduledWorker(PATIENCE_S, bus.input_log.in_time)
        self._thought: tuple[int, OccupancyGrid] | None = None  # tick and map of the last plan
        self._driven: Driven | None = None
        self._commands: PreviousTick[CmdVel] = PreviousTick()
        self._stands = False  # the behaviour did not follow its route in the last step
        self._counted = (0, 0)  # boot and tick until which `_held_ticks` has counted
        self._held_ticks = 0  # since the last route was requested
        self._here: Pose | None = None
        self._seen = False  # a plausible scan has come since the start
        self._oriented = False  # pose and map have both been known since the start

    def see(self, state: RobotState) -> None:
        """Record a robot state; to be called with every state."""
        self._history = self._history.then(state)
        self._states.append(state)
        self._lateness.sees(state.boot, state.tick)
        self._response.state(state)
        body = self._bodies.current
        if body and not self._hears_commands:
            self._hears_commands = True
            self._bus.subscribe(command_topic(body.description), self._hear_command)

    def _hear_command(self, _key: str, command: CmdVel) -> None:
        """Record a command, clamped as by the gate: the body follows the clamped one."""
        if body := self._bodies.current:
            told = clamp(velocity_of(command), limits_of(body.description))
            self._response.command(replace(command, **asdict(told)))
        if command.source == BRAIN:
            self._commands.receive(command)

    def situation(
        self,
        state: RobotState,
        world: WorldModel | None,
        verdict: SafetyState | None,
        order: Order | None,
        waits: str,
    ) -> Situation:
        """Return the robot's pose, order and route; request a new route where one is due."""
        tick = world.basis if world else state.tick
        if world:
            self._seen = self._seen or world.scan_ok
            self._lateness.thinks(state.tick, tick)
            self._beside.at_scan()
        pose, place = self._history.at(state.boot, tick), self._place(state.boot, tick)
        body = self._bodies.current
        held = self._held(state)
        self._count_held(state.boot, tick, held)
        map_from_odom, lost = place if pose else (None, "the odometry of the scan is missing")
        if world and pose and map_from_odom and body:
            self._here = compose(map_from_odom, pose)
            self._steer(world, map_from_odom, order, body.description, verdict)
        else:
            self._here = None
        bearings = Bearings(
            tick=tick,
            late_ticks=state.tick - tick,
            delayed=self._lateness.seconds,
            velocity=self._velocity(state, tick),
            may_back=verdict is None or verdict.caps.backward != 0.0,
            body=body.description if body else None,
            map_from_odom=map_from_odom,
            lost=lost,
            response=self._response.response,
            sent=tuple(Sent(*one) for one in self._response.sent(tick - SENT_TICKS, tick - 1)),
            order=order,
            route=self._route,
            held=held,
            waits=waits,
        )
        return Situation(world, pose or state.pose, must_charge(verdict), bearings)

    def heed(self, behaviour: Behaviour) -> Outcome | None:
        """Record how far the route was driven, for the guide; return the order's outcome."""
        if not isinstance(behaviour, Navigate):
            return None
        self._driven = behaviour.driven or self._driven
        route = self._route
        self._stands = behaviour.driven is None and route is not None and route.points is not None
        return behaviour.outcome

    def close(self) -> None:
        """Stop the worker thread."""
        self._beside.close()

    @property
    def hung(self) -> bool:
        """Return whether the plan in the worker thread will never finish."""
        return self._beside.overdue > HUNG_SCANS

    @property
    def placed(self) -> bool:
        """Return whether the robot's pose in the map is known."""
        return self._here is not None

    @property
    def waits(self) -> str:
        """Return what start-up waits for; an empty text once pose and map were known."""
        if self._oriented:
            return ""
        if not self._seen:
            return "perception is getting ready"
        _, why = self._place(self._bus.time.boot, self._bus.time.tick)
        return "" if why == NO_MAP else why or "the map is on its way"

    async def way_to(self, goal: Goal) -> str:
        """Return in words how the robot would reach `goal`. Raises Refused, with the reason."""
        grid = self._grid(self._bus.time.boot, self._bus.time.tick + 1)
        body = self._bodies.current
        if grid is None or body is None or self._here is None:
            raise Refused(self.lost)
        # a second guide, as the first may be planning in the worker thread
        guide = Guide(self._config.unknown)
        return await asyncio.to_thread(guide.check, grid, body.description, self._here, goal)

    @property
    def lost(self) -> str:
        """Return why the robot's pose in the map is unknown, or that there is no map."""
        _, why = self._place(self._bus.time.boot, self._bus.time.tick)
        return why or "nobody has sent a map yet; try again"

    def _velocity(self, state: RobotState, tick: int) -> Velocity:
        """Return the speed measured at `tick` or last before it; the newest if none is kept."""
        known = (one for one in reversed(self._states) if one.boot == state.boot)
        return next((one.velocity for one in known if one.tick <= tick), state.velocity)

    def _place(self, boot: int, tick: int) -> tuple[Pose | None, str]:
        """Return the odometry frame's pose in the map, or None and the reason."""
        place = self._places.at(boot, tick, POSE_NS)
        if place is None:
            return None, NO_MAP
        if not place.localized:
            return None, "it is not sure where in the map it is"
        then = self._history.at(boot, place.basis)
        if then is None:
            return None, "the odometry of its last place is missing"
        return compose(Pose(x=place.x, y=place.y, yaw=place.yaw), inverse(then)), ""

    def _grid(self, boot: int, tick: int) -> OccupancyGrid | None:
        """Return the newest map from before `tick`, or from an earlier run of the driver.

        A map is published only when it changes, and stays valid when the driver restarts.
        """
        earlier = (one for one in reversed(self._maps) if one.boot != boot or one.tick < tick)
        return next(earlier, None)

    def _held(self, state: RobotState) -> str:
        """Return in words why the body does not follow decision; an empty text while it does."""
        gate = state.gate
        if gate.mode != "enabled":
            why = "; ".join(cause.text for cause in gate.causes)
            return f"the gate is {gate.mode}{f': {why}' if why else ''}"[:300]
        if gate.commander != BRAIN:
            return f"{gate.commander} has the body"
        command = self._commands.at(state.boot, state.tick, STATE.stale_after_ns)
        return OPERATOR_HOLDS if command and command.operator else ""

    def _count_held(self, boot: int, tick: int, held: str) -> None:
        """Add the ticks since the last call if the body did not follow its route in them."""
        counted_boot, counted = self._counted
        if boot != counted_boot:
            counted, self._held_ticks = tick, 0
        if held or self._stands:
            self._held_ticks += max(0, tick - counted)
        self._counted = boot, max(tick, counted)

    def _steer(
        self,
        world: WorldModel,
        map_from_odom: Pose,
        order: Order | None,
        body: BodyDescription,
        verdict: SafetyState | None,
    ) -> None:
        """Plan a new route where one is due; in large maps this happens in a worker thread."""
        grid = self._grid(world.boot, world.basis)
        self._oriented = self._oriented or grid is not None
        if order is None or grid is None or self._here is None:
            return
        cells = grid.width * grid.height
        scans = DUE_SCANS + cells // LARGE
        if not self._beside.idle:  # maybe with a larger map, which this one has replaced
            self._beside.hasten(scans)
            return
        if not self._due(order, world.basis, grid):
            return
        self._thought, driven, self._driven = (world.basis, grid), self._driven, None
        asked = Asked(
            tick=world.basis,
            order=order,
            here=self._here,
            grid=grid,
            body=body,
            driven=driven,
            seen=moved(self._here, hits(world).astype(np.float64)),
            held_ticks=self._held_ticks,
            slowed_by="; ".join(one.text for one in verdict.causes)[:300] if verdict else "",
        )
        self._held_ticks = 0
        if cells <= SMALL:
            self._route = self._guide.think(asked)
        else:
            self._beside.start(lambda: self._thought_of(asked), scans)

    def _thought_of(self, asked: Asked) -> Take:
        """Plan a route (in the worker thread), and return a function that installs it."""
        route = self._guide.think(asked)

        def take() -> None:
            self._route = route

        return take

    def _due(self, order: Order, tick: int, grid: OccupancyGrid) -> bool:
        """Return whether a new route is needed."""
        if self._route is None or self._thought is None or self._route.number != order.number:
            return True
        before, known = self._thought
        if self._driven and self._driven.arrived and self._driven.version == self._route.version:
            return True
        return grid is not known or not 0 <= tick - before < AGAIN_TICKS


def warm_up() -> None:
    """Call every kernel of planning and driving once, so that it is compiled."""
    planner.warm_up()
    local.warm_up(ANY_BODY)
