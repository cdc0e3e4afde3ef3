"""Speed limits of joints towards what the arm must not touch. Pure functions.

A pair of shapes at the distance d comes nearer by Σ |g| s, where s are the ways of the joints that
bring them together and g the distance that a joint takes per [rad] or [m]. Until the next verdict
takes effect, each joint may gain speed for REACTION_S; then it brakes, and swings on for a little.
The free distance must be enough for all: Σ |g| (w T + w² / 2a) <= d - clearance. Where it is not,
all these speeds are scaled down by one factor. Joints that move already must also find their way
free, up to where they can rest: a shape that they only pass now may be ahead of them.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import JointDescription
from gigabrain_schemas.safety import JointCap
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.safety.catalogue import cause

REACTION_S = 0.06  # from the posture that is judged until its verdict moves the joints
SWING_S = 0.15  # how far a servo swings past where it is sent, in parts of its speed
LATE_S = REACTION_S + SWING_S
SWINGING = 0.3  # [rad/s] or [m/s], more than an encoder's noise
MOVING = 1e-3  # [rad/s] or [m/s], of a joint that is sent elsewhere
SEEN_M = 0.2  # of free distance; joints that stand still cannot take more before they are seen
NO_LEVER = 1e-4  # [m] per [rad] or [m]; a joint with less does not count
HELD_M = 0.003  # of free distance, below which a person is told what holds the arm
STEP_M, MAX_STEPS = 0.08, 10  # on the way until the joints rest, so that they pass no shape unseen

Kind = Literal["self", "floor", "keep_out"]
KINDS: tuple[Kind, ...] = ("self", "floor", "keep_out")
Floats = NDArray[np.float64]


class Near(Struct, frozen=True):
    """Pairs of shapes that are near each other in some postures, in the order of these."""

    where: NDArray[np.int64]  # (n,), the numbers of the postures
    pairs: NDArray[np.int64]  # (n,), their numbers
    distances: Floats  # (n,) [m], negative where they overlap
    gradients: Floats  # (n, joints) [m] per [rad] or [m], by which distances grow with joints

    def part(self, rows: slice) -> "Near":
        """Return some of them."""
        return Near(self.where[rows], self.pairs[rows], self.distances[rows], self.gradients[rows])


class ArmShape(Protocol):
    """Finds what is near in a posture."""

    @property
    def levers(self) -> Floats:
        """The greatest gradients that there can be, (pairs, joints), all positive."""

    def near(self, postures: Floats, within: Floats) -> Near:
        """Return each pair that is nearer than its value in `within`, (postures, pairs) [m]."""

    def describe(self, pair: int) -> tuple[Kind, str, str]:
        """Return what a pair is: its kind, and the names of both."""


class ArmLimits(Struct, frozen=True, kw_only=True):
    """The present speed limits of the arm's joints, and the causes that hold it back."""

    caps: tuple[JointCap, ...] = ()
    causes: tuple[Cause, ...] = ()


class Brakes(Struct, frozen=True):
    """The limits of all joints as arrays."""

    lower: Floats
    upper: Floats
    speed: Floats
    acceleration: Floats

    @classmethod
    def of(cls, joints: tuple[JointDescription, ...]) -> "Brakes":
        """Return those of described joints."""
        rows = [(one.lower, one.upper, one.max_speed, one.max_acceleration) for one in joints]
        return cls(*np.array(rows).T)

    def reachable(self, speeds: Floats) -> Floats:
        """Return the greatest speeds that joints may have REACTION_S later [rad/s] or [m/s]."""
        gained = speeds + self.acceleration * REACTION_S
        return np.clip(gained, 0.0, self.speed)

    def way(self, speeds: Floats) -> Floats:
        """Return how far joints get at such speeds until they rest [rad] or [m]."""
        return speeds * LATE_S + speeds * speeds / (2 * self.acceleration)


_brakes = lru_cache(maxsize=4)(Brakes.of)


def limits(
    joints: tuple[JointDescription, ...],
    shape: ArmShape,
    sent: Sequence[float],
    speeds: Sequence[float],
    measured: Sequence[JointMotion],
    clearance: float,
) -> ArmLimits:
    """Return the caps for an arm that was sent to a posture at `speeds`, and is in another."""
    brakes, now = _brakes(joints), np.array(speeds)
    turning = np.array([joint.velocity for joint in measured])
    rising = brakes.reachable(np.maximum(now, turning))
    falling = brakes.reachable(-np.minimum(now, turning))
    there = [joint.position for joint in measured]
    reach = shape.levers @ brakes.way(np.maximum(rising, falling)) + HELD_M
    reach = clearance + np.minimum(reach, SEEN_M)
    swings = (np.abs(turning) > SWINGING) & (np.abs(turning) > np.abs(now))
    moving = np.where(swings, turning, now)
    ways = np.where(moving > 0, brakes.way(rising), -brakes.way(falling))
    ways[np.abs(moving) < MOVING] = 0.0
    longest = float((shape.levers @ np.abs(ways)).max(initial=0.0))
    steps = min(MAX_STEPS, math.ceil(longest / STEP_M))
    ends = np.arange(1, steps + 1) / max(1, steps)
    ahead = np.clip(np.array(sent) + ends[:, None] * ways, brakes.lower, brakes.upper)
    within = np.full((2 + steps, len(reach)), clearance)
    within[:2] = reach
    near = shape.near(np.concatenate(((sent, there), ahead)), within)
    split = int(np.searchsorted(near.where, 2))
    here, later = near.part(slice(split)), near.part(slice(split, None))
    caps = _Caps(brakes, len(joints))
    caps.keep_off(here, rising, falling, clearance)
    np.minimum.at(reach, here.pairs, here.distances)
    caps.stop_short(later, ways, ends[later.where - 2], 1 / max(1, steps), reach, clearance)
    return ArmLimits(caps=caps.result(joints), causes=_held(shape, here, clearance))


class _Caps:
    """Collects the least speed of each joint each way."""

    def __init__(self, brakes: Brakes, count: int) -> None:
        self._brakes = brakes
        self._rise, self._fall = np.full(count, np.inf), np.full(count, np.inf)

    def keep_off(self, near: Near, rising: Floats, falling: Floats, clearance: float) -> None:
        """Have the joints come to rest before any pair is too near."""
        levers = np.abs(near.gradients)
        wanted = np.where(near.gradients < 0, rising, falling) * (levers > NO_LEVER)
        in_reaction = (levers * wanted).sum(axis=1) * LATE_S
        braking = (levers * wanted * wanted / (2 * self._brakes.acceleration)).sum(axis=1)
        free = near.distances - clearance
        share = _root(braking, in_reaction, free)
        tight = in_reaction + braking > free
        for caps, signs in ((self._rise, -near.gradients), (self._fall, near.gradients)):
            counts = (signs > NO_LEVER) & tight[:, None]
            allowed = np.where(counts, share[:, None] * wanted, np.inf)
            np.minimum(caps, allowed.min(axis=0, initial=np.inf), out=caps)

    def stop_short(
        self, near: Near, ways: Floats, ends: Floats, step: float, free: Floats, clearance: float
    ) -> None:
        """Have moving joints stop where pairs get too near.

        They do so on the `step` that ends at `ends`, both in parts of `ways`. `free` are the
        distances of all pairs now [m].
        """
        now, then = free[near.pairs] - clearance, near.distances - clearance
        worse = (then < 0) & (then < now)
        reached = ends * np.maximum(0.0, now) / np.where(worse, now - then, 1.0)
        reached = np.maximum(reached, ends - step)
        a = self._brakes.acceleration
        allowed = _root(1 / (2 * a), np.array(LATE_S), reached[:, None] * np.abs(ways))
        counts = worse[:, None] & (np.abs(near.gradients) > NO_LEVER)
        for caps, moves in ((self._rise, ways > 0), (self._fall, ways < 0)):
            least = np.where(counts & moves, allowed, np.inf).min(axis=0, initial=np.inf)
            np.minimum(caps, least, out=caps)

    def result(self, joints: tuple[JointDescription, ...]) -> tuple[JointCap, ...]:
        """Return the caps of the joints that have one."""
        return tuple(
            JointCap(name=joint.name, rise=_finite(rise), fall=_finite(fall))
            for joint, rise, fall in zip(
                joints, self._rise.tolist(), self._fall.tolist(), strict=True
            )
            if min(rise, fall) < np.inf
        )


def _finite(cap: float) -> float | None:
    return cap if cap < np.inf else None


def _root(square: Floats, linear: Floats, value: Floats) -> Floats:
    """Return the x >= 0 with square x² + linear x = value; 0 for a negative value."""
    some = np.maximum(value, 0.0)
    below = linear + np.sqrt(linear * linear + 4 * square * some)
    return np.asarray(2 * some / np.maximum(below, 1e-12))


def _held(shape: ArmShape, here: Near, clearance: float) -> tuple[Cause, ...]:
    """Return the nearest pair of each kind that keeps the arm from going on."""
    movable = (np.abs(here.gradients) > NO_LEVER).any(axis=1)
    (held,) = np.nonzero(movable & (here.distances < clearance + HELD_M))
    nearest: dict[Kind, Cause] = {}
    for index in held[np.argsort(here.distances[held])].tolist():
        kind, first, second = shape.describe(int(here.pairs[index]))
        if kind not in nearest:
            nearest[kind] = _cause(kind, float(here.distances[index]), first, second)
    return tuple(nearest.values())


def _cause(kind: Kind, distance: float, first: str, second: str) -> Cause:
    gap = f"{distance * 1000:.0f} mm from" if distance > 0 else "in"
    return cause(f"arm_{kind}", f"{first} is {gap} {second}; it only moves away")
