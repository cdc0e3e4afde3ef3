"""Serves the memory of objects and tags: adds detections, publishes, saves and forgets.

Only bodies with cameras need it. Pictures are processed at the next scan, with the odometry of
their exposure, so that the work per scan is bounded.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, TICK_S, Cause, Count, Finite, Name
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.objects import (
    Detections,
    MapObject,
    MapTag,
    ObjectMap,
    ObjectsReply,
    ObjectsRequest,
)
from gigabrain_schemas.topics import DETECTIONS, OBJECT_MAP, OBJECTS_CHANGE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.bus.restoring import RestoringPublisher
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config.settings import MappingMode
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.geometry.se2 import between, compose
from gigabrain_zenoh.host.files import make_folder, read_bounded, replace_file
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.mapping import map_file, object_file
from gigabrain_zenoh.mapping.keyframes import View
from gigabrain_zenoh.mapping.localizer import Place
from gigabrain_zenoh.mapping.object_file import ObjectFile
from gigabrain_zenoh.mapping.odometry import OdometryFusion, OdometrySample
from gigabrain_zenoh.mapping.pose_hint import PoseHint
from gigabrain_zenoh.perception.object_memory import Anchor, Glance, ObjectMemory
from gigabrain_zenoh.perception.surroundings import Surroundings
from gigabrain_zenoh.perception.tag_memory import TagMemory

log = logging.getLogger(__name__)

MAX_WAITING = 4  # pictures that wait for the next scan; older ones are dropped
MAX_FUTURE_TICKS = 50  # by which a picture may be ahead of the odometry
CHANGED_TICKS = round(0.6e9 / TICK_NS)  # minimum interval between changed object maps,
REPUBLISH_TICKS = round(2e9 / TICK_NS)  # and maximum interval between unchanged ones
COPY_TICKS = round(2e9 / TICK_NS)  # between copies, which are restored when the robot is lost
SAVE_TICKS = round(5e9 / TICK_NS)  # minimum interval between writes
RECOGNIZING_TICKS = round(3e9 / TICK_NS)  # maximum age of the last detections while recognizing
STEADY_RAD_S, RATE_TICKS = 0.8, 5  # faster turns blur pictures; ticks to measure the rate
MIN_SHIFT_M = 0.01  # smaller shifts of an object are not published at once
UNSAVED = "objects are not saved"
STATE_FILE, MAX_STATE_BYTES = "objects.json", 1_000_000


class KeptAnchor(Struct, frozen=True):
    """The keyframe that an object moves with, and its pose then."""

    keyframe: Count
    x: Finite
    y: Finite
    yaw: Finite


class KeptObject(Struct, frozen=True):
    """An object, and its anchor in a growing map."""

    object: MapObject
    anchor: KeptAnchor | None = None


class KeptTag(Struct, frozen=True):
    """A tag, and its anchor in a growing map."""

    tag: MapTag
    anchor: KeptAnchor | None = None


class ObjectState(Struct, frozen=True, kw_only=True):
    """The state for the next perception process."""

    boot: Count  # start of the driver that it belongs to
    map: Name = ""
    objects: tuple[KeptObject, ...] = ()
    tags: tuple[KeptTag, ...] = ()


Write = tuple[ObjectState, Path | None, ObjectFile]  # and the map's file for the latter, if any
Copy = tuple[list[tuple[MapObject, Anchor | None]], list[tuple[MapTag, Anchor | None]]]


class ObjectServer:
    """Publisher of `robot/objects`, and server of `robot/objects_change`."""

    def __init__(self, bus: Bus, state_dir: str, fusion: Callable[[], OdometryFusion]) -> None:
        self._bus, self._fusion = bus, fusion
        self._state_path = Path(state_dir) / STATE_FILE if state_dir else None
        self.memory, self.tags = ObjectMemory(), TagMemory()
        self._waiting: deque[Detections] = deque(maxlen=MAX_WAITING)
        self._boot = self._tick = 0
        self._seen_tick: int | None = None  # of the last detections
        self._published = ObjectMap()
        self._restoring = RestoringPublisher(bus)
        self._sent_tick: int | None = None
        self._newest_ticks: dict[str, int] = {}  # tick of the newest picture, by camera
        self._copies: deque[Copy] = deque(maxlen=2)  # the older one is 2 to 4 s old
        self._copied_tick = 0
        self._map = ""  # in use
        self._file: Path | None = None  # where its objects are written
        self._saved: ObjectMap | None = ObjectMap()  # the newest one written; None if that failed
        self._saved_tick = 0
        self.problem = ""
        self._writer: BackgroundWriter[Write] = BackgroundWriter(self._write, 1)
        bus.subscribe(DETECTIONS, self._receive)
        bus.serve(OBJECTS_CHANGE, self._change)

    def use_map(self, name: str, mapping: MappingMode) -> None:
        """Use the objects of a map. A file that cannot be read is not overwritten."""
        self.memory.clear()
        self.tags.clear()
        self._copies.clear()
        path = map_file.path_of(name) if name else None
        self._map = name if len(name) <= 64 and "/" not in name else Path(name).stem[:64]
        # a growing map differs from its file
        self._file = path if mapping == "localize" else None
        self.problem, self._sent_tick, found = "", None, ObjectFile()
        try:
            found = object_file.load(path) if path else found
        except ConfigError as error:
            self._file = None
            self.problem = f"the map's objects are not used: {error}"
        self.memory.restore([(one, None) for one in found.objects])
        self.tags.restore([(one, None) for one in found.tags])
        self._keep_state()

    def saved_as(self, name: str) -> None:
        """Set the name of the map, which was saved with these objects."""
        self._map, self._sent_tick = name, None
        self._keep_state()

    def restore(self, boot: int) -> None:
        """Restore the state of an earlier process, if it belongs to this start of the driver.

        The map must be the same. It may have got a name since.
        """
        if self._state_path is None or not self._bus.input_log.live:
            return
        try:
            data = read_bounded(self._state_path, MAX_STATE_BYTES)
            found = msgspec.json.decode(data, type=ObjectState)
        except FileNotFoundError:
            return
        except (OSError, ConfigError, *DECODE_ERRORS) as error:
            log.warning("%s: %s", self._state_path, error, extra={"data": {"event": "objects"}})
            return
        if found.boot == boot:
            self._map = found.map
            self.memory.restore([(one.object, _anchor(one.anchor)) for one in found.objects])
            self.tags.restore([(one.tag, _anchor(one.anchor)) for one in found.tags])

    def restart(self, boot: int) -> None:
        """Prepare for another start of the driver, as ticks and odometry restart."""
        self._boot, self._tick = boot, 0
        self._waiting.clear()
        self._seen_tick = self._sent_tick = None
        self._saved_tick = self._copied_tick = 0
        self._newest_ticks.clear()
        if self._copies:
            self._go_back()
        self.memory.restart()
        self.tags.restart()
        self._keep_state()

    def hint(self) -> tuple[PoseHint, OdometrySample] | None:
        """Return a pose hint by the tags in a waiting picture, and the odometry at its exposure."""
        for picture in reversed(self._waiting):
            sample = self._fusion().at(picture.basis)
            found = self.tags.hint(picture.tags) if sample else None
            if sample and found:
                return found, sample
        return None

    def surroundings(
        self, body: BodyDescription, world: WorldModel, view: View, keyframes: Floats
    ) -> Surroundings:
        """Return the surroundings at a scan, for `at_scan`."""
        return Surroundings(body, world, view.scan.points.astype(np.float64), keyframes)

    def at_scan(self, seen: Surroundings, place: Place, moment: OdometrySample) -> None:
        """Process the waiting pictures. The robot was at `place` at the scan of `moment`."""
        self._tick = moment.tick
        if not place.localized:
            self._go_back()
        self.follow(seen.keyframes)
        for picture in self._take_ready():
            self._process(picture, seen, place, moment)
        self.follow(seen.keyframes)
        if place.localized and not 0 <= moment.tick - self._copied_tick < COPY_TICKS:
            self._copied_tick = moment.tick
            self._copies.append((self.memory.anchored(), self.tags.anchored()))

    def follow(self, keyframes: Floats) -> None:
        """Move objects and tags with their keyframes (n, 3)."""
        self.memory.follow(keyframes)
        self.tags.follow(keyframes)

    def publish(self, tick: int) -> None:
        """Publish and save the objects if they are due at this tick, or were replaced."""
        self._restoring.restore(basis=tick)
        since = REPUBLISH_TICKS if self._sent_tick is None else tick - self._sent_tick
        if 0 <= since < CHANGED_TICKS:
            return
        seen = self._seen_tick
        now = ObjectMap(
            objects=self.memory.objects()[: object_file.MAX_OBJECTS],
            tags=self.tags.tags()[: object_file.MAX_OBJECTS],
            map=self._map,
            recognizing=seen is not None and 0 <= tick - seen <= RECOGNIZING_TICKS,
        )
        if 0 <= since < REPUBLISH_TICKS and _nearly_equal(now, self._published):
            return
        self._published = self._restoring.publish(OBJECT_MAP, now, basis=tick)
        self._sent_tick = tick
        self._keep(tick)

    def encoded(self) -> bytes:
        """Return the content of the file beside a map."""
        return object_file.encoded(self.present)

    @property
    def present(self) -> ObjectFile:
        """The objects and tags that do not move by themselves, in the current map."""
        return ObjectFile(
            objects=tuple(one for one, _ in self.memory.anchored())[: object_file.MAX_OBJECTS],
            tags=self.tags.tags()[: object_file.MAX_OBJECTS],
        )

    def problems(self) -> tuple[Cause, ...]:
        """Return the cause if objects cannot be loaded or saved."""
        if not self.problem:
            return ()
        remedy = "remove the damaged file, and load the map again"
        if self.problem.startswith(UNSAVED):  # loading the map again would discard newer objects
            remedy = "make room on the disk; it is tried again every few seconds"
        return (Cause(code="objects_unsaved", text=self.problem[:500], remedy=remedy),)

    async def finish_writing(self) -> None:
        """Wait until everything is written."""
        if self._tick:
            self._keep(self._tick + SAVE_TICKS)
        await self._writer.close()

    def _receive(self, _key: str, picture: Detections) -> None:
        if picture.boot != self._boot or len(self._waiting) == MAX_WAITING:
            self._bus.counters["detections_left_out"] += 1
        if picture.boot == self._boot:
            self._waiting.append(picture)

    def _take_ready(self) -> list[Detections]:
        """Take out the pictures whose odometry is known. Drop those that can never be placed."""
        newest = self._fusion().newest
        ready, later = [], []
        for one in self._waiting:
            if newest and one.basis <= newest.tick:
                ready.append(one)
            elif newest and one.basis <= newest.tick + MAX_FUTURE_TICKS:
                later.append(one)
            else:
                self._bus.counters["detections_left_out"] += 1
        self._waiting.clear()
        self._waiting.extend(later)
        return ready

    def _process(
        self, picture: Detections, seen: Surroundings, place: Place, moment: OdometrySample
    ) -> None:
        if any(one.link and one.name == picture.camera for one in seen.body.cameras):
            return  # the pose of a camera on an arm is not known
        camera, sample = seen.camera(picture.camera), self._fusion().at(picture.basis)
        again = picture.basis <= self._newest_ticks.get(picture.camera, -1)
        if camera is None or sample is None or again or sample.jumps != moment.jumps:
            self._bus.counters["detections_left_out"] += 1
            return
        self._newest_ticks[camera.name] = self._seen_tick = picture.basis
        if not place.localized:
            return
        motion = between(moment.fused, sample.fused)
        glance = Glance(
            detections=picture,
            camera=camera,
            pose=compose(place.pose, motion),
            spread=place.covariance,
            hits=_in_moved_frame(seen.hiding(camera.z), motion),
            time_s=picture.basis * TICK_S,
            unix_ns=picture.stamp_ns,
            steady=self._steady(sample),
        )
        self.memory.look(glance)
        self.tags.look(glance)

    def _go_back(self) -> None:
        """Restore the memory of some seconds ago, as the robot may have been lost since then."""
        self.tags.doubt()
        if self._copies:
            objects, tags = self._copies[0]
            self.memory.restore(objects)
            self.tags.restore(tags)
            self._copies.clear()

    def _steady(self, sample: OdometrySample) -> bool:
        """Return whether the body turned slowly enough for sharp pictures."""
        before = self._fusion().at(sample.tick - RATE_TICKS)
        if before is None:
            return True
        turn = abs(float(between(before.fused, sample.fused)[2]))
        return turn <= STEADY_RAD_S * RATE_TICKS * TICK_S

    async def _change(self, request: ObjectsRequest) -> ObjectsReply:
        try:
            text = self._forget(request)
        except Refused as error:
            return ObjectsReply(ok=False, text=str(error)[:500])
        self._copies.clear()  # they contain the forgotten objects
        log_accepted(self._bus, OBJECTS_CHANGE.key, request, self._tick)
        self._sent_tick = None
        if self._tick:
            self.publish(self._tick)
        log.info("%s, by %s", text, request.source, extra={"data": {"event": "objects"}})
        return ObjectsReply(ok=True, text=text[:500])

    def _forget(self, request: ObjectsRequest) -> str:
        """Forget the requested objects, and describe that. Raises Refused for unknown ones."""
        known = self.present
        if request.everything:
            self.memory.clear()
            self.tags.clear()
            return f"forgot {len(known.objects)} objects and {len(known.tags)} tags"
        ids = {one.id for one in self.memory.objects()}
        tags = {one.id for one in known.tags}
        missing = [f"object {one}" for one in request.ids if one not in ids]
        missing += [f"tag {one}" for one in request.tags if one not in tags]
        if missing:
            raise Refused(f"no {', no '.join(missing)}; `gigabrain objects` lists what is known")
        self.memory.forget(request.ids)
        self.tags.forget(request.tags)
        names = [f"object {one}" for one in request.ids] + [f"tag {one}" for one in request.tags]
        return f"forgot {', '.join(names)}"

    def _keep(self, tick: int) -> None:
        """Save the objects if they have changed and a save is due."""
        if 0 <= tick - self._saved_tick < SAVE_TICKS:
            return
        found = self.present
        now = ObjectMap(objects=found.objects, tags=found.tags, map=self._map)
        if self._saved is None or not _nearly_equal(now, self._saved):
            self._saved, self._saved_tick = now, tick
            self._keep_state()

    def _keep_state(self) -> None:
        """Write the state for the next process, and the file of a saved map, in the background."""
        nowhere = self._state_path is None and self._file is None
        if not self._boot or nowhere or not self._bus.input_log.live:
            return
        state = ObjectState(
            boot=self._boot,
            map=self._map,
            objects=tuple(KeptObject(one, _kept(at)) for one, at in self.memory.anchored()),
            tags=tuple(KeptTag(one, _kept(at)) for one, at in self.tags.anchored()),
        )
        written = self._writer.put((state, self._file, self.present))
        written.add_done_callback(self._on_written)

    def _write(self, newest: Sequence[Write]) -> str:
        (state, beside, found), path = newest[-1], self._state_path
        try:
            if path:
                make_folder(path.parent)
                replace_file(path, msgspec.json.encode(state))
            if beside:
                object_file.save(beside, found)
        except OSError as error:
            return f"{UNSAVED}: {error.filename or path}: {error.strerror}"
        except Refused as error:
            return f"{UNSAVED}: {error}"
        return ""

    def _on_written(self, done: "asyncio.Future[str]") -> None:
        if problem := done.result():
            self.problem, self._saved = problem, None
        elif self.problem.startswith(UNSAVED):
            self.problem = ""


def _in_moved_frame(hits: Floats, motion: Floats) -> Floats:
    """Transform points (n, 2) from a body's frame to its frame after `motion`."""
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    off = hits - motion[:2]
    return np.column_stack((off @ (cos, sin), off @ (-sin, cos)))


def _nearly_equal(one: ObjectMap, other: ObjectMap) -> bool:
    """Return whether two maps differ only by shifts of less than MIN_SHIFT_M."""
    if one.map != other.map or one.recognizing != other.recognizing:
        return False
    if [(it.id, it.label) for it in one.objects] != [(it.id, it.label) for it in other.objects]:
        return False
    if [it.id for it in one.tags] != [it.id for it in other.tags]:
        return False
    return bool((np.abs(_positions(one) - _positions(other)) < MIN_SHIFT_M).all())


def _positions(found: ObjectMap) -> Floats:
    """Return the positions of objects, then of tags, (n, 2) [m]."""
    objects = [(one.x, one.y) for one in found.objects]
    return np.array(objects + [(one.x, one.y) for one in found.tags]).reshape(-1, 2)


def _anchor(kept: KeptAnchor | None) -> Anchor | None:
    return Anchor(kept.keyframe, np.array((kept.x, kept.y, kept.yaw))) if kept else None


def _kept(anchor: Anchor | None) -> KeptAnchor | None:
    if anchor is None:
        return None
    x, y, yaw = anchor.pose.tolist()
    return KeptAnchor(anchor.keyframe, x, y, yaw)
