"""Speed limits of joints, by what the arm must not touch. Pure functions.

A pair of shapes at the distance d approaches by Σ |g| s. Here s is the travel of a joint that
brings them together, and g the change of distance per [rad] or [m] of that joint. Until the next
verdict takes effect, each joint may gain speed for REACTION_S; then it brakes, and overshoots.
The free distance must suffice for all joints: Σ |g| (w T + w² / 2a) <= d - clearance, with speeds
w, accelerations a and T = LATE_S. Otherwise one factor scales down all these speeds.

Where joints already move, their path must be free up to where they can stop: a shape beside them
now may be ahead of them later.
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

REACTION_S = 0.06  # from a posture until the verdict on it takes effect
OVERSHOOT_S = 0.15  # a servo overshoots its setpoint by this times its speed
LATE_S = REACTION_S + OVERSHOOT_S
MIN_OVERSHOOT_SPEED = 0.3  # [rad/s] or [m/s], above an encoder's noise
MIN_SPEED = 1e-3  # [rad/s] or [m/s], of a joint that moves
MAX_FREE_M = 0.2  # joints at rest cannot use up more before the next verdict
MIN_LEVER = 1e-4  # [m] per [rad] or [m]; a joint with less does not count
HELD_M = 0.003  # with less free distance, a cause names what holds the arm
STEP_M, MAX_STEPS = 0.08, 10  # between postures on the path, so that no shape is skipped

Kind = Literal["self", "floor", "keep_out"]
KINDS: tuple[Kind, ...] = ("self", "floor", "keep_out")
Floats = NDArray[np.float64]


class Near(Struct, frozen=True):
    """Pairs of shapes that are near each other in several postures, sorted by posture."""

    postures: NDArray[np.int64]  # (n,), indices
    pairs: NDArray[np.int64]  # (n,), indices
    distances: Floats  # (n,) [m], negative where shapes overlap
    gradients: Floats  # (n, joints) [m] per [rad] or [m], of the distances

    def select(self, rows: slice) -> "Near":
        """Return the entries of `rows`."""
        return Near(
            self.postures[rows], self.pairs[rows], self.distances[rows], self.gradients[rows]
        )


class ArmShape(Protocol):
    """Shapes of an arm, and their distances in a posture."""

    @property
    def levers(self) -> Floats:
        """Upper bounds of the absolute gradients, (pairs, joints)."""

    def near(self, postures: Floats, within: Floats) -> Near:
        """Return the pairs that are nearer than their limits `within`, (postures, pairs) [m]."""

    def describe(self, pair: int) -> tuple[Kind, str, str]:
        """Return the kind of a pair, and the names of both shapes."""


class ArmLimits(Struct, frozen=True, kw_only=True):
    """The present speed limits of the arm's joints, and their causes."""

    caps: tuple[JointCap, ...] = ()
    causes: tuple[Cause, ...] = ()


class Brakes(Struct, frozen=True):
    """The limits of all joints as arrays (joints,)."""

    lower: Floats
    upper: Floats
    speed: Floats
    acceleration: Floats

    @classmethod
    def of(cls, joints: tuple[JointDescription, ...]) -> "Brakes":
        """Return the limits of described joints."""
        rows = [(j.lower, j.upper, j.max_speed, j.max_acceleration) for j in joints]
        return cls(*np.array(rows).T)

    def reachable(self, speeds: Floats) -> Floats:
        """Return the maximum speeds after REACTION_S [rad/s] or [m/s]."""
        gained = speeds + self.acceleration * REACTION_S
        return np.clip(gained, 0.0, self.speed)

    def stopping_distances(self, speeds: Floats) -> Floats:
        """Return the travel of joints until they rest [rad] or [m]."""
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
    """Return the caps for an arm with the setpoints `sent`, which move at `speeds`."""
    brakes, setpoint_speeds = _brakes(joints), np.array(speeds)
    measured_speeds = np.array([joint.velocity for joint in measured])
    rising = brakes.reachable(np.maximum(setpoint_speeds, measured_speeds))
    falling = brakes.reachable(-np.minimum(setpoint_speeds, measured_speeds))
    positions = [joint.position for joint in measured]
    reach = shape.levers @ brakes.stopping_distances(np.maximum(rising, falling)) + HELD_M
    reach = clearance + np.minimum(reach, MAX_FREE_M)
    overshoots = (np.abs(measured_speeds) > MIN_OVERSHOOT_SPEED) & (
        np.abs(measured_speeds) > np.abs(setpoint_speeds)
    )
    moving_speeds = np.where(overshoots, measured_speeds, setpoint_speeds)
    travel = np.where(
        moving_speeds > 0, brakes.stopping_distances(rising), -brakes.stopping_distances(falling)
    )
    travel[np.abs(moving_speeds) < MIN_SPEED] = 0.0
    longest_m = float((shape.levers @ np.abs(travel)).max(initial=0.0))
    steps = min(MAX_STEPS, math.ceil(longest_m / STEP_M))
    ends = np.arange(1, steps + 1) / max(1, steps)
    path = np.clip(np.array(sent) + ends[:, None] * travel, brakes.lower, brakes.upper)
    within = np.full((2 + steps, len(reach)), clearance)
    within[:2] = reach
    near = shape.near(np.concatenate(((sent, positions), path)), within)
    split = int(np.searchsorted(near.postures, 2))
    here, on_path = near.select(slice(split)), near.select(slice(split, None))
    caps = _Caps(brakes, len(joints))
    caps.keep_off(here, rising, falling, clearance)
    np.minimum.at(reach, here.pairs, here.distances)
    caps.stop_short(
        on_path, travel, ends[on_path.postures - 2], 1 / max(1, steps), reach, clearance
    )
    return ArmLimits(caps=caps.result(joints), causes=_held_causes(shape, here, clearance))


class _Caps:
    """Collects the lowest cap of each joint in both directions."""

    def __init__(self, brakes: Brakes, count: int) -> None:
        self._brakes = brakes
        self._rise, self._fall = np.full(count, np.inf), np.full(count, np.inf)

    def keep_off(self, near: Near, rising: Floats, falling: Floats, clearance: float) -> None:
        """Limit the speeds so that joints can stop before any pair is too near."""
        levers = np.abs(near.gradients)
        speeds = np.where(near.gradients < 0, rising, falling) * (levers > MIN_LEVER)
        in_reaction = (levers * speeds).sum(axis=1) * LATE_S
        braking = (levers * speeds * speeds / (2 * self._brakes.acceleration)).sum(axis=1)
        free = near.distances - clearance
        scale = _positive_root(braking, in_reaction, free)
        tight = in_reaction + braking > free
        for caps, signs in ((self._rise, -near.gradients), (self._fall, near.gradients)):
            counts = (signs > MIN_LEVER) & tight[:, None]
            allowed = np.where(counts, scale[:, None] * speeds, np.inf)
            np.minimum(caps, allowed.min(axis=0, initial=np.inf), out=caps)

    def stop_short(
        self, near: Near, travel: Floats, ends: Floats, step: float, free: Floats, clearance: float
    ) -> None:
        """Limit the speeds so that moving joints can stop before they get too near to a shape.

        `near` has pairs on the path of the joints. `ends` are their postures and `step` is the
        spacing, as shares of `travel`. `free` are the present distances of all pairs [m].
        """
        now, then = free[near.pairs] - clearance, near.distances - clearance
        nearer = (then < 0) & (then < now)
        reached = ends * np.maximum(0.0, now) / np.where(nearer, now - then, 1.0)
        reached = np.maximum(reached, ends - step)
        a = self._brakes.acceleration
        allowed = _positive_root(1 / (2 * a), np.array(LATE_S), reached[:, None] * np.abs(travel))
        counts = nearer[:, None] & (np.abs(near.gradients) > MIN_LEVER)
        for caps, moves in ((self._rise, travel > 0), (self._fall, travel < 0)):
            lowest = np.where(counts & moves, allowed, np.inf).min(axis=0, initial=np.inf)
            np.minimum(caps, lowest, out=caps)

    def result(self, joints: tuple[JointDescription, ...]) -> tuple[JointCap, ...]:
        """Return the caps of limited joints."""
        return tuple(
            JointCap(name=joint.name, rise=_finite(rise), fall=_finite(fall))
            for joint, rise, fall in zip(
                joints, self._rise.tolist(), self._fall.tolist(), strict=True
            )
            if min(rise, fall) < np.inf
        )


def _finite(cap: float) -> float | None:
    return cap if cap < np.inf else None


def _positive_root(square: Floats, linear: Floats, value: Floats) -> Floats:
    """Return the x >= 0 with square x² + linear x = value; 0 for a negative value."""
    value = np.maximum(value, 0.0)
    divisor = linear + np.sqrt(linear * linear + 4 * square * value)
    return np.asarray(2 * value / np.maximum(divisor, 1e-12))


def _held_causes(shape: ArmShape, here: Near, clearance: float) -> tuple[Cause, ...]:
    """Return a cause for the nearest pair of each kind that holds the arm."""
    movable = (np.abs(here.gradients) > MIN_LEVER).any(axis=1)
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
