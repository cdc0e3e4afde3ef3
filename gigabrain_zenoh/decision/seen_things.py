"""Things that cameras see near the arm, matched with the things of a mission."""

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

SIZE_TOLERANCE_M, SIZE_TOLERANCE = 0.006, 0.3  # length and share; the larger one counts
SAME_M = 0.03  # between a thing with a place and a seen one that is the same
SEEN_AFTER_TICKS = 50  # after a grip; if the thing is seen standing later, it is not held
NEAR_M = 1.0  # from the body, reach in which seen things are obstacles of the arm
LOOK_TICKS = 75  # wait at rest for a thing to be seen; pictures arrive at 5 Hz
PUT_M, PUT_TICKS = 0.06, 500  # distance and time in which a camera confirms a thing put down
ASIDE = 0.7  # share of the first joint's limits, postures in which the arm hides nothing
Lengths = tuple[float, float, float]


class SeenThings:
    """The newest things that perception has seen near the arm."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._received: deque[Solids] = deque(maxlen=2)
        self._history = PoseHistory()
        self._subscribed = False

    def observe(self, body: BodyDescription | None, state: RobotState) -> None:
        """Record the odometry; subscribe once the body is known to have an arm and a camera."""
        self._history = self._history.then(state)
        if body and body.arm and body.cameras and not self._subscribed:
            self._subscribed = True
            self._bus.latest(SOLIDS, self._received.append)

    def at(self, state: RobotState) -> tuple[SeenSolid, ...]:
        """Return the things seen before `state`, in the body's frame at `state`, nearest first.

        A replay of the same messages returns the same things.
        """
        boot, tick = state.boot, state.tick
        earlier = (
            message
            for message in reversed(self._received)
            if message.boot == boot and message.tick < tick
        )
        newest = next(earlier, None)
        old_pose = self._history.at(boot, newest.basis) if newest else None
        if newest is None or old_pose is None:
            return ()
        motion, age_s = relative(state.pose, old_pose), (tick - newest.basis) * TICK_S
        moved = []
        for solid in newest.solids:
            x, y = to_parent(motion, *solid.position[:2])
            place, yaw = (x, y, solid.position[2]), solid.yaw + motion.yaw
            moved.append(replace(solid, position=place, yaw=yaw, age=solid.age + age_s))
        return tuple(sorted(moved, key=lambda solid: math.hypot(*solid.position[:2])))


@dataclass(frozen=True, kw_only=True)
class PutDown:
    """A thing that the arm put down: it is an obstacle, even if the arm hides it from cameras."""

    name: str
    solid: Solid  # placed in the body's frame at `state`
    state: RobotState  # when it was put down

    def at(self, state: RobotState, seen: tuple[SeenSolid, ...]) -> Solid | None:
        """Return the solid in the body's current frame; None once it can be forgotten.

        That is when something is seen there, when the body drives off, or after PUT_TICKS, as a
        person may take the thing before a camera sees it.
        """
        assert self.solid.at
        motion = relative(state.pose, self.state.pose)
        x, y = to_parent(motion, *self.solid.at[:2])
        old = not 0 <= state.tick - self.state.tick < PUT_TICKS or state.boot != self.state.boot
        if old or math.hypot(x, y) > NEAR_M:
            return None
        if any(math.dist((x, y), other.position[:2]) < PUT_M for other in seen):
            return None
        return replace(self.solid, at=(x, y, self.solid.at[2]), yaw=self.solid.yaw + motion.yaw)


class Lookout:
    """Waits for a thing to be seen, and moves the arm aside so that it does not hide the thing."""

    def __init__(self) -> None:
        self._since_tick: int | None = None
        self._tried = 0  # number of postures

    def reset(self) -> None:
        """Start again, for another command."""
        self._since_tick, self._tried = None, 0

    def waits(self, tick: int) -> bool:
        """Return whether the thing may still be seen from the current posture."""
        if self._since_tick is None or tick < self._since_tick:
            self._since_tick = tick
        return tick - self._since_tick < LOOK_TICKS

    def aside(self, body: BodyDescription) -> dict[str, float] | None:
        """Return the next posture to try [rad] or [m]; None after the last one."""
        assert body.arm
        first, posture = body.joints[0], dict[str, float]()
        turns = [None, first.lower * ASIDE, first.upper * ASIDE]
        if self._tried >= len(turns):
            return None
        for joint, position in zip(body.joints, body.arm.home, strict=True):
            if joint.part == "arm":
                posture[joint.name] = position
        if (turn := turns[self._tried]) is not None:
            posture[first.name] = turn
        self._tried += 1
        self._since_tick = None
        return posture


def located(
    things: Mapping[str, Solid],
    seen: tuple[SeenSolid, ...],
    held: int | None = None,
    floor: float = 0.0,
) -> tuple[dict[str, Solid], dict[str, int]]:
    """Return all known solids by name, and the numbers of those that were found in `seen`.

    A thing without a place gets that of the first seen solid that fits, and is left out if there is
    none. Other seen solids nearby are obstacles, named `seen` with their number. The seen solid
    with the number `held` is in the gripper now, so it is left out. Seen heights are above the
    floor, which is at `floor` [m] in the frame of the arm's model.
    """
    given = {name: thing for name, thing in things.items() if thing.at}
    rest = [solid for solid in seen if solid.id != held]
    rest = [solid for solid in rest if not any(_is_at(solid, thing) for thing in given.values())]
    found: dict[str, Solid] = {}
    numbers: dict[str, int] = {}
    for name, thing in things.items():
        match = next((solid for solid in rest if _fits(thing, solid)), None)
        if thing.at is None and match:
            rest.remove(match)
            found[name], numbers[name] = _placed(thing, match), match.id
    for solid in rest:
        if math.hypot(*solid.position[:2]) < NEAR_M:
            found[f"seen {solid.id}"] = _as_seen(solid)
    return given | {name: _raised(solid, floor) for name, solid in found.items()}, numbers


def unseen(do: ArmAction, things: Mapping[str, Solid], known: Mapping[str, Solid]) -> str | None:
    """Return the name of the thing that an action needs, if it is not `known`; else None."""
    thing = thing_meant(do)
    return None if thing in known or thing not in things else thing


def still_stands(seen: tuple[SeenSolid, ...], number: int | None, held_ticks: int) -> bool:
    """Return whether cameras saw the thing `number` standing, although it counts as held."""
    since_s = (held_ticks - SEEN_AFTER_TICKS) * TICK_S
    return any(solid.id == number and solid.age < since_s for solid in seen)


def approach(thing: "Thing | None", stand_off: float | None) -> Target | None:
    """Return a target for the body, `stand_off` [m] from a thing, in the body's frame."""
    if thing is None or stand_off is None:
        return None
    x, y, _ = thing.position.tolist()
    radius = float(math.hypot(*thing.half[:2]))
    return Target(name=thing.name, x=x, y=y, radius=radius, away=stand_off)


def _is_at(seen: SeenSolid, thing: Solid) -> bool:
    return thing.at is not None and math.dist(seen.position[:2], thing.at[:2]) < SAME_M


def _fits(wanted: Solid, seen: SeenSolid) -> bool:
    """Return whether a seen solid has the wanted class, and about the wanted size."""
    if wanted.label and wanted.label != seen.label:
        return False
    lengths = _lengths(wanted)
    if lengths is None:
        return True
    pairs = zip(_by_size(lengths), _by_size(_seen_lengths(seen)), strict=True)
    return all(abs(a - b) <= max(SIZE_TOLERANCE_M, SIZE_TOLERANCE * a) for a, b in pairs)


def _by_size(lengths: Lengths) -> Lengths:
    """Return lengths with the shorter side first, and the height last."""
    x, y, z = lengths
    return min(x, y), max(x, y), z


def _lengths(solid: Solid) -> Lengths | None:
    if solid.box:
        return solid.box
    if solid.cylinder:
        radius, height = solid.cylinder
        return 2 * radius, 2 * radius, height
    return (2 * solid.sphere,) * 3 if solid.sphere else None


def _seen_lengths(seen: SeenSolid) -> Lengths:
    if seen.shape == "box":
        x, y, z = seen.size
        return x, y, z
    diameter = 2 * seen.size[0]
    return diameter, diameter, seen.size[1] if seen.shape == "cylinder" else diameter


def _as_seen(seen: SeenSolid) -> Solid:
    shape = {seen.shape: seen.size if len(seen.size) > 1 else seen.size[0]}
    return Solid(**shape, at=seen.position, yaw=seen.yaw)  # type: ignore[arg-type]


def _placed(wanted: Solid, seen: SeenSolid) -> Solid:
    """Return a wanted thing at the place of a seen solid, with its own lengths if given."""
    lengths = _lengths(wanted)
    if lengths is None:
        return _as_seen(seen)
    x, y, _ = seen.position
    seen_x, seen_y, _ = _seen_lengths(seen)
    turned = (seen_x - seen_y) * (lengths[0] - lengths[1]) < 0.0  # the longer sides are swapped
    yaw = seen.yaw + (math.pi / 2 if turned else 0.0)
    return replace(wanted, at=(x, y, lengths[2] / 2), yaw=yaw, label=None)


def _raised(solid: Solid, by: float) -> Solid:
    assert solid.at
    x, y, z = solid.at
    return replace(solid, at=(x, y, z + by))
