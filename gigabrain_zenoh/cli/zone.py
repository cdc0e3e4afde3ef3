"""`gigabrain place` and `gigabrain zone`: named places and zones of the robot's map."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from msgspec import structs

from gigabrain_zenoh.cli.options import (
    LOCAL,
    RobotAddress,
    check_name,
    checked,
    on_bus,
    print_line,
)
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused

if TYPE_CHECKING:
    from gigabrain_schemas.zones import Zones
    from gigabrain_zenoh.bus.bus import Bus

Number = Annotated[float | None, Parameter(allow_leading_hyphen=True)]
Numbers = Annotated[list[float], Parameter(allow_leading_hyphen=True)]
POSE_TIMEOUT_S = 3.0


def list_(*, at: RobotAddress = LOCAL) -> None:
    """List the named places and zones of the robot's map.

    Example: gigabrain place list
    """
    zones = on_bus(at, _zones)
    for place in zones.places:
        yaw = "" if place.yaw is None else f", {place.yaw:.2f} rad"
        print_line(f"{place.name:<20} place     ({place.x:.2f}, {place.y:.2f}{yaw})")
    for zone in zones.zones:
        more = "" if zone.max_speed is None else f", {zone.max_speed:g} m/s"
        more += "" if zone.lane_width is None else f", {zone.lane_width:g} m wide"
        print_line(f"{zone.name:<20} {zone.kind:<9} {len(zone.points)} points{more}")
    if not zones.places and not zones.zones:
        print_line("no places and no zones")


def add(
    name: str,
    x: Number = None,
    y: Number = None,
    yaw: Number = None,
    /,
    *,
    replace: bool = False,
    at: RobotAddress = LOCAL,
) -> None:
    """Name a place of the map: the robot's own, or a given one.

    Example: gigabrain place add kitchen 3.0 1.5 1.57

    Args:
        name: Name of the place, for `gigabrain goto NAME` and for missions.
        x: Place in the map [m]. Default: where the robot is, with its heading.
        y: Place in the map [m].
        yaw: Heading on arrival [rad]. Default: any.
        replace: Replace a place or zone of the same name.
    """
    from gigabrain_schemas.zones import Place

    if x is not None and y is None:
        raise ConfigError("a place takes x and y; expected both numbers, or none")

    values = {"name": name, "x": x or 0.0, "y": y or 0.0, "yaw": yaw}
    place = checked(values, Place, positional=values)

    async def change(bus: "Bus") -> str:
        found = place if x is not None else structs.replace(place, **await _here(bus))
        return await _ask(bus, place=found, replace=replace)

    print_line(on_bus(at, change))


def remove(name: str, /, *, at: RobotAddress = LOCAL) -> None:
    """Remove a named place or a zone.

    Example: gigabrain place remove kitchen

    Args:
        name: Name of the place or zone.
    """
    check_name("NAME", name)
    print_line(on_bus(at, lambda bus: _ask(bus, remove=name)))


def add_zone(
    name: str,
    kind: Literal["keepout", "speed", "one_way"],
    points: Numbers,
    /,
    *,
    max_speed: float | None = None,
    width: float | None = None,
    replace: bool = False,
    at: RobotAddress = LOCAL,
) -> None:
    """Add a keep-out zone, a speed zone or a one-way lane.

    Example: gigabrain zone add lab keepout 2 1 4 1 4 3 2 3

    Args:
        name: Name of the zone.
        kind: What the zone does.
        points: Corners x y x y ... in the map [m]; of a lane, points from its start to its end.
        max_speed: Speed limit of a speed zone [m/s].
        width: Width of a lane [m].
        replace: Replace a zone or place of the same name.
    """
    from gigabrain_schemas.zones import Zone

    if len(points) % 2:
        raise ConfigError(f"{len(points)} numbers; expected pairs x y")
    if kind == "speed" and max_speed is None:
        raise ConfigError("a speed zone needs a limit; add --max-speed [m/s]")
    if kind == "one_way" and width is None:
        raise ConfigError("a lane needs a width; add --width [m]")
    values = {
        "name": name,
        "kind": kind,
        "points": list(zip(points[::2], points[1::2], strict=True)),
        "max_speed": max_speed,
        "lane_width": width,
    }
    zone = checked(values, Zone, {"lane_width": "width"}, positional=("name", "points"))
    print_line(on_bus(at, lambda bus: _ask(bus, zone=zone, replace=replace)))


async def _zones(bus: "Bus") -> "Zones":
    """Return the kept zones. Raises BodyLost."""
    from gigabrain_schemas.topics import ZONES
    from gigabrain_zenoh.client.zones import NO_MAPPING
    from gigabrain_zenoh.codec import Codec

    kept = await bus.kept(ZONES)
    if not kept:
        raise BodyLost(NO_MAPPING)
    found: Zones = Codec(ZONES.type, ZONES.max_bytes).decode(kept[0])
    return found


async def _here(bus: "Bus") -> dict[str, Any]:
    """Return the robot's pose in its map. Raises BodyLost and Refused."""
    import asyncio

    from gigabrain_schemas.brain import PoseInMap
    from gigabrain_schemas.topics import POSE

    found: asyncio.Future[PoseInMap] = asyncio.get_running_loop().create_future()
    bus.subscribe(POSE, lambda _key, pose: None if found.done() else found.set_result(pose))
    try:
        pose = await asyncio.wait_for(found, POSE_TIMEOUT_S)
    except TimeoutError:
        raise BodyLost("the robot has no pose in a map; give x and y") from None
    if not pose.localized:
        raise Refused("the robot is not localized; give x and y")
    return {"x": pose.x, "y": pose.y, "yaw": pose.yaw}


async def _ask(bus: "Bus", **fields: Any) -> str:
    """Request a change; return the reply as text. Raises BodyLost and Refused."""
    from gigabrain_schemas.zones import ZonesRequest
    from gigabrain_zenoh.client.zones import change_zones
    from gigabrain_zenoh.host.this_process import user_name

    return await change_zones(bus, ZonesRequest(**fields, source=user_name()))
