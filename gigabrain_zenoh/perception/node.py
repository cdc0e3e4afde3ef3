"""Perception node: turns each scan into a world model, and checks whether the scan is plausible."""

import asyncio
import math
from collections.abc import Callable
from contextlib import AsyncExitStack, closing
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats, hits_bytes
from gigabrain_schemas.base import TICK_S, Pose
from gigabrain_schemas.body import Body, BodyDescription, RobotState
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY, SCAN, STATE, WORLD
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.geometry.pose import PlacedScans
from gigabrain_zenoh.geometry.scan import EDGE, blind_ahead, hits, scan_problem
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.kernels.precompile import Kernels
from gigabrain_zenoh.perception.obstacle_tracker import ObstacleTracker
from gigabrain_zenoh.runtime.heartbeat import Progress

if TYPE_CHECKING:
    from gigabrain_zenoh.perception.camera_contours import CameraContours
    from gigabrain_zenoh.perception.mapper import Mapper

MAP_KERNELS = "gigabrain_zenoh.mapping.slam_map:warm_up"  # calls each kernel once, to compile it
LOCALIZE_KERNELS = "gigabrain_zenoh.mapping.static_map:warm_up"


def step(config: PerceptionConfig, body: BodyDescription, scan: LaserScan) -> WorldModel:
    """Convert one scan to a world model, with numpy only (about 65 µs for 360 beams)."""
    lidar = body.lidar
    if lidar is None:
        return _unknown("the body has no lidar")
    values = scan.ranges_m
    problem = scan_problem(lidar, values, config.ignore_below)
    problem = problem or blind_ahead(lidar, scan, config.ignore_below, config.sector_deg)
    if problem:
        return _unknown(problem)
    x, y = hits(lidar, scan, config.ignore_below)
    squares, bearings = x * x + y * y, np.arctan2(y, x)
    ahead = squares[_ahead(config, body, x, y, squares, bearings)]
    return WorldModel(
        scan_ok=True,
        obstacle_ahead=ahead.size > 0,
        distance_ahead=math.sqrt(ahead.min()) if ahead.size else None,
        sectors=_nearest_per_sector(config.sectors, squares, bearings),
        hits=b"" if config.mapping == "off" else hits_bytes(x, y),
    )


@lru_cache(maxsize=8)
def _reach(footprint: tuple[tuple[float, float], ...]) -> tuple[float, float]:
    """Return the footprint's extent ahead, and its radius when turning on the spot [m]."""
    return max(x for x, _ in footprint), max(math.hypot(x, y) for x, y in footprint)


def _ahead(
    config: PerceptionConfig,
    body: BodyDescription,
    x: Floats,
    y: Floats,
    squares: Floats,
    bearings: Floats,
) -> NDArray[np.bool_]:
    """Return the mask of hits in the cone ahead, or in the strip needed to drive on and turn.

    `squares` are the squared distances [m2]; only the nearest hit needs a square root.
    """
    half_angle = math.radians(config.sector_deg) / 2 + EDGE
    cone = (np.abs(bearings) <= half_angle) & (squares <= (config.ahead + EDGE) ** 2)
    front, radius = _reach(body.footprint)
    strip = (x > 0) & (x <= front + config.corridor) & (np.abs(y) <= radius + config.turning_room)
    return cone | strip


def _nearest_per_sector(count: int, squares: Floats, bearings: Floats) -> tuple[float | None, ...]:
    # shifted by a whole turn to be positive, so that truncation rounds down
    index = (bearings * (count / math.tau) + (count + 0.5 + EDGE)).astype(np.intp) % count
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, index, squares)
    return tuple(math.sqrt(d) if d < math.inf else None for d in nearest.tolist())


def _unknown(problem: str) -> WorldModel:
    return WorldModel(scan_ok=False, scan_problem=problem, obstacle_ahead=True)


class WorldPublisher:
    """Publishes a world for each scan, and the newest one again with new camera contours."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.cameras: CameraContours | None = None  # imported only for bodies with cameras
        self.on_state: Callable[[RobotState], object] = id  # called if there are cameras
        self._description: BodyDescription | None = None
        self._newest: tuple[WorldModel, Pose | None] | None = None
        self.body = bus.latest(BODY, self._on_body)

    def close(self) -> None:
        """Stop the thread that processes pictures."""
        if self.cameras:
            self.cameras.close()
            self.cameras = None

    def publish(self, world: WorldModel, pose: Pose | None, basis: int) -> WorldModel:
        """Publish the world of a scan, taken where the body was at `pose` in the odometry."""
        world = replace(world, tick=self._bus.time.tick, basis=basis)
        world = self._publish(world, pose)
        self._newest = world, pose
        return world

    def _publish(self, world: WorldModel, pose: Pose | None) -> WorldModel:
        if self.cameras:
            contours = self.cameras.contours(pose, world.basis)
            statuses = self.cameras.statuses(self._bus.time.tick)
            world = replace(world, contours=contours, cameras=statuses)
        return self._bus.publish(WORLD, world, basis=world.basis, tick=world.tick)

    def _on_contours(self) -> None:
        """Publish the newest world again, unless its scan is old."""
        time, body = self._bus.time, self.body.current
        if self._newest and body:
            world, pose = self._newest
            age_s = (time.tick - world.basis) * TICK_S
            limit_s = scan_limit_ns(body.description) / 1e9
            if world.boot == time.boot and age_s <= limit_s:
                self._publish(world, pose)

    def _on_body(self, body: Body) -> None:
        description = body.description
        if description == self._description:
            return
        self.close()
        self._description, self._newest = description, None
        if description.fixed_cameras:
            from gigabrain_zenoh.perception.camera_contours import CameraContours

            self.cameras = CameraContours(self._bus, description, self._on_contours, self._on_state)

    def _on_state(self, state: RobotState) -> None:
        self.on_state(state)


async def run(config: PerceptionConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Publish a world model as soon as each scan arrives, until the process ends."""
    worlds = WorldPublisher(bus)
    body = worlds.body
    needs = (SCAN.key,) if config.mapping == "off" else (SCAN.key, STATE.key)

    def received() -> tuple[object, ...]:
        return tuple(map(bus.arrived.get, needs)) if body.current else ()

    bus.progress = Progress(received, lambda: bus.sent[WORLD.key])
    with closing(worlds):
        if config.mapping == "off":
            _follow(config, bus, worlds)
            ready()
            await bus.failed
            return
        await _run_with_maps(config, bus, worlds, ready)


async def _run_with_maps(
    config: PerceptionConfig, bus: Bus, worlds: WorldPublisher, ready: Callable[[], None]
) -> None:
    maps = config.mapping == "slam"
    kernels = Kernels(MAP_KERNELS if maps else LOCALIZE_KERNELS, bus.input_log.in_time)
    # a saved map is checked before the robot drives by it
    await kernels.load(wait=config.compile_first or bool(config.map) or not bus.input_log.live)
    async with AsyncExitStack() as stack:
        stack.push_async_callback(kernels.close)

        @cache
        def mapper() -> "Mapper":
            from gigabrain_zenoh.perception.mapper import Mapper  # imports numba: for maps only

            new = stack.enter_context(closing(Mapper(config, bus, worlds.body)))
            stack.push_async_callback(new.finish_writing)
            return new

        if not kernels.beside:
            mapper()
        _follow_odometry(config, bus, worlds, kernels, mapper)
        ready()
        await asyncio.gather(bus.failed, kernels.finish())


def _follow(config: PerceptionConfig, bus: Bus, worlds: WorldPublisher) -> None:
    """Publish world models without odometry, unless cameras need it."""

    def on_scan(scan: LaserScan, pose: Pose | None) -> None:
        body = worlds.body.current
        if body:
            worlds.publish(step(config, body.description, scan), pose, scan.basis)

    placed = PlacedScans(on_scan, lambda scan: on_scan(scan, None))
    worlds.on_state = placed.state
    bus.latest(SCAN, lambda scan: placed.scan(scan) if worlds.cameras else on_scan(scan, None))


def _follow_odometry(
    config: PerceptionConfig,
    bus: Bus,
    worlds: WorldPublisher,
    kernels: Kernels,
    make_mapper: "Callable[[], Mapper]",
) -> None:
    """Publish world models with obstacles placed by odometry; then pass each scan to the mapper.

    The mapper starts at the first state after its kernels are loaded.
    """
    tracker = ObstacleTracker()
    mapper: Mapper | None = None

    def on_scan(scan: LaserScan, pose: Pose | None) -> None:
        body = worlds.body.current
        if body:
            world = step(config, body.description, scan)
            world = tracker.add_obstacles(world, body.description.lidar, scan, pose)
            world = worlds.publish(world, pose, scan.basis)
            if mapper:
                mapper.process_scan(scan, world)

    def on_state(state: RobotState) -> None:
        nonlocal mapper
        if mapper is None and kernels.loaded:
            mapper = make_mapper()
        if mapper:
            mapper.add_state(state)
        placed.state(state)

    def skip(scan: LaserScan) -> None:
        if mapper:
            mapper.skip_future_scan(scan, bus.time.tick)

    placed = PlacedScans(on_scan, skip)
    bus.latest(STATE, on_state)
    bus.latest(SCAN, placed.scan)
