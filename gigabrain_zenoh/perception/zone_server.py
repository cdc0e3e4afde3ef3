"""Loads, changes, saves and publishes the zones and places of the map.

Each zone is anchored to the keyframe nearest to its middle. When a loop closure corrects the map,
the zone moves with the walls around it.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, Cause, Count, Finite, Name
from gigabrain_schemas.topics import ZONES, ZONES_CHANGE
from gigabrain_schemas.zones import Place, Zone, Zones, ZonesReply, ZonesRequest
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.bus.restoring import RestoringPublisher
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.config.settings import MappingMode
from gigabrain_zenoh.errors import ConfigError, Refused, unknown
from gigabrain_zenoh.geometry.se2 import compose, inverse, transform
from gigabrain_zenoh.host.files import make_folder, read_bounded, replace_file
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.mapping import map_file, zone_file
from gigabrain_zenoh.mapping.zone_file import ZoneFile

log = logging.getLogger(__name__)

REPUBLISH_TICKS = round(2e9 / TICK_NS)  # maximum interval between published zones
MIN_SHIFT_M = 0.01  # smaller shifts of a corner are not published
STATE_FILE = "zones.json"
MAX_STATE_BYTES = 4_000_000


class Anchor(Struct, frozen=True):
    """The keyframe that a zone or place moves with."""

    keyframe: Count
    x: Finite  # [m], pose of the keyframe when the zone was drawn
    y: Finite
    yaw: Finite  # [rad]


class Anchored(Struct, frozen=True, kw_only=True):
    """A zone or place as it was drawn, and its anchor."""

    zone: Zone | None = None
    place: Place | None = None
    anchor: Anchor | None = None  # None in a map that does not change

    @property
    def name(self) -> str:
        """The name of the zone or place."""
        return self.zone.name if self.zone else self.place.name if self.place else ""


class ZoneState(Struct, frozen=True, kw_only=True):
    """State for the next perception process: the map in use, and its zones."""

    boot: Count  # start of the driver that it belongs to
    map: Name = ""
    mapping: MappingMode = "off"
    maps_loaded: Count = 0
    items: tuple[Anchored, ...] = ()


class ZoneServer:
    """Publisher of `robot/zones`, and server of `robot/zones_change`."""

    def __init__(self, bus: Bus, state_dir: str, basis: Callable[[], int]) -> None:
        self._bus, self._basis = bus, basis
        self._restoring = RestoringPublisher(bus)
        self._state_path = Path(state_dir) / STATE_FILE if state_dir else None
        self._items: tuple[Anchored, ...] = ()
        self._poses: Floats = np.empty((0, 3))  # of keyframes, as in the newest grid
        self._version = -1  # of these poses
        self._current = Zones()
        self._sent_tick: int | None = None
        self._state = ZoneState(boot=0)  # without items
        self._file: Path | None = None  # YAML file of the map, unless it grows
        self._changing = asyncio.Lock()  # serializes changes
        self._fault, self.problem = Fault(log), ""
        self._writer: BackgroundWriter[ZoneState] = BackgroundWriter(self._write, 1)
        bus.serve(ZONES_CHANGE, self._change)

    def use_map(self, name: str, mapping: MappingMode, zones: ZoneFile, *, loaded: bool) -> None:
        """Use the zones of a map; `loaded` if it replaces another map at run time."""
        # a growing map differs from its file
        self._file = map_file.path_of(name) if name and mapping == "localize" else None
        count = self._state.maps_loaded + loaded
        short = name if len(name) <= 64 and "/" not in name else Path(name).stem[:64]
        self._state = replace(self._state, map=short, mapping=mapping, maps_loaded=count)
        self._items = tuple(
            [Anchored(zone=one) for one in zones.zones]
            + [Anchored(place=one) for one in zones.places]
        )
        self._version, self._poses = -1, np.empty((0, 3))
        self._update()
        self._keep_state()

    def saved_as(self, name: str) -> None:
        """Set the name of the map, which was saved with these zones."""
        self._state = replace(self._state, map=name)
        self._update()
        self._keep_state()

    def restore(self, boot: int) -> ZoneState | None:
        """Return the state of an earlier process, if it belongs to this start of the driver."""
        if self._state_path is None:
            return None
        try:
            data = read_bounded(self._state_path, MAX_STATE_BYTES)
            found = msgspec.json.decode(data, type=ZoneState)
        except FileNotFoundError:
            return None
        except (OSError, ConfigError, *DECODE_ERRORS) as error:
            log.warning("%s: %s", self._state_path, error, extra={"data": {"event": "zones"}})
            return None
        return found if found.boot == boot else None

    def resume(self, state: ZoneState) -> None:
        """Continue with the zones of an earlier process, in the same map."""
        self._state, self._items = replace(state, items=()), state.items
        self._version = -1
        self._update()

    def set_boot(self, boot: int) -> None:
        """Save the state for this start of the driver."""
        self._state = replace(self._state, boot=boot)
        self._keep_state()

    def follow(self, version: int, poses: Floats) -> None:
        """Move zones with their keyframes (n, 3) if the map has been corrected."""
        if version == self._version and len(poses) == len(self._poses):
            return
        moved = version != self._version
        self._version, self._poses = version, poses
        if moved or any(one.anchor is None for one in self._items):
            self._items = tuple(_anchored(one, poses) for one in self._items)
            self._update()

    def publish(self, tick: int) -> None:
        """Publish the zones if they are due at this tick."""
        if self._sent_tick is None or not 0 <= tick - self._sent_tick < REPUBLISH_TICKS:
            self._current = self._restoring.publish(ZONES, self._current, basis=tick)
            self._sent_tick = tick
            if self.problem:  # try again: the disk may have room now
                self._keep_state()

    def republish(self, tick: int) -> None:
        """Publish the zones again if another sender has replaced them."""
        self._restoring.restore(basis=tick)

    async def finish_writing(self) -> None:
        """Wait until the state is written."""
        await self._writer.close()

    @property
    def map(self) -> str:
        """The name of the map in use; empty for one that was never saved."""
        return self._state.map

    @property
    def present(self) -> ZoneFile:
        """The zones and places at their current positions in the map."""
        return ZoneFile(zones=self._current.zones, places=self._current.places)

    def problems(self) -> tuple[Cause, ...]:
        """Return the cause if zones cannot be saved."""
        if not self.problem:
            return ()
        remedy = "make room on the disk, and check that the folder is writable"
        text = f"zones are not saved; they are lost if perception ends: {self.problem}"[:500]
        return (Cause(code="zones_unsaved", text=text, remedy=remedy),)

    def _update(self) -> None:
        """Compute the current zones. If they have changed, they are published next."""
        placed = [_placed(one, self._poses) for one in self._items]
        zones = tuple(one.zone for one in placed if one.zone)
        places = tuple(one.place for one in placed if one.place)
        current, state = self._current, self._state
        same = (current.map, current.maps_loaded) == (state.map, state.maps_loaded)
        if same and _nearly_equal(current, zones, places):
            return
        self._current = Zones(
            zones=zones, places=places, map=state.map, maps_loaded=state.maps_loaded
        )
        self._sent_tick = None

    async def _change(self, request: ZonesRequest) -> ZonesReply:
        async with self._changing:
            try:
                text = self._apply(request)
            except Refused as error:
                data = {"event": "zones", "source": request.source}
                log.warning("refused a change of zones from %s: %s", request.source, error,
                            extra={"data": data})  # fmt: skip
                return ZonesReply(ok=False, text=str(error)[:500])
            log_accepted(self._bus, ZONES_CHANGE.key, request, self._basis())
            if self._bus.time.tick:
                self.publish(self._bus.time.tick)
            log.info("%s, by %s", text, request.source, extra={"data": {"event": "zones"}})
            self._keep_state()
            return ZonesReply(ok=True, text=f"{text}{await self._write_file()}"[:500])

    def _apply(self, request: ZonesRequest) -> str:
        """Apply a change, and describe it. Raises Refused."""
        new = Anchored(zone=request.zone, place=request.place)
        name = new.name or request.remove
        others = tuple(one for one in self._items if one.name != name)
        exists = len(others) < len(self._items)
        if request.remove:
            if not exists:
                known = [one.name for one in self._items] or ["none"]
                raise Refused(str(unknown("zone or place", name, known)))
            items, verb = others, "removed"
        else:
            if exists and not request.replace:
                remedy = "replace it (--replace), or choose another name"
                raise Refused(f"{name!r} exists already; {remedy}")
            if request.zone and (problem := zone_file.new_zone_problem(request.zone)):
                raise Refused(f"zone {name!r}: {problem}")
            items = (*others, _anchored(new, self._poses))
            verb = "replaced" if exists else "added"
        before, self._items = self._items, items
        try:
            self._update()
            zone_file.encoded(self.present)
        except (ValueError, Refused) as error:  # too many zones or places
            self._items = before
            self._update()
            raise Refused(str(error)) from None
        return f"{verb} {name!r}"

    async def _write_file(self) -> str:
        """Write the zones beside a saved map. Return a note about it for the reply."""
        if self._file is None:
            return "; save the map to keep it"
        if not self._bus.input_log.live:
            return ""
        try:
            await asyncio.to_thread(zone_file.save, self._file, self.present)
        except Refused as error:
            return f", {error}"
        return f", kept with the map {self._state.map}"

    def _keep_state(self) -> None:
        """Write the state for the next process in the background."""
        if self._state_path and self._state.boot and self._bus.input_log.live:
            written = self._writer.put(replace(self._state, items=self._items))
            written.add_done_callback(lambda done: self._on_written(done.result()))

    def _write(self, newest: Sequence[ZoneState]) -> str:
        assert self._state_path
        try:
            make_folder(self._state_path.parent)
            replace_file(self._state_path, msgspec.json.encode(newest[-1]))
        except OSError as error:
            return f"{error.filename or self._state_path}: {error.strerror}"
        return ""

    def _on_written(self, problem: str) -> None:
        self.problem = problem
        if problem:
            self._fault.begin(f"zones are not saved: {problem}")
        else:
            self._fault.end("zones are saved again")


def _anchored(item: Anchored, poses: Floats) -> Anchored:
    """Return an item anchored to the nearest keyframe, unless its anchor still exists."""
    if not len(poses) or (item.anchor and item.anchor.keyframe < len(poses)):
        return item
    middle = _points(item).mean(axis=0)
    nearest = int(np.hypot(*(poses[:, :2] - middle).T).argmin())
    x, y, yaw = poses[nearest].tolist()
    return replace(item, anchor=Anchor(nearest, x, y, yaw))


def _placed(item: Anchored, poses: Floats) -> Anchored:
    """Return an item at its current position in the map."""
    anchor = item.anchor
    if anchor is None or anchor.keyframe >= len(poses):
        return item
    before = np.array((anchor.x, anchor.y, anchor.yaw))
    now = poses[anchor.keyframe]
    if np.array_equal(now, before):
        return item
    moved = compose(now, inverse(before))
    points = transform(moved, _points(item)).tolist()
    if item.zone:
        corners = tuple((x, y) for x, y in points)
        return replace(item, zone=replace(item.zone, points=corners))
    assert item.place
    yaw = None if item.place.yaw is None else item.place.yaw + float(moved[2])
    (x, y) = points[0]
    return replace(item, place=replace(item.place, x=x, y=y, yaw=yaw))


def _points(item: Anchored) -> Floats:
    if item.zone:
        return np.array(item.zone.points)
    assert item.place
    return np.array(((item.place.x, item.place.y),))


def _nearly_equal(old: Zones, zones: tuple[Zone, ...], places: tuple[Place, ...]) -> bool:
    """Return whether zones differ from `old` by less than MIN_SHIFT_M."""
    if [_rules(one) for one in old.zones] != [_rules(one) for one in zones]:
        return False
    if [(one.name, one.yaw is None) for one in old.places] != [
        (one.name, one.yaw is None) for one in places
    ]:
        return False
    before = [Anchored(zone=one) for one in old.zones] + [Anchored(place=p) for p in old.places]
    after = [Anchored(zone=one) for one in zones] + [Anchored(place=one) for one in places]
    turned = [abs((a.yaw or 0.0) - (b.yaw or 0.0)) for a, b in zip(old.places, places, strict=True)]
    shifts = [
        float(np.abs(_points(a) - _points(b)).max()) for a, b in zip(before, after, strict=True)
    ]
    return max(shifts, default=0.0) < MIN_SHIFT_M and max(turned, default=0.0) < MIN_SHIFT_M


def _rules(zone: Zone) -> tuple[object, ...]:
    return zone.name, zone.kind, zone.max_speed, zone.lane_width, len(zone.points)
