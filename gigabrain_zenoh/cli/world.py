"""`gigabrain world`: obstacles and people in a running simulation."""

from typing import Annotated, Literal

from cyclopts import Parameter

from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, check_name, checked, on_bus, print_line
from gigabrain_zenoh.host.this_process import user_name

MAX_NAME_CHARS = 32  # of an object
TYPE_CHECKING = False
if TYPE_CHECKING:
    from gigabrain_schemas.sim import SimReply, SimRequest, Thing


def add(
    kind: Literal["box", "cylinder", "person"],
    x: float,
    y: float,
    /,
    *,
    size: tuple[float, float, float] | None = None,
    yaw: float = 0.0,
    to: Annotated[tuple[tuple[float, float], ...], Parameter(show_default=False)] = (),
    speed: float = 0.8,
    name: str = "",
    at: RobotAddress = LOCAL,
) -> None:
    """Add an obstacle or a person to the simulated world, while the robot drives.

    Example: gigabrain world add person 1.5 2 --to 1.5 -2

    Places are in the frame of the world, in metres, as in a world file.
    `gigabrain world list` shows where the robot is.

    Args:
        kind: Kind of object to add.
        x: Middle of the object [m].
        y: Middle of the object [m].
        size: Length along x, length along y, and height [m]. Default: 0.3 0.3 0.5.
        yaw: Rotation about the vertical [rad].
        to: Place to which a person walks and returns [m]; may be given again.
        speed: Speed of a person [m/s].
        name: Name, for `world remove`. Default: its kind and a number.
    """
    from gigabrain_schemas.sim import SimRequest, Thing

    values: dict[str, object] = {
        "kind": kind, "x": x, "y": y, "yaw": yaw, "path": to, "speed": speed,
    }  # fmt: skip
    values |= {"size": size} if size else {}
    values |= {"name": name} if name else {}
    thing = checked(values, Thing, {"path": "to"}, positional=("kind", "x", "y"))
    request = SimRequest(do="add", thing=thing, source=user_name())
    print_line(_ask(request, at).text)


def remove(name: str, /, *, at: RobotAddress = LOCAL) -> None:
    """Remove an object that was added to the simulated world.

    Example: gigabrain world remove box1

    Args:
        name: Name of the object; see `gigabrain world list`.
    """
    from gigabrain_schemas.sim import SimRequest

    check_name("NAME", name, MAX_NAME_CHARS)
    print_line(_ask(SimRequest(do="remove", name=name, source=user_name()), at).text)


def list_(*, at: RobotAddress = LOCAL) -> None:
    """List the objects that were added to the simulated world, and where the robot is.

    Example: gigabrain world list
    """
    from gigabrain_schemas.sim import SimRequest

    reply = _ask(SimRequest(source=user_name()), at)
    if robot := reply.robot:
        print_line(f"{'robot':<12} at ({robot.x:.2f}, {robot.y:.2f}), yaw {robot.yaw:.2f}")
    for thing in reply.things:
        print_line(_in_words(thing))


def _in_words(thing: "Thing") -> str:
    where = f"{thing.name:<12} at ({thing.x:.2f}, {thing.y:.2f})"
    if thing.kind == "person":
        ways = ", ".join(f"({x:.2f}, {y:.2f})" for x, y in thing.path)
        return f"{where}, walks to {ways} at {thing.speed:g} m/s" if ways else f"{where}, stands"
    return f"{where}, {thing.size[0]:g} x {thing.size[1]:g} x {thing.size[2]:g} m"


def _ask(request: "SimRequest", at: RobotAddress) -> "SimReply":
    from gigabrain_zenoh.client.requests import change_world

    return on_bus(at, lambda bus: change_world(bus, request, at.folder))
