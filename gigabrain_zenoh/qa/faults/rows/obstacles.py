"""Obstacles: thin posts, a pillar where stopping must begin, and an empty corridor.

Driven blindly on a track: the physics, safety and the gate, in simulated time.
"""

import asyncio
import itertools
import math
import random
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.qa.faults.fault import FaultRow
from gigabrain_zenoh.qa.faults.rig.rig import Rig
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured
from gigabrain_zenoh.qa.simulated_drives import Ranges, SafetyTrack

HALF_M = 5.0  # the walls are out of sight of most lidars
RADII_M = (0.035, 0.010)  # a leg of a person and one of a chair
FULL, HALF = 1.0, 0.5  # of the body's greatest speed
RUNS, LONG_RUNS = 6, 30  # of each direction and each speed
APPROACH_TICKS, TURN_TICKS = 200, 250
AHEAD_M = (0.35, 0.6)  # from the outline to a post
ASIDE_M = 0.01  # least room between a post and the outline of a body that will turn
SEEN_LATER_M = (0.0, 0.05)  # beyond the stop distance, where an obstacle appears
PHASES, LONG_PHASES = 5, 30  # of the lidar's turn in which it does
PILLAR_M = 0.15
GAP_M = 0.03
HOLD_TICKS = 100
CORRIDOR_M, NEAR_END_M = 40.0, 36.0
CORRIDOR_TICKS, LONG_CORRIDOR_TICKS = 1500, 30_000  # half a minute, ten
TICK_S = 0.02

CONTACTS = Figure("contacts")
GAP_MISSING = Figure("missing to a gap of 3 cm", "m")
FALSE_STOPS = Figure("false stops", "%")
RESUMES = Figure("resumes after", "s")


class PostApproach(NamedTuple):
    """A post, and the command that brings the body to it."""

    post: tuple[float, float, float]  # x, y and radius [m]
    linear_x: float  # [m/s]
    angular_z: float  # [rad/s]
    ticks: int


Draw = Callable[[BodyDescription, float, float, random.Random], PostApproach]


async def thin_obstacles(rig: Rig) -> Measured:
    """Drive at posts of 70 and 20 mm, seen well or badly, at half and full speed, every way."""
    contacts, chance = 0, random.Random(0)
    for share, number, draw in itertools.product(
        (HALF, FULL), range(LONG_RUNS if rig.long else RUNS), (_forward, _backward, _turning)
    ):
        contacts += await asyncio.to_thread(_contacts, rig.body, draw, share, number, chance)
    return {CONTACTS: contacts}


def _contacts(body: str, draw: Draw, share: float, number: int, chance: random.Random) -> int:
    """Count the contacts of one run; every other post returns one beam in two."""
    empty = SafetyTrack(body, HALF_M, HALF_M)
    approach = draw(empty.body, share, RADII_M[number // 2 % len(RADII_M)], chance)
    track = SafetyTrack(body, HALF_M, HALF_M, (approach.post,), number)
    if number % 2:
        track.sees = half_lost(np.random.default_rng(number))
    track.run(approach.ticks, approach.linear_x, approach.angular_z)
    return int(track.simulation.truth.contacts)


def half_lost(chance: np.random.Generator) -> Callable[[Ranges], Ranges]:
    """Return a lidar that loses half of its hits, as of dark obstacles."""

    def see(ranges: Ranges) -> Ranges:
        lost = chance.random(len(ranges)) < 0.5
        return np.where(lost, np.float32(np.inf), ranges)

    return see


def _forward(
    body: BodyDescription, share: float, radius: float, chance: random.Random
) -> PostApproach:
    front, half = max(x for x, _ in body.footprint), max(y for _, y in body.footprint)
    x = front + radius + chance.uniform(*AHEAD_M)
    post = (x, chance.uniform(-half, half), radius)
    return PostApproach(post, share * body.max_linear_speed, 0.0, round(APPROACH_TICKS / share))


def _backward(
    body: BodyDescription, share: float, radius: float, chance: random.Random
) -> PostApproach:
    rear = -min(x for x, _ in body.footprint)
    half = max(y for _, y in body.footprint)
    post = (-rear - radius - chance.uniform(*AHEAD_M), chance.uniform(-half, half), radius)
    return PostApproach(post, -share * body.max_linear_speed, 0.0, round(APPROACH_TICKS / share))


def _turning(
    body: BodyDescription, share: float, radius: float, chance: random.Random
) -> PostApproach:
    """Put the post aside the body, where only its corners can reach."""
    half = max(y for _, y in body.footprint)
    reach = max(math.hypot(x, y) for x, y in body.footprint)
    side = chance.choice((-1, 1))
    least = half + radius + ASIDE_M
    post = (0.0, side * chance.uniform(least, max(least, reach)), radius)
    turn = chance.choice((-1, 1)) * share * body.max_angular_speed
    return PostApproach(post, 0.0, turn, TURN_TICKS)


async def obstacle_at_stopping_distance(rig: Rig) -> Measured:
    """Have a pillar appear where the body must begin to stop, and vanish again."""
    contacts, missing_m, resumed_s = 0, 0.0, 0.0
    phases = LONG_PHASES if rig.long else PHASES
    for later_m in SEEN_LATER_M:
        for phase in range(phases):
            track = await asyncio.to_thread(_surprised, rig.body, later_m, phase / phases)
            truth = track.simulation.truth
            contacts += truth.contacts
            missing_m = max(missing_m, GAP_M - truth.min_clearance_m)
            resumed_s = max(resumed_s, _resumes_after_s(track))
    return {
        CONTACTS: contacts,
        GAP_MISSING: missing_m,
        FALSE_STOPS: await asyncio.to_thread(_false_stops, rig),
        RESUMES: resumed_s,
    }


def _surprised(body: str, later_m: float, phase: float) -> SafetyTrack:
    """Stop a body before a pillar that appears at the stop distance plus `later_m`."""
    begin = 1.5 + phase * 0.1 * SafetyTrack(body, HALF_M, HALF_M).body.max_linear_speed
    track = SafetyTrack(body, HALF_M, HALF_M, ((begin + PILLAR_M, 0.0, PILLAR_M),))
    front = max(x for x, _ in track.body.footprint)
    speed = track.body.max_linear_speed
    seen_m = brakes(track.body)["forward"].distance(speed) + later_m
    track.sees = nothing
    while begin - track.simulation.truth.pose().x - front > seen_m:
        track.run(1, speed)
    track.sees = np.copy
    track.run(HOLD_TICKS, speed)
    for _ in range(HOLD_TICKS):
        track.run(1, speed)
        if track.output.linear_x:
            raise Failed("it did not hold in front of an obstacle")
    return track


def nothing(ranges: Ranges) -> Ranges:
    """Return the ranges of a lidar that sees nothing."""
    return np.full_like(ranges, np.inf)


def _resumes_after_s(track: SafetyTrack) -> float:
    """Return the time from the obstacle's vanishing until the body may drive on [s]."""
    track.sees = nothing
    for tick in range(HOLD_TICKS):
        track.run(1, track.body.max_linear_speed)
        if track.output.linear_x > 0:
            return tick * TICK_S
    raise Failed("it did not drive on when the obstacle was gone")


def _false_stops(rig: Rig) -> float:
    """Return the share of ticks in an empty corridor in which the body was held back [%]."""
    lab = SafetyTrack(rig.body, HALF_M, HALF_M)
    track = SafetyTrack(rig.body, CORRIDOR_M, 2 * lab.radius)
    ticks, held, way = LONG_CORRIDOR_TICKS if rig.long else CORRIDOR_TICKS, 0, 1.0
    for _ in range(ticks):
        x = track.simulation.truth.pose().x
        if abs(x) > NEAR_END_M:
            way = -math.copysign(1.0, x)
        track.run(1, way * track.body.max_linear_speed)
        held += bool(track.verdict.causes) or track.gate.mode != "enabled"
    if track.simulation.truth.distance_m < 0.8 * ticks * TICK_S * track.body.max_linear_speed:
        raise Failed("it did not get along in an empty corridor")
    return 100.0 * held / ticks


ROWS = (
    FaultRow(29, thin_obstacles, "", (CONTACTS.at_most(0),)),
    FaultRow(
        30, obstacle_at_stopping_distance, "",
        (CONTACTS.at_most(0), GAP_MISSING.at_most(0), FALSE_STOPS.at_most(1), RESUMES.at_most(0.3)),
    ),
)  # fmt: skip
