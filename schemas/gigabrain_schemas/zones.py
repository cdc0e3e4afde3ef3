"""Zones and named places of a map, and requests that change them."""

from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_schemas.base import (
    Angle,
    Coordinate,
    Count,
    Message,
    Name,
    Record,
    Text,
)

MAX_VERTICES = 256  # of one zone
MAX_ALL_VERTICES = 8192  # of all zones together
MAX_ZONES = 256
MAX_PLACES = 256

# letters, digits, spaces, - _ and . ; the first character is a letter, digit or _
Label = Annotated[str, Meta(pattern=r"^\w[\w .-]*$(?!\n)", max_length=64)]
ZoneKind = Literal["keepout", "speed", "one_way"]
Vertex = tuple[Coordinate, Coordinate]  # [m], in the map
ZoneSpeed = Annotated[float, Meta(ge=0.05, le=100.0)]  # [m/s]; a slower body counts as stuck
LaneWidth = Annotated[float, Meta(ge=0.05, le=100.0)]  # [m]


class Zone(Record, frozen=True, kw_only=True):
    """An area of the map with a rule: the polygon `points`, or a lane with this middle line."""

    name: Label
    kind: ZoneKind
    points: Annotated[tuple[Vertex, ...], Meta(min_length=2, max_length=MAX_VERTICES)]
    max_speed: ZoneSpeed | None = None  # [m/s], of a speed zone
    lane_width: LaneWidth | None = None  # [m], of a one-way lane from the first point to the last

    def __post_init__(self) -> None:
        if self.kind != "one_way" and len(self.points) < 3:
            raise ValueError(f"zone {self.name!r}: a polygon has at least 3 points")
        for kind, field in (("speed", "max_speed"), ("one_way", "lane_width")):
            if (self.kind == kind) != (getattr(self, field) is not None):
                verb = "needs" if self.kind == kind else "has no"
                raise ValueError(f"zone {self.name!r}: a {self.kind} zone {verb} {field}")


class Place(Record, frozen=True, kw_only=True):
    """A named pose in the map."""

    name: Label
    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle | None = None  # [rad]; None for any


ZoneList = Annotated[tuple[Zone, ...], Meta(max_length=MAX_ZONES)]
PlaceList = Annotated[tuple[Place, ...], Meta(max_length=MAX_PLACES)]


class Zones(Message, frozen=True, kw_only=True):
    """All zones and places of the present map. The last value is kept for late joiners."""

    zones: ZoneList = ()
    places: PlaceList = ()
    map: Name = ""  # saved map that they belong to; empty for a growing one
    maps_loaded: Count = 0  # since the start; another map makes old coordinates invalid

    def __post_init__(self) -> None:
        check_zones(self.zones, self.places)

    def place(self, name: str) -> Place | None:
        """Return the place `name`; None if there is none."""
        return next((one for one in self.places if one.name == name), None)


def check_zones(zones: tuple[Zone, ...], places: tuple[Place, ...]) -> None:
    """Raise ValueError for duplicate names, and for too many vertices."""
    seen: set[str] = set()
    for name in (*(one.name for one in zones), *(one.name for one in places)):
        if name in seen:
            raise ValueError(f"two zones or places are called {name!r}")
        seen.add(name)
    if (count := sum(len(one.points) for one in zones)) > MAX_ALL_VERTICES:
        raise ValueError(f"{count} vertices in all zones; expected at most {MAX_ALL_VERTICES}")


class ZonesRequest(Message, frozen=True, kw_only=True):
    """Add a zone or a place, or remove one by its name."""

    zone: Zone | None = None
    place: Place | None = None
    remove: Name = ""
    replace: bool = False  # overwrite one of the same name
    source: Name = "anonymous"

    def __post_init__(self) -> None:
        if sum((self.zone is not None, self.place is not None, bool(self.remove))) != 1:
            raise ValueError("expected one of zone, place and remove")


class ZonesReply(Message, frozen=True, kw_only=True):
    """The result of a change."""

    ok: bool
    text: Text  # a sentence for people


class MapListRequest(Message, frozen=True, kw_only=True):
    """Ask for the saved maps on perception's host. The request may be empty."""


class SavedMapInfo(Record, frozen=True, kw_only=True):
    """A saved map."""

    name: Name
    width: Count = 0  # cells
    height: Count = 0  # cells
    resolution: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # [m] per cell
    graph: bool = False  # mapping can continue from it
    zones: Count = 0
    places: Count = 0
    problem: Text = ""  # why it cannot be used


class MapListReply(Message, frozen=True, kw_only=True):
    """The saved maps, by name."""

    maps: Annotated[tuple[SavedMapInfo, ...], Meta(max_length=256)] = ()
    present: Name = ""  # name of the map in use
    text: Text = ""  # a sentence for people, if there are too many


class MapLoadRequest(Message, frozen=True, kw_only=True):
    """Use a saved map: localize the robot in it, and with `slam` continue mapping."""

    name: Annotated[str, Meta(pattern=r"^(?!.*\.(ya?ml|zones)$)\w[\w.-]*$(?!\n)", max_length=64)]
    mapping: Literal["localize", "slam"] = "localize"
    source: Name = "anonymous"
