"""Things that a camera sees near the arm, and which of them a mission means."""

import math
from collections import deque
from collections.abc import Mapping

from msgspec.structs import replace

from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.objects import SeenSolid, Solids
from gigabrain_schemas.topics import SOLIDS
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.decision.tasks.arm_steps import Solid
from gigabrain_zenoh.geometry.pose import PoseHistory, relative, to_parent

LIKE_M, LIKE_SHARE = 0.006, 0.3  # by which lengths may differ of what is taken for a thing
SAME_M = 0.03  # beside where a thing stands by its mission: it is the same, seen
NEAR_M = 1.0  # of the body, within which what is seen may be in the arm's way
Lengths = tuple[float, float, float]


class SeenThings:
    """The newest things that perception has seen near the arm."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._received: deque[Solids] = deque(maxlen=2)
        self._history = PoseHistory()
        self._watches = False

    def observe(self, body: BodyDescription | None, state: RobotState) -> None:
        """Record the odometry; subscribe once the body is known to have an arm and a camera."""
        self._history = self._history.then(state)
        if body and body.arm and body.cameras and not self._watches:
            self._watches = True
            self._bus.latest(SOLIDS, self._received.append)

    def at(self, state: RobotState) -> tuple[SeenSolid, ...]:
        """Return what was seen before a state, in the body's frame then; the nearest first.

        It is what a replay of the same messages finds.
        """
        boot, tick = state.boot, state.tick
        earlier = (one for one in reversed(self._received) if one.boot == boot and one.tick < tick)
        newest = next(earlier, None)
        then = self._history.at(boot, newest.basis) if newest else None
        if newest is None or then is None:
            return ()
        here = relative(state.pose, then)
        moved = []
        for one in newest.solids:
            x, y = to_parent(here, *one.position[:2])
            moved.append(replace(one, position=(x, y, one.position[2]), yaw=one.yaw + here.yaw))
        return tuple(sorted(moved, key=lambda one: math.hypot(*one.position[:2])))


def located(things: Mapping[str, Solid], seen: tuple[SeenSolid, ...]) -> dict[str, Solid]:
    """Return where things are, those without a place by what is seen; without what is not seen.

    All else that is seen nearby is in the way, by the name `seen` with its number.
    """
    known = {name: one for name, one in things.items() if one.at}
    left = [one for one in seen if not any(_stands(one, other) for other in known.values())]
    for name, wanted in things.items():
        if wanted.at is None and (found := next((one for one in left if _fits(wanted, one)), None)):
            left.remove(found)
            known[name] = _placed(wanted, found)
    for one in left:
        if math.hypot(*one.position[:2]) < NEAR_M:
            known[f"seen {one.id}"] = _placed(Solid(label="thing"), one)
    return known


def _stands(one: SeenSolid, other: Solid) -> bool:
    return other.at is not None and math.dist(one.position[:2], other.at[:2]) < SAME_M


def _fits(wanted: Solid, one: SeenSolid) -> bool:
    """Return whether what is seen has the wanted class, and about the wanted size."""
    if wanted.label and wanted.label != one.label:
        return False
    lengths = _lengths(wanted)
    if lengths is None:
        return True
    pairs = zip(_by_size(lengths), _by_size(_seen_lengths(one)), strict=True)
    return all(abs(a - b) <= max(LIKE_M, LIKE_SHARE * a) for a, b in pairs)


def _by_size(lengths: Lengths) -> Lengths:
    """Return lengths with the shorter side first; the height stays the last."""
    x, y, z = lengths
    return min(x, y), max(x, y), z


def _lengths(solid: Solid) -> Lengths | None:
    if solid.box:
        return solid.box
    if solid.cylinder:
        radius, height = solid.cylinder
        return 2 * radius, 2 * radius, height
    return (2 * solid.sphere,) * 3 if solid.sphere else None


def _seen_lengths(one: SeenSolid) -> Lengths:
    if one.shape == "box":
        x, y, z = one.size
        return x, y, z
    wide = 2 * one.size[0]
    return wide, wide, one.size[1] if one.shape == "cylinder" else wide


def _placed(wanted: Solid, one: SeenSolid) -> Solid:
    """Return a thing where it is seen, by its own lengths where they are given."""
    x, y, z = one.position
    lengths = _lengths(wanted)
    if lengths is None:
        shape = {one.shape: one.size if len(one.size) > 1 else one.size[0]}
        return Solid(**shape, at=(x, y, z), yaw=one.yaw)  # type: ignore[arg-type]
    long, wide, _ = _seen_lengths(one)
    turned = (long - wide) * (lengths[0] - lengths[1]) < 0.0  # its longer side is the other one
    yaw = one.yaw + (math.pi / 2 if turned else 0.0)
    return replace(wanted, at=(x, y, lengths[2] / 2), yaw=yaw, label=None)
