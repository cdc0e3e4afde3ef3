"""Where the robot is in its map, and which way it is to take: what decision drives to places by.

It takes a while to import; `navigating` serves goals meanwhile.
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
from gigabrain_zenoh.behaviours import Behaviour, Situation, must_charge
from gigabrain_zenoh.behaviours.bearings import Bearings, Driven, Route
from gigabrain_zenoh.behaviours.guide import Asked, Guide
from gigabrain_zenoh.behaviours.navigate import Navigate, moved
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.earlier import Earlier
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate_state import BRAIN
from gigabrain_zenoh.lateness import Lateness
from gigabrain_zenoh.limits import clamp, limits_of
from gigabrain_zenoh.mapping.background import Background, Take
from gigabrain_zenoh.navigation import local, planner
from gigabrain_zenoh.navigation.moment import Sent
from gigabrain_zenoh.planar import compose, inverse
from gigabrain_zenoh.pose_history import PoseHistory
from gigabrain_zenoh.response import ResponseEstimator, velocity_of
from gigabrain_zenoh.settings import DecisionConfig
from gigabrain_zenoh.tasks.orders import Order, Outcome

POSE_NS = 1_000_000_000  # so old may be what was last heard of the place
SENT_TICKS = 25  # commands of the last half second are planned with
SMALL = 60_000  # cells; plans in larger maps are made in a thread,
LARGE = 250_000  # and for each so many cells it may take a scan more than
DUE_SCANS = 2
HUNG_SCANS = 200  # a plan that is overdue for so many never ends
PATIENCE_S = 0.05  # how long a scan waits for a plan that is due: control waits for no more
AGAIN_TICKS = 25  # a route is looked at twice a second, whatever happens
OPERATOR_HOLDS = "an operator holds the body; `gigabrain enable` hands it back"
NO_MAP = "nobody says yet where in a map the robot is; perception: {mapping: slam} would"

ANY_BODY = BodyDescription(
    robot_type="any", drive_type="differential",
    footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)),
    max_linear_speed=1.0, max_angular_speed=1.0, max_linear_acceleration=1.0,
    max_linear_deceleration=1.0, max_angular_acceleration=1.0,
)  # fmt: skip


class Steering:
    """The robot's place, and a route for each order."""

    def __init__(self, config: DecisionConfig, bus: Bus) -> None:
        self._bus, self._config = bus, config
        self._response, self._history = ResponseEstimator(), PoseHistory()
        self._states: deque[RobotState] = deque(maxlen=SENT_TICKS)
        self._lateness = Lateness()
        self._places: Earlier[PoseInMap] = Earlier()
        self._maps: deque[OccupancyGrid] = deque(maxlen=2)
        self._bodies = bus.latest(BODY)
        bus.latest(POSE, self._places.receive)
        bus.latest(MAP, self._maps.append)
        self._hears_commands = False
        self._guide = Guide(config.unknown)
        self._route: Route | None = None
        self._beside = Background(PATIENCE_S, bus.journal.in_time)
        self._thought: tuple[int, OccupancyGrid] | None = None  # when, and about which map
        self._driven: Driven | None = None
        self._commands: Earlier[CmdVel] = Earlier()
        self._stands = False  # the behaviour did not follow its route in the last step
        self._counted = (0, 0)  # boot and tick until which `_held_ticks` has counted
        self._held_ticks = 0  # since the last route was asked for
        self._here: Pose | None = None
        self._seen = False  # a scan that can be believed, since the start
        self._oriented = False  # it has known its place and a map since the start

    def see(self, state: RobotState) -> None:
        """Take note of each state."""
        self._history = self._history.then(state)
        self._states.append(state)
        self._lateness.sees(state.boot, state.tick)
        self._response.state(state)
        body = self._bodies.current
        if body and not self._hears_commands:
            self._hears_commands = True
            self._bus.subscribe(command_topic(body.description), self._hear_command)

    def _hear_command(self, _key: str, command: CmdVel) -> None:
        """What the gate would make of it is what the body answers."""
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
        """Where the robot is, what it is to do, and which way."""
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
        """What became of the route goes to the guide; what became of the order is handed back."""
        if not isinstance(behaviour, Navigate):
            return None
        self._driven = behaviour.driven or self._driven
        route = self._route
        self._stands = behaviour.driven is None and route is not None and route.points is not None
        return behaviour.outcome

    def close(self) -> None:
        """End what runs beside."""
        self._beside.close()

    @property
    def hung(self) -> bool:
        """Whether the plan in the making never ends."""
        return self._beside.overdue > HUNG_SCANS

    @property
    def placed(self) -> bool:
        """Whether it knows where in the map the robot is."""
        return self._here is not None

    @property
    def waits(self) -> str:
        """What there is to wait for at the start, until place and map are known; or nothing."""
        if self._oriented:
            return ""
        if not self._seen:
            return "perception is getting ready"
        _, why = self._place(self._bus.time.boot, self._bus.time.tick)
        return "" if why == NO_MAP else why or "the map is on its way"

    async def way_to(self, goal: Goal) -> str:
        """How it would get there, in words. Raises Refused, and why."""
        grid = self._grid(self._bus.time.boot, self._bus.time.tick + 1)
        body = self._bodies.current
        if grid is None or body is None or self._here is None:
            raise Refused(self.lost)
        # beside whatever the guide is at: it has a memory of its own
        guide = Guide(self._config.unknown)
        return await asyncio.to_thread(guide.check, grid, body.description, self._here, goal)

    @property
    def lost(self) -> str:
        """Why it does not know where in the map the robot is, or has no map."""
        _, why = self._place(self._bus.time.boot, self._bus.time.tick)
        return why or "nobody has sent a map yet; try again"

    def _velocity(self, state: RobotState, tick: int) -> Velocity:
        """The speed measured at a tick, or last before it; of a scan long past, the newest."""
        known = (one for one in reversed(self._states) if one.boot == state.boot)
        return next((one.velocity for one in known if one.tick <= tick), state.velocity)

    def _place(self, boot: int, tick: int) -> tuple[Pose | None, str]:
        """The odometry's frame in the map, or why that is not known."""
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
        """The newest map of before a tick: it is sent when it changes, and outlives the driver."""
        earlier = (one for one in reversed(self._maps) if one.boot != boot or one.tick < tick)
        return next(earlier, None)

    def _held(self, state: RobotState) -> str:
        """Why the body does not follow decision now, in words; empty while it does."""
        gate = state.gate
        if gate.mode != "enabled":
            why = "; ".join(cause.text for cause in gate.causes)
            return f"the gate is {gate.mode}{f': {why}' if why else ''}"[:300]
        if gate.commander != BRAIN:
            return f"{gate.commander} has the body"
        command = self._commands.at(state.boot, state.tick, STATE.stale_after_ns)
        return OPERATOR_HOLDS if command and command.operator else ""

    def _count_held(self, boot: int, tick: int, held: str) -> None:
        """Count the ticks in which the body did not follow the route."""
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
        """Have a route thought of where one is due."""
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
        """In a thread of its own: the route, and what makes it count."""
        route = self._guide.think(asked)

        def take() -> None:
            self._route = route

        return take

    def _due(self, order: Order, tick: int, grid: OccupancyGrid) -> bool:
        """Whether a new route is wanted."""
        if self._route is None or self._thought is None or self._route.number != order.number:
            return True
        before, known = self._thought
        if self._driven and self._driven.arrived and self._driven.version == self._route.version:
            return True
        return grid is not known or not 0 <= tick - before < AGAIN_TICKS


def warm_up() -> None:
    """Call every kernel of planning and driving once."""
    planner.warm_up()
    local.warm_up(ANY_BODY)
