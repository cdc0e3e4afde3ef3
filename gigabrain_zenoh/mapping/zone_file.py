"""Zones and places of a saved map: NAME.zones.yaml, beside NAME.yaml."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace

from gigabrain_schemas.zones import PlaceList, Zone, ZoneList, check_zones
from gigabrain_zenoh.config import loading
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.geometry import polygon
from gigabrain_zenoh.host.files import make_folder, replace_file
from gigabrain_zenoh.mapping import map_file

ENDING = map_file.ZONES
VERSION = 1
DECIMALS = 6  # of a zone's corners in the file
HEAD = "# Zones and places of the map; docs/how-to/zones_and_places.md describes them. [m], [rad]\n"


class ZoneFile(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Zones and named places of a map, in its frame."""

    version: Annotated[int, Meta(ge=1, le=VERSION)] = VERSION
    zones: ZoneList = ()
    places: PlaceList = ()

    def __post_init__(self) -> None:
        check_zones(self.zones, self.places)


def path_beside(map_path: Path) -> Path:
    """Return the file beside a map's YAML file."""
    return map_path.with_suffix(ENDING)


def load(map_path: Path) -> ZoneFile:
    """Load the zones beside a map's YAML file, if there are any. Raises ConfigError."""
    path = path_beside(map_path)
    if not path.exists():
        return ZoneFile()
    found = loading.load(path, ZoneFile)
    for zone in found.zones:
        if problem := zone_problem(zone):
            raise ConfigError(f"{path}: zone {zone.name!r}: {problem}")
    return found


def save(map_path: Path, zones: ZoneFile) -> None:
    """Write the zones beside a map's YAML file. Raises Refused."""
    path = path_beside(map_path)
    try:
        make_folder(path.parent)
        replace_file(path, encoded(zones))
    except OSError as error:
        raise Refused(f"not saved: {error.filename or path}: {error.strerror}") from None


def encoded(zones: ZoneFile) -> bytes:
    """Return the content of a file. Raises Refused if it would be too large to load."""
    data = "".join((HEAD, f"version: {VERSION}\n", *_lines(zones))).encode()
    if len(data) > loading.MAX_BYTES:
        raise Refused(
            f"not saved: {len(data)} bytes of zones; expected at most {loading.MAX_BYTES}"
        )
    return data


def zone_problem(zone: Zone) -> str:
    """Return the fault of a zone and its remedy, or an empty text."""
    corners = np.array(zone.points)
    if zone.kind == "one_way":
        steps = np.hypot(*np.diff(corners, axis=0).T)
        return "" if (steps > 0).any() else "its points are all the same; a lane needs a direction"
    problem = polygon.problem(corners)
    return f"{problem}; draw a polygon whose edges do not cross" if problem else ""


def new_zone_problem(zone: Zone) -> str:
    """Return the fault of a new zone, which must be valid as written and rounded to 1 mm.

    So its file can still be read after a loop closure moves and turns the zone.
    """
    return zone_problem(_rounded(zone, DECIMALS)) or zone_problem(_rounded(zone, 3))


def _rounded(zone: Zone, decimals: int) -> Zone:
    corners = tuple((round(x, decimals), round(y, decimals)) for x, y in zone.points)
    return replace(zone, points=corners)


def _lines(zones: ZoneFile) -> Iterator[str]:
    yield "zones:\n" if zones.zones else "zones: []\n"
    for zone in zones.zones:
        more = "" if zone.max_speed is None else f", max_speed: {zone.max_speed:.6g}"
        more += "" if zone.lane_width is None else f", lane_width: {zone.lane_width:.6g}"
        points = ", ".join(f"[{x}, {y}]" for x, y in _rounded(zone, DECIMALS).points)
        yield f"- {{name: {_quoted(zone.name)}, kind: {zone.kind}{more},\n   points: [{points}]}}\n"
    yield "places:\n" if zones.places else "places: []\n"
    for place in zones.places:
        yaw = "" if place.yaw is None else f", yaw: {place.yaw:.4f}"
        yield f"- {{name: {_quoted(place.name)}, x: {place.x:.3f}, y: {place.y:.3f}{yaw}}}\n"


def _quoted(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def listed(zones: int, places: int) -> str:
    """Return the numbers of zones and places as text."""
    return f"{zones} zone{'s' * (zones != 1)} and {places} place{'s' * (places != 1)}"
