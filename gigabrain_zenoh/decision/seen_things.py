"""Things that a camera sees near the arm, and which of them a mission means."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.objects import SeenSolid, Solids
from gigabrain_schemas.topics import SOLIDS
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.decision.behaviours import Target
from gigabrain_zenoh.decision.tasks.arm_steps import ArmAction, Solid, thing_meant
from gigabrain_zenoh.geometry.pose import PoseHistory, relative, to_parent

if TYPE_CHECKING:
    from gigabrain_zenoh.manipulation.collision import Thing  # imports MuJoCo

LIKE_M, LIKE_SHARE = 0.006, 0.3  # by which lengths may differ of what is taken for a thing
SAME_M = 0.03  # beside where a thing stands by its mission: it is the same, seen
SEEN_AFTER_TICKS = 50  # since a thing is held: a camera that still sees it stand is right
NEAR_M = 1.0  # of the body, within which what is seen may be in the arm's way
LOOK_TICKS = 75  # at rest, until a thing in sight is known: pictures come five times a second
PUT_M, PUT_TICKS = 0.06, 500  # beside where a thing was put down, and until a camera has seen it
ASIDE = 0.7  # of the first joint's range, to either side, where the arm hides nothing
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
        here, older = relative(state.pose, then), (tick - newest.basis) * TICK_S
        moved = []
        for one in newest.solids:
            x, y = to_parent(here, *one.position[:2])
            place, yaw = (x, y, one.position[2]), one.yaw + here.yaw
            moved.append(replace(one, position=place, yaw=yaw, age=one.age + older))
        return tuple(sorted(moved, key=lambda one: math.hypot(*one.position[:2])))


@dataclass(frozen=True, kw_only=True)
class PutDown:
    """A thing that the arm has put down: it is in the way, even if the arm hides it."""

    name: str
    solid: Solid  # with its place in the body's frame then
    state: RobotState

    def at(self, state: RobotState, seen: tuple[SeenSolid, ...]) -> Solid | None:
        """Return it in the body's frame now, until something is seen there or the body drives off.

        Forget it after ten seconds as well, in case someone took it before the camera saw it.
        """
        assert self.solid.at
        here = relative(state.pose, self.state.pose)
        x, y = to_parent(here, *self.solid.at[:2])
        old = not 0 <= state.tick - self.state.tick < PUT_TICKS or state.boot != self.state.boot
        if old or math.hypot(x, y) > NEAR_M:
            return None
        if any(math.dist((x, y), one.position[:2]) < PUT_M for one in seen):
            return None
        return replace(self.solid, at=(x, y, self.solid.at[2]), yaw=self.solid.yaw + here.yaw)


class Lookout:
    """Waits for a thing to be seen, and names postures to look for it from."""

    def __init__(self) -> None:
        self._since: int | None = None
        self._gone = 0  # of the postures

    def reset(self) -> None:
        """Begin with another command, or once the thing is seen."""
        self._since, self._gone = None, 0

    def waits(self, tick: int) -> bool:
        """Return whether it may still come to be seen from where the arm rests."""
        if self._since is None or tick < self._since:
            self._since = tick
        return tick - self._since < LOOK_TICKS

    def aside(self, body: BodyDescription) -> dict[str, float] | None:
        """Return the next posture to look from [rad] or [m]; None after the last one."""
        assert body.arm
        first, places = body.joints[0], dict[str, float]()
        postures = [None, first.lower * ASIDE, first.upper * ASIDE]
        if self._gone >= len(postures):
            return None
        for joint, place in zip(body.joints, body.arm.home, strict=True):
            if joint.part == "arm":
                places[joint.name] = place
        if (aside := postures[self._gone]) is not None:
            places[first.name] = aside
        self._gone += 1
        self._since = None
        return places


def located(
    things: Mapping[str, Solid],
    seen: tuple[SeenSolid, ...],
    held: int | None = None,
    floor: float = 0.0,
) -> tuple[dict[str, Solid], dict[str, int]]:
    """Return where things are, those without a place by what is seen; without what is not seen.

    All else that is seen nearby is in the way, by the name `seen` with its number. What the gripper
    has `held` since it was seen with that number stands there no more. Heights are seen from the
    floor, which is at `floor` [m] in the frame of the arm's model. The second result has the
    numbers of things that are where they are seen.
    """
    given = {name: one for name, one in things.items() if one.at}
    left = [one for one in seen if one.id != held]
    left = [one for one in left if not any(_stands(one, other) for other in given.values())]
    found: dict[str, Solid] = {}
    numbers: dict[str, int] = {}
    for name, wanted in things.items():
        if wanted.at is None and (one := next((one for one in left if _fits(wanted, one)), None)):
            left.remove(one)
            found[name], numbers[name] = _placed(wanted, one), one.id
    for one in left:
        if math.hypot(*one.position[:2]) < NEAR_M:
            found[f"seen {one.id}"] = _as_seen(one)
    return given | {name: _raised(one, floor) for name, one in found.items()}, numbers


def unseen(do: ArmAction, things: Mapping[str, Solid], known: Mapping[str, Solid]) -> str | None:
    """Return the name of the thing that an action needs, if it is one that is not `known`."""
    thing = thing_meant(do)
    return None if thing in known or thing not in things else thing


def still_stands(seen: tuple[SeenSolid, ...], number: int | None, held_ticks: int) -> bool:
    """Return whether what is held for so long was seen standing since, by its number."""
    since_s = (held_ticks - SEEN_AFTER_TICKS) * TICK_S
    return any(one.id == number and one.age < since_s for one in seen)


def approach(thing: "Thing | None", stand_off: float | None) -> Target | None:
    """Return a thing that the body should stand so far from [m], in the body's frame."""
    if thing is None or stand_off is None:
        return None
    x, y, _ = thing.position.tolist()
    radius = float(math.hypot(*thing.half[:2]))
    return Target(name=thing.name, x=x, y=y, radius=radius, away=stand_off)


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


def _as_seen(one: SeenSolid) -> Solid:
    shape = {one.shape: one.size if len(one.size) > 1 else one.size[0]}
    return Solid(**shape, at=one.position, yaw=one.yaw)  # type: ignore[arg-type]


def _placed(wanted: Solid, one: SeenSolid) -> Solid:
    """Return a thing where it is seen, by its own lengths where they are given."""
    lengths = _lengths(wanted)
    if lengths is None:
        return _as_seen(one)
    x, y, _ = one.position
    long, wide, _ = _seen_lengths(one)
    turned = (long - wide) * (lengths[0] - lengths[1]) < 0.0  # its longer side is the other one
    yaw = one.yaw + (math.pi / 2 if turned else 0.0)
    return replace(wanted, at=(x, y, lengths[2] / 2), yaw=yaw, label=None)


def _raised(solid: Solid, by: float) -> Solid:
    assert solid.at
    x, y, z = solid.at
    return replace(solid, at=(x, y, z + by))
