"""Faults of the way ahead: posts that are hard to see, obstacles where stopping begins, and none.

Driven blindly on a track: the physics, safety and the gate, in simulated time.
"""

import asyncio
import itertools
import math
import random
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.stop_zone import brakes
from gigabrain_zenoh.qa.faults.bodies import body_of
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.track import Track

HALF_M = 5.0  # the walls are out of sight of most lidars
RADII = (0.035, 0.010)  # [m], a leg of a person and one of a chair
FULL, HALF = 1.0, 0.5  # of the body's greatest speed
RUNS, LONG_RUNS = 6, 30  # of each way and each speed
APPROACH_TICKS, TURN_TICKS = 200, 250
AHEAD_M = (0.35, 0.6)  # from the outline, where posts stand
BESIDE_M = 0.01  # least room between a post and the outline of a body that will turn
SEEN_LATER_M = (0.0, 0.05)  # more than L(v), where an obstacle appears
PHASES, LONG_PHASES = 5, 30  # of the lidar's turn in which it does
PILLAR_M = 0.15
GAP_M = 0.03
HOLD_TICKS = 100
CORRIDOR_M, NEAR_END_M = 40.0, 36.0
CORRIDOR_TICKS, LONG_CORRIDOR_TICKS = 1500, 30_000  # half a minute, ten

Ranges = NDArray[np.float32]


class Way(NamedTuple):
    """Where a post stands, and how the body goes at it."""

    post: tuple[float, float, float]  # x, y and radius [m]
    linear_x: float  # [m/s]
    angular_z: float  # [rad/s]
    ticks: int


Draw = Callable[[BodyDescription, float, float, random.Random], Way]


async def thin_obstacles(rig: Rig) -> Measured:
    """Posts of 70 and 20 mm, seen well or badly: at half and full speed, every way."""
    contacts, chance = 0, random.Random(0)
    for share, number, draw in itertools.product(
        (HALF, FULL), range(LONG_RUNS if rig.long else RUNS), (_forward, _backward, _turning)
    ):
        contacts += await asyncio.to_thread(_contacts, body_of(rig), draw, share, number, chance)
    return {"contacts": contacts}


def _contacts(body: str, draw: Draw, share: float, number: int, chance: random.Random) -> int:
    """Of one run; every other post gives back one beam in two."""
    empty = Track(body, HALF_M, HALF_M)
    way = draw(empty.body, share, RADII[number // 2 % len(RADII)], chance)
    track = Track(body, HALF_M, HALF_M, (way.post,), number)
    if number % 2:
        track.sees = dark(np.random.default_rng(number))
    track.go(way.ticks, way.linear_x, way.angular_z)
    return int(track.simulation.truth.contacts)


def dark(chance: np.random.Generator) -> Callable[[Ranges], Ranges]:
    """A lidar to which half of what it hits gives nothing back."""

    def see(ranges: Ranges) -> Ranges:
        lost = chance.random(len(ranges)) < 0.5
        return np.where(lost, np.float32(np.inf), ranges)

    return see


def _forward(body: BodyDescription, share: float, radius: float, chance: random.Random) -> Way:
    front, half = max(x for x, _ in body.footprint), max(y for _, y in body.footprint)
    x = front + radius + chance.uniform(*AHEAD_M)
    post = (x, chance.uniform(-half, half), radius)
    return Way(post, share * body.max_linear_speed, 0.0, round(APPROACH_TICKS / share))


def _backward(body: BodyDescription, share: float, radius: float, chance: random.Random) -> Way:
    rear = -min(x for x, _ in body.footprint)
    half = max(y for _, y in body.footprint)
    post = (-rear - radius - chance.uniform(*AHEAD_M), chance.uniform(-half, half), radius)
    return Way(post, -share * body.max_linear_speed, 0.0, round(APPROACH_TICKS / share))


def _turning(body: BodyDescription, share: float, radius: float, chance: random.Random) -> Way:
    """Beside the body, where only its corners can reach."""
    half = max(y for _, y in body.footprint)
    reach = max(math.hypot(x, y) for x, y in body.footprint)
    side = chance.choice((-1, 1))
    least = half + radius + BESIDE_M
    post = (0.0, side * chance.uniform(least, max(least, reach)), radius)
    turn = chance.choice((-1, 1)) * share * body.max_angular_speed
    return Way(post, 0.0, turn, TURN_TICKS)


async def obstacle_at_stopping_distance(rig: Rig) -> Measured:
    """A pillar appears where the body must begin to stop, and goes again; then nothing is there."""
    contacts, missing_m, resumed_s = 0, 0.0, 0.0
    phases = LONG_PHASES if rig.long else PHASES
    for later_m in SEEN_LATER_M:
        for phase in range(phases):
            track = await asyncio.to_thread(_surprised, body_of(rig), later_m, phase / phases)
            truth = track.simulation.truth
            contacts += truth.contacts
            missing_m = max(missing_m, GAP_M - truth.min_clearance_m)
            resumed_s = max(resumed_s, _resumes_after_s(track))
    return {
        "contacts": contacts,
        "missing to a gap of 3 cm": missing_m,
        "false stops": await asyncio.to_thread(_false_stops, rig),
        "resume after": resumed_s,
    }


def _surprised(body: str, later_m: float, phase: float) -> Track:
    """A track whose body has stopped for a pillar that appeared at L(v) + `later_m`, and held."""
    begin = 1.5 + phase * 0.1 * Track(body, HALF_M, HALF_M).body.max_linear_speed
    track = Track(body, HALF_M, HALF_M, ((begin + PILLAR_M, 0.0, PILLAR_M),))
    front = max(x for x, _ in track.body.footprint)
    speed = track.body.max_linear_speed
    seen_m = brakes(track.body)["forward"].distance(speed) + later_m
    track.sees = nothing
    while begin - track.simulation.truth.pose().x - front > seen_m:
        track.go(1, speed)
    track.sees = np.copy
    track.go(HOLD_TICKS, speed)
    for _ in range(HOLD_TICKS):
        track.go(1, speed)
        if track.told.linear_x:
            raise Failed("it did not hold in front of an obstacle")
    return track


def nothing(ranges: Ranges) -> Ranges:
    """A lidar that sees nothing in its way."""
    return np.full_like(ranges, np.inf)


def _resumes_after_s(track: Track) -> float:
    """From the obstacle's going until the body may go on [s]."""
    track.sees = nothing
    for tick in range(HOLD_TICKS):
        track.go(1, track.body.max_linear_speed)
        if track.told.linear_x > 0:
            return tick * 0.02
    raise Failed("it did not go on when the obstacle was gone")


def _false_stops(rig: Rig) -> float:
    """The share of ticks in an empty corridor in which it was held back [%]."""
    lab = Track(body_of(rig), HALF_M, HALF_M)
    track = Track(body_of(rig), CORRIDOR_M, 2 * lab.radius)
    ticks, held, way = LONG_CORRIDOR_TICKS if rig.long else CORRIDOR_TICKS, 0, 1.0
    for _ in range(ticks):
        x = track.simulation.truth.pose().x
        if abs(x) > NEAR_END_M:
            way = -math.copysign(1.0, x)
        track.go(1, way * track.body.max_linear_speed)
        held += bool(track.said.causes) or track.gate.mode != "enabled"
    if track.simulation.truth.distance_m < 0.8 * ticks * 0.02 * track.body.max_linear_speed:
        raise Failed("it did not get along in an empty corridor")
    return 100.0 * held / ticks
