"""`gigabrain objects` and `gigabrain pose`: remembered things and tags, and the robot's pose."""

import time
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.options import (
    LOCAL,
    RobotAddress,
    checked,
    on_bus,
    print_json,
    print_line,
)
from gigabrain_zenoh.errors import ConfigError

if TYPE_CHECKING:
    from gigabrain_schemas.objects import ObjectMap

Number = Annotated[float, Parameter(allow_leading_hyphen=True)]


def objects(
    *,
    json: bool = False,
    forget: tuple[int, ...] = (),
    forget_tag: tuple[int, ...] = (),
    forget_all: bool = False,
    at: RobotAddress = LOCAL,
) -> None:
    """List the things and tags that the robot's cameras have recognised in its map.

    Example: gigabrain objects

    Example: gigabrain objects --forget 3

    Args:
        json: Print JSON.
        forget: Forget the thing with this id.
        forget_tag: Forget the tag with this number.
        forget_all: Forget all things and tags.
    """
    from gigabrain_zenoh.client.objects import forget_objects, known_objects

    if forget or forget_tag or forget_all:
        from gigabrain_schemas.objects import ObjectsRequest

        if forget_all and (forget or forget_tag):
            raise ConfigError("choose --forget-all, or --forget and --forget-tag")
        fields = {"ids": forget, "tags": forget_tag, "everything": forget_all}
        checked(fields, ObjectsRequest, {"ids": "forget", "tags": "forget_tag"})
        print_line(on_bus(at, lambda bus: forget_objects(bus, **fields), _name()))
        return
    found = on_bus(at, known_objects)
    if json:
        print_json(found, indent=2)
        return
    for line in lines(found, time.time()):
        print_line(line)


def pose(x: Number, y: Number, yaw: Number | None = None, /, *, at: RobotAddress = LOCAL) -> None:
    """Set the robot's pose in its map; its scan confirms and refines it.

    Example: gigabrain pose 3.0 1.5 1.57

    Exit code 0 once the scan confirms it.

    Args:
        x: Place in the map [m], within about 0.5 m.
        y: Place in the map [m].
        yaw: Heading [rad], within about 0.5 rad. Default: any.
    """
    from gigabrain_schemas.requests import PoseRequest
    from gigabrain_zenoh.client.objects import set_pose

    values = {"x": x, "y": y, "yaw": yaw}
    checked(values, PoseRequest, positional=values)
    found = on_bus(at, lambda bus: set_pose(bus, x, y, yaw), _name())
    print_line(f"localized at ({found.x:.2f}, {found.y:.2f}), {found.yaw:.2f} rad")


def lines(found: "ObjectMap", now_s: float) -> list[str]:
    """Return the lines of a table of things and tags; `now_s` is the Unix time [s]."""
    if not found.objects and not found.tags:
        return ["no things and no tags" + ("" if found.recognizing else NOBODY_LOOKS)]
    table = [HEADER]
    for one in sorted(found.objects, key=lambda one: (one.label, one.id)):
        place = f"{one.x:.2f}, {one.y:.2f}, {one.z:.2f}"
        size = f"{one.size[0]:.2f} x {one.size[1]:.2f}"
        sure, seen = f"{one.confidence:.0%}", ago(one.last_seen_ns, now_s)
        table.append(f"{one.label:<16} {one.id:>4}  {place:<22} {size:<12} {sure:>5}  {seen}")
    for tag in sorted(found.tags, key=lambda one: one.id):
        place = f"{tag.x:.2f}, {tag.y:.2f}, {tag.z:.2f}"
        faces, seen = f"{tag.yaw:.2f} rad", ago(tag.last_seen_ns, now_s)
        table.append(f"{'tag':<16} {tag.id:>4}  {place:<22} {faces:<12} {'':>5}  {seen}")
    if not found.recognizing:
        table.append(NOBODY_LOOKS.removeprefix("; "))
    return table


HEADER = f"{'thing':<16} {'id':>4}  {'x, y, z [m]':<22} {'size [m]':<12} {'sure':>5}  last seen"
NOBODY_LOOKS = "; nothing is recognised now: `gigabrain node list` shows whether recognition runs"


def ago(seen_ns: int, now_s: float) -> str:
    """Return the time since Unix time `seen_ns` as text, such as `5 min ago`."""
    seconds = max(0.0, now_s - seen_ns / 1e9)
    if seconds < 120:
        return f"{seconds:.0f} s ago"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min ago"
    return f"{seconds / 3600:.0f} h ago" if seconds < 172_800 else f"{seconds / 86_400:.0f} d ago"


def _name() -> str:
    from gigabrain_zenoh.host.this_process import user_name

    return f"{user_name()}-cli"
