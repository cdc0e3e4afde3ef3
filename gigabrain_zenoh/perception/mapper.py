"""Localization and mapping in the perception process: the robot's pose in the map, and the map.

Each scan is processed after its world model is published, with the odometry of the scan's tick.
"""

import asyncio
import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import Body, BodyDescription, Lidar, RobotState
from gigabrain_schemas.brain import OccupancyGrid, PoseInMap, WorldModel
from gigabrain_schemas.requests import MapReply, MapRequest
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import MAP, MAP_LIST, MAP_LOAD, MAP_SAVE, POSE
from gigabrain_schemas.zones import MapListReply, MapListRequest, MapLoadRequest
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.bus.restoring import RestoringPublisher
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.geometry.scan import beams
from gigabrain_zenoh.host.bounded import NewestValues
from gigabrain_zenoh.host.threads import InTime, done
from gigabrain_zenoh.kernels.precompile import ensure_compiled
from gigabrain_zenoh.mapping import map_file, zone_file
from gigabrain_zenoh.mapping.autosave import Autosave, refuse
from gigabrain_zenoh.mapping.keyframes import Scan, View
from gigabrain_zenoh.mapping.localizer import Place
from gigabrain_zenoh.mapping.map_list import saved_maps
from gigabrain_zenoh.mapping.odometry import OdometryFusion, OdometrySample, way
from gigabrain_zenoh.mapping.static_map import RobotMap, StaticMap
from gigabrain_zenoh.mapping.zone_file import ZoneFile
from gigabrain_zenoh.perception.node import LOCALIZE_KERNELS, MAP_KERNELS
from gigabrain_zenoh.perception.pose_hints import PoseHints
from gigabrain_zenoh.perception.zone_server import ZoneServer

if TYPE_CHECKING:
    from gigabrain_zenoh.perception.object_server import ObjectServer  # for cameras only

log = logging.getLogger(__name__)

MAP_TICKS = round(1e9 / TICK_NS)  # shortest interval between published maps
MAP_AGAIN_TICKS = 2 * MAP_TICKS  # interval after which an unchanged map is published again
MAX_FREE_M = 10.0  # maximum distance at which a beam without a hit marks free space,
RANGE_MARGIN_M = 0.05  # which ends this much before the lidar's range
SETTLE_NS, SETTLES = 20_000_000, 100  # poll interval and count: a save waits for idle threads
TIMED_SCANS = 1000  # whose processing times give the percentiles


def chart_of(config: PerceptionConfig, in_time: InTime = done) -> RobotMap:
    """Load or create the map that the settings request. Raises ConfigError."""
    path = map_file.path_of(config.map) if config.map else None
    if config.mapping == "localize":
        if path is None:
            raise ConfigError("perception: map: expected a saved map, as mapping is 'localize'")
        saved = map_file.load(path)
        if problem := map_file.map_problem(saved):
            raise ConfigError(f"{path}: {problem}; expected a map to localize in")
        return StaticMap(saved, in_time=in_time)
    from gigabrain_zenoh.mapping.slam_map import SlamMap  # imports gtsam: for slam only

    if path:
        graph = map_file.load_graph(path)
        try:
            return SlamMap.thaw(graph, in_time=in_time)
        except ConfigError as error:
            raise ConfigError(f"{path.with_suffix(map_file.GRAPH)}: {error}") from None
    return SlamMap(in_time=in_time)


def _loaded(config: PerceptionConfig, in_time: InTime) -> tuple[RobotMap, ZoneFile]:
    """Load a map and its zones. Raises ConfigError."""
    return chart_of(config, in_time), zone_file.load(map_file.path_of(config.map))


def view_of(lidar: Lidar, scan: LaserScan, hits: NDArray[np.floating]) -> View:
    """Return the `hits` (n, 2) of a scan and the ends of free beams, in the body's frame [m]."""
    values = scan.ranges_m
    cosines, sines = beams(len(values), scan.angle_min, scan.angle_increment, lidar.yaw)
    sensor = np.array((lidar.x, lidar.y))
    clear = values == np.inf if lidar.no_return == "free" else np.zeros(len(values), np.bool_)
    reach = min(scan.range_max - RANGE_MARGIN_M, MAX_FREE_M)
    free = sensor + reach * np.column_stack((cosines[clear], sines[clear]))
    return View(Scan.of(hits, free), sensor)


class Mapper:
    """Publisher of `robot/pose` and `robot/map`, and server of `robot/map_save`."""

    def __init__(self, config: PerceptionConfig, bus: Bus, bodies: Latest[Body]) -> None:
        self._config, self._bus, self._bodies = config, bus, bodies
        self._chart = chart_of(config, bus.input_log.in_time)
        self._fusion, self._boot = OdometryFusion(), 0
        self._last: OdometrySample | None = None  # at the last scan that was processed
        self._blank = not config.map  # the map is still empty
        self._mapped = False  # this process has processed a scan, or restored a map
        self._published: OccupancyGrid | None = None
        self._restoring = RestoringPublisher(bus)
        self._checked_tick = self._sent_tick = 0
        self._autosave = self._autosave_of(config)
        self._restored: OdometrySample | None = None  # at the last scan of a restored map
        self._logged_pose, self._skip_reason = "", ""
        self._early = False  # the first scan arrived without its odometry
        self._took_ms = NewestValues(TIMED_SCANS)
        self._saving = asyncio.Lock()  # concurrent saves would write to the same files
        self._zones = ZoneServer(bus, config.state_dir, lambda: self._tick)
        found = zone_file.load(map_file.path_of(config.map)) if config.map else ZoneFile()
        self._zones.use_map(config.map, config.mapping, found, loaded=False)
        self._objects: ObjectServer | None = None  # of a body with cameras
        self._hints = PoseHints(bus, lambda: self._last, lambda why: self._chart.lose(why))
        bus.serve(MAP_SAVE, self._save)
        bus.serve(MAP_LOAD, self._load)
        bus.serve(MAP_LIST, self._list)
        bus.report = self._report

    def process_scan(self, scan: LaserScan, world: WorldModel) -> None:
        """Process a scan and its world. Skip a bad scan, or one whose odometry is missing."""
        if world.scan_problem:
            self._skip(world.scan_problem)
            return
        moment = self._fusion.at(scan.basis) if scan.boot == self._boot else None
        if moment is None and self._last is None and not self._early:
            self._early = True  # its odometry was published before this process subscribed
            self._bus.counters["scans_left_out"] += 1
        elif moment is None or (self._last and moment.tick <= self._last.tick):
            self._skip("no odometry for its tick")
        else:
            self._process(scan, world, moment)

    def skip_future_scan(self, scan: LaserScan, tick: int) -> None:
        """Skip a scan whose state had not arrived by `tick`, when the next scan came."""
        self._skip(f"its tick {scan.basis} is in the future at tick {tick}")

    def close(self) -> None:
        """Stop the worker threads."""
        self._chart.close()
        if self._autosave:
            self._autosave.close()

    async def finish_writing(self) -> None:
        """Wait until zones and objects are written."""
        await self._zones.finish_writing()
        if self._objects:
            await self._objects.finish_writing()

    def add_state(self, state: RobotState) -> None:
        """Add a robot state; must be called before `process_scan` for scans of the same tick."""
        body = self._bodies.current
        if body:
            self._reset_odometry(state.boot, body.description)
            if not state.link.connected:  # its turn rate is that of the last message
                state = replace(state, imu=None)
            self._fusion.add(state, body.description)

    def _autosave_of(self, config: PerceptionConfig) -> Autosave | None:
        saves = config.mapping == "slam" and config.state_dir and self._bus.input_log.live
        return Autosave(Path(config.state_dir)) if saves else None

    @property
    def _tick(self) -> int:
        return self._last.tick if self._last else 0

    def _reset_odometry(self, boot: int, body: BodyDescription) -> None:
        """Reset the odometry when the driver has restarted; the map is kept.

        If this process has restarted and the driver has not, resume the last autosaved map.
        """
        if boot == self._boot:
            return
        if self._boot:
            self._chart.lose("the driver has restarted")
        self._boot, self._fusion, self._last, self._published = boot, OdometryFusion(), None, None
        self._restored, self._early = None, False
        self._hints.clear()
        resumed = not self._mapped and self._bus.input_log.live and self._resume(boot)
        self._zones.set_boot(boot)
        self._start_objects(boot, body, resumed=resumed)

    def _start_objects(self, boot: int, body: BodyDescription, *, resumed: bool) -> None:
        """Start the object memory of a body with cameras, or restart it for a new boot."""
        if self._objects is None and body.cameras:
            from gigabrain_zenoh.perception.object_server import ObjectServer  # as above

            self._objects = ObjectServer(self._bus, self._config.state_dir, lambda: self._fusion)
            self._objects.use_map(self._config.map, self._config.mapping)
            if resumed:
                self._objects.restore(boot)
        if self._objects:
            self._objects.restart(boot)

    def _resume(self, boot: int) -> bool:
        """Resume the map and the zones of an earlier process of this run of the driver.

        Return whether there was a map to resume.
        """
        kept = self._zones.restore(boot)
        if kept and kept.maps_loaded:  # not the map of the settings
            try:
                self._use(replace(self._config, map=kept.map, mapping=kept.mapping), loaded=False)
            except ConfigError as error:
                text = f"map {kept.map!r} is not loaded again: {error}; going on without it"
                log.warning("%s", text, extra={"data": {"event": "map"}})
                if not kept.mapping == self._config.mapping == "slam":
                    return False  # the kept state does not fit the map of the settings
        if self._autosave:
            self._resume_map(self._autosave, boot)
        same_map = bool(self._config.map) and kept and kept.map == self._zones.map
        if kept and (self._mapped or same_map):
            self._zones.resume(kept)
        return self._mapped or bool(same_map)

    def _resume_map(self, autosave: Autosave, boot: int) -> None:
        """Resume the newest intact map that was saved during this run of the driver, if any."""
        from gigabrain_zenoh.mapping.slam_map import SlamMap  # imports gtsam, as above

        for head, arrays in autosave.found(boot):
            last = None if head.place is None else np.array(head.place)
            try:
                in_time = self._bus.input_log.in_time
                chart = SlamMap.thaw(arrays, in_time=in_time, last=last, lost=head.lost)
            except ConfigError as error:
                refuse(str(error))
                continue
            self._chart.close()
            self._chart, self._blank, self._mapped = chart, False, True
            odometry = np.array(head.odometry)
            self._restored = OdometrySample(head.tick, odometry, odometry, slipping=False, jumps=0)
            data = {"event": "map_restored", "map_tick": head.tick}
            log.info("resumed the map of tick %d", head.tick, extra={"data": data})
            return

    def _process(self, scan: LaserScan, world: WorldModel, moment: OdometrySample) -> None:
        body = self._bodies.current
        if body is None or body.description.lidar is None:
            return
        began = time.perf_counter()
        view = view_of(body.description.lidar, scan, world.points())
        before = self._last
        motion = self._motion(moment)
        self._suggest(moment)
        place = self._chart.step(view, *motion)
        self._mapped = True
        if place.localized:
            self._hints.found()
        else:
            self._hints.missed(scan.basis, place.why)
        if self._objects:
            keyframes = self._chart.keyframes()[1]
            seen = self._objects.surroundings(body.description, world, view, keyframes)
            self._objects.at_scan(seen, place, moment)
            if self._published:
                self._objects.publish(scan.basis)
        if self._autosave and before:
            self._autosave_map(self._autosave, before)
        self._bus.publish(POSE, message_of(place), basis=scan.basis)
        self._log_pose(place)
        self._publish_map(scan.basis)
        self._skip_reason = ""
        self._took_ms.add((time.perf_counter() - began) * 1e3)

    def _motion(self, moment: OdometrySample) -> tuple[Floats, Floats]:
        """Return the motion from the last scan to this one (3,), and its covariance (3, 3).

        The first scan of a new map is placed at its odometry pose. After a crash of this process,
        positions in the map thus stay the same, except for the odometry drift since then.
        """
        last = self._last or self._restored or moment
        self._last, self._restored = moment, None
        blank, self._blank = self._blank, False
        step, noise = way(last, moment)
        if last.jumps != moment.jumps:
            self._chart.lose("the odometry has jumped")
        return moment.fused if blank else step, noise

    def _suggest(self, moment: OdometrySample) -> None:
        """Pass the map a hint about the pose, from a tag in the newest picture or from a person."""
        by_tag = self._objects and self._objects.hint()
        if by_tag:
            self._hints.add(*by_tag)
        hint = self._hints.at(moment)
        if hint:
            self._chart.suggest(hint)

    def _autosave_map(self, autosave: Autosave, before: OdometrySample) -> None:
        """Save the map as it was at the scan `before`, when a save is due.

        The snapshot is cheap and does not alter the map. The robot behaves the same without saves.
        """
        snapshot = self._chart.kept()
        if snapshot:
            autosave.save(self._boot, before.tick, before.odometry, snapshot)
        elif autosave.due(self._boot, before.tick):
            self._chart.keep()

    def _publish_map(self, tick: int) -> None:
        """Publish the map when it has changed, at most every MAP_TICKS.

        An unchanged map is published again after MAP_AGAIN_TICKS, in case a receiver missed it. A
        map or zones that another sender has replaced are published again at once.
        """
        self._restoring.restore(basis=tick)
        self._zones.republish(tick)
        if self._published and tick < self._checked_tick + MAP_TICKS:
            return
        self._checked_tick = tick
        self._log_problems()
        grid = self._chart.grid()
        self._zones.follow(*self._chart.keyframes())
        due = grid != self._published or tick >= self._sent_tick + MAP_AGAIN_TICKS
        if grid.cells:
            self._zones.publish(tick)
        if due and grid.cells:
            self._restoring.publish(MAP, grid, basis=tick)
            self._published, self._sent_tick = grid, tick

    def _log_problems(self) -> None:
        """Log each new problem once, and list all current problems in the health messages."""
        problems, known = self._chart.problems(), self._bus.problems
        if self._autosave and self._autosave.problem:
            problems = (*problems, self._autosave.problem)
        problems = (*problems, *self._hints.problems(), *self._zones.problems())
        problems = (*problems, *(self._objects.problems() if self._objects else ()))
        for problem in problems:
            if problem.code not in {one.code for one in known}:
                text = f"{problem.text}: {problem.remedy}"
                log.warning("%s", text, extra={"data": {"event": problem.code}})
        self._bus.problems = problems
        self._bus.counters["optimiser_rebuilt"] = self._chart.report().get("optimiser_rebuilt", 0)

    def _log_pose(self, place: Place) -> None:
        """Log changes of the localization, with the reason when the robot is not localized."""
        text = "localized" if place.localized else f"not localized: {place.why}"
        if text == self._logged_pose:
            return
        self._logged_pose = text
        if place.localized:
            x, y, yaw = place.pose.tolist()
            text = f"{text} at ({x:.2f}, {y:.2f}), {np.degrees(yaw):.0f} degrees"
        level = logging.INFO if place.localized else logging.WARNING
        log.log(level, text, extra={"data": {"event": "localized"}})

    def _skip(self, why: str) -> None:
        self._bus.counters["scans_left_out"] += 1
        if why != self._skip_reason:
            self._skip_reason = why
            log.warning("scan not mapped: %s", why, extra={"data": {"event": "scan"}})

    async def _save(self, request: MapRequest) -> MapReply:
        log_accepted(self._bus, MAP_SAVE.key, request, self._tick)
        path = map_file.saved_map_path(request.name)
        same = bool(self._config.map) and path == map_file.path_of(self._config.map)
        try:
            async with self._saving:
                text = await self._saved(path, replace=request.replace or same, same=same)
        except Refused as error:
            log.warning("map for %s: %s", request.source, error, extra={"data": {"event": "map"}})
            return MapReply(ok=False, text=str(error)[:500])
        self._zones.saved_as(request.name)
        if self._objects:
            self._objects.saved_as(request.name)
        log.info("map by %s: %s", request.source, text, extra={"data": {"event": "map"}})
        return MapReply(ok=True, text=text[:500])

    async def _saved(self, path: Path, *, replace: bool, same: bool) -> str:
        """Save the map; `same` if `path` is the map that it began with. Raises Refused."""
        for _ in range(SETTLES):
            if self._chart.settle():
                break
            await self._bus.clock.sleep_ns(SETTLE_NS)
        snapshot = self._chart.still()  # before zones and objects can move
        self._zones.follow(*self._chart.keyframes())
        zones, objects = zone_file.encoded(self._zones.present), None if same else b""
        if self._objects:
            self._objects.follow(self._chart.keyframes()[1])
            objects = self._objects.encoded()
        saved, graph = await asyncio.to_thread(snapshot.to_save)
        if self._bus.input_log.live:
            await asyncio.to_thread(
                map_file.save, path, saved, graph, replace=replace, zones=zones, objects=objects
            )
        return f"saved {path}: {map_file.in_words(saved)}"

    async def _list(self, _request: MapListRequest) -> MapListReply:
        maps, more = await asyncio.to_thread(saved_maps)
        text = f"{more} more are not listed" if more else ""
        return MapListReply(maps=tuple(maps), present=self._zones.map, text=text)

    async def _load(self, request: MapLoadRequest) -> MapReply:
        config = replace(self._config, map=request.name, mapping=request.mapping)
        try:
            async with self._saving:
                await ensure_compiled(MAP_KERNELS if config.mapping == "slam" else LOCALIZE_KERNELS)
                new = await asyncio.to_thread(_loaded, config, self._bus.input_log.in_time)
        except ConfigError as error:
            text = f"not loaded: {error}"
            log.warning("map for %s: %s", request.source, text, extra={"data": {"event": "map"}})
            return MapReply(ok=False, text=text[:500])
        log_accepted(self._bus, MAP_LOAD.key, request, self._tick)
        self._use(config, new)
        if self._autosave:
            self._autosave.discard()
        text = f"loaded {request.name}; looking for the robot in it"
        log.info("map by %s: %s", request.source, text, extra={"data": {"event": "map"}})
        return MapReply(ok=True, text=text)

    def _use(
        self,
        config: PerceptionConfig,
        new: "tuple[RobotMap, ZoneFile] | None" = None,
        *,
        loaded: bool = True,
    ) -> None:
        """Switch to another map. Raises ConfigError."""
        chart, zones = new or _loaded(config, self._bus.input_log.in_time)
        self._chart.close()
        if self._autosave:
            self._autosave.close()
        self._config, self._chart, self._blank = config, chart, False
        self._autosave, self._published = self._autosave_of(config), None
        self._zones.use_map(config.map, config.mapping, zones, loaded=loaded)
        self._hints.clear()
        if self._objects:
            self._objects.use_map(config.map, config.mapping)

    def _report(self) -> dict[str, float | int | str | None]:
        times = {f"map_ms_p{p}": self._took_ms.percentile(p / 100) for p in (50, 99)}
        saves = self._autosave.report() if self._autosave else {}
        return {**times, **self._chart.report(), **saves}


def message_of(place: Place) -> PoseInMap:
    """Convert a localizer's result to a PoseInMap message."""
    x, y, yaw = place.pose.tolist()
    return PoseInMap(
        x=x,
        y=y,
        yaw=yaw,
        covariance=tuple(place.covariance.ravel().tolist()),
        localized=place.localized,
    )
