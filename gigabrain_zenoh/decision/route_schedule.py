"""Keeps the route of the current command up to date, in a worker thread for large maps."""

import numpy as np

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.decision.behaviours import DriveCommand, NavigationConfig
from gigabrain_zenoh.decision.context import NavigationContext
from gigabrain_zenoh.decision.give_way import Walkers, standing, things
from gigabrain_zenoh.decision.route import Route, RouteFeedback, RoutePlanner, RouteRequest
from gigabrain_zenoh.geometry.se2 import from_pose, transform
from gigabrain_zenoh.host.threads import ScheduledWorker, Take
from gigabrain_zenoh.navigation.contours import placed
from gigabrain_zenoh.navigation.zones import ZoneMap

SMALL_MAP_CELLS = 60_000  # routes in larger maps are planned in a worker thread
MIN_DUE_SCANS = 2  # a plan is due after so many scans,
CELLS_PER_SCAN = 250_000  # and one more per so many cells
HUNG_SCANS = 200  # a plan that is overdue for so many scans will never finish
PATIENCE_S = 0.05  # a scan waits so long for a due plan; control does not wait longer
REPLAN_TICKS = 25  # a route is checked at least twice a second,
LOOK_TICKS = 10  # and more often while searching, as it depends on what cameras see


class RouteSchedule:
    """Plans and replans the current route."""

    def __init__(self, config: NavigationConfig, bus: Bus) -> None:
        self.inflation = config.inflation  # [m], of the next plan
        self._planner = RoutePlanner(config.unknown_space)
        self._worker = ScheduledWorker(PATIENCE_S, bus.input_log.in_time)
        self.route: Route | None = None
        self._planned: tuple[int, OccupancyGrid, ZoneMap] | None = None  # inputs of the last plan
        self._feedback: RouteFeedback | None = None
        self._walkers = Walkers()
        self._not_followed = False  # there was a route in the last step, but it was not followed
        self._counted = (0, 0)  # boot and tick up to which `_held_ticks` is counted
        self._held_ticks = 0  # since the last request

    def at_scan(self) -> None:
        """Take the route from the worker thread if it is due at this scan."""
        self._worker.at_scan()

    def count_held(self, boot: int, tick: int, held: str) -> None:
        """Count the ticks since the last call in which the body did not follow its route."""
        counted_boot, counted = self._counted
        if boot != counted_boot:
            counted, self._held_ticks = tick, 0
        if held or self._not_followed:
            self._held_ticks += max(0, tick - counted)
        self._counted = boot, max(tick, counted)

    def report(self, feedback: RouteFeedback | None) -> None:
        """Record how the current route was followed in this step; None if it was not."""
        self._feedback = feedback or self._feedback
        route = self.route
        self._not_followed = feedback is None and route is not None and route.points is not None

    def watch(self, context: NavigationContext) -> None:
        """Track walking people; called at each scan, also while the robot stands."""
        if context.world and context.map_from_odom:
            self._walkers.update(context.tick, context.world.obstacles, context.map_from_odom)

    def request(
        self,
        context: NavigationContext,
        here: Pose,
        command: DriveCommand,
        grid: OccupancyGrid,
        zones: ZoneMap,
    ) -> None:
        """Plan a route if one is due; in a large map it replaces `route` at a later scan."""
        assert context.world
        assert context.body
        cells = grid.width * grid.height
        scans = MIN_DUE_SCANS + cells // CELLS_PER_SCAN
        if not self._worker.idle:  # maybe with an older, larger map
            self._worker.hasten(scans)
            return
        if not self._due(command, context.tick, grid, zones):
            return
        self._planned = context.tick, grid, zones
        feedback, self._feedback = self._feedback, None
        seen = transform(from_pose(here), context.world.points().astype(np.float64))
        people = standing(self._walkers.ways, seen)
        request = RouteRequest(
            tick=context.tick,
            command=command,
            here=here,
            grid=grid,
            body=context.body,
            feedback=feedback,
            seen=seen,
            contours=things(placed(context.world.contours, here), people),
            walkers=self._walkers.ways,
            zones=zones,
            inflation=self.inflation,
            held_ticks=self._held_ticks,
            slowed_by=context.slowed_by,
        )
        self._held_ticks = 0
        car = context.body.drive_type == "ackermann"  # poses take longer to plan than places
        if cells <= SMALL_MAP_CELLS and not car:
            self.route = self._planner.plan(request)
        else:
            self._worker.start(lambda: self._plan(request), scans)

    def close(self) -> None:
        """Stop the worker thread."""
        self._worker.close()

    @property
    def hung(self) -> bool:
        """Return whether the plan in the worker thread will never finish."""
        return self._worker.overdue > HUNG_SCANS

    def _plan(self, request: RouteRequest) -> Take:
        """Plan in the worker thread; return a function that installs the route."""
        route = self._planner.plan(request)

        def take() -> None:
            self.route = route

        return take

    def _due(self, command: DriveCommand, tick: int, grid: OccupancyGrid, zones: ZoneMap) -> bool:
        route = self.route
        if route is None or self._planned is None or route.number != command.number:
            return True
        planned_tick, planned_grid, planned_zones = self._planned
        if self._feedback and self._feedback.arrived and self._feedback.version == route.version:
            return True
        changed = grid is not planned_grid or zones is not planned_zones
        limit = LOOK_TICKS if command.kind == "look" else REPLAN_TICKS
        return changed or not 0 <= tick - planned_tick < limit
