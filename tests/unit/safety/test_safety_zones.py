"""The protective field: all directions, curves, unknown sectors, and no flicker."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription, Thresholds
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.geometry.pose import PoseHistory, to_frame
from gigabrain_zenoh.geometry.sweep import depth, edges
from gigabrain_zenoh.safety.blind_spots import SECTORS
from gigabrain_zenoh.safety.zones import Motion, ProtectiveField
from gigabrain_zenoh.testing.samples import LIDAR, WAFFLE, open_space, scan, state
from tests.unit.safety.patrol import BODY, Patrol

AHEAD = Velocity(linear_x=0.2)
OMNI = replace(BODY, drive_type="omni", max_lateral_speed=0.2)


def near(degrees: int, distance: float) -> np.ndarray:
    return open_space(**{f"deg_{degrees % 360}": distance})


@pytest.mark.parametrize(
    ("degrees", "distance", "moves", "code", "cap"),
    [
        (0, 0.22, Velocity(linear_x=0.2), "zone_ahead", "forward"),
        (180, 0.34, Velocity(linear_x=-0.2), "zone_behind", "backward"),
        (90, 0.30, Velocity(linear_y=0.2), "zone_left", "left"),
        (270, 0.30, Velocity(linear_y=-0.2), "zone_right", "right"),
    ],
)
def test_each_direction_has_its_zone(
    degrees: int, distance: float, moves: Velocity, code: str, cap: str
) -> None:
    patrol = Patrol(OMNI)
    patrol.go(20, commanded=moves)
    assert patrol.go(5, commanded=moves, values=near(degrees, distance)) == [code]
    assert getattr(patrol.verdict.caps, cap) == 0.0
    assert patrol.verdict.verdict == "slow"
    others = {"forward", "backward", "left", "right"} - {cap}
    assert {getattr(patrol.verdict.caps, other) for other in others} == {None}


def test_an_obstacle_on_the_diagonal_stops_diagonal_motion_only() -> None:
    """The post is off the front left corner: neither ahead nor to the left of the body."""
    post = near(45, 0.32)
    slant, ahead, aside = Patrol(OMNI), Patrol(OMNI), Patrol(OMNI)
    for patrol, commanded in (
        (slant, Velocity(linear_x=0.2, linear_y=0.2)),
        (ahead, Velocity(linear_x=0.2)),
        (aside, Velocity(linear_y=0.2)),
    ):
        patrol.go(20, commanded=commanded)
    assert slant.go(5, commanded=Velocity(linear_x=0.2, linear_y=0.2), values=post) == [
        "zone_ahead",
        "zone_left",
    ]
    assert ahead.go(5, commanded=Velocity(linear_x=0.2), values=post) == []
    assert aside.go(5, commanded=Velocity(linear_y=0.2), values=post) == []


def test_a_body_that_cannot_go_sideways_has_no_caps_for_it() -> None:
    patrol = Patrol()
    patrol.go(5, values=near(90, 0.17))
    assert (patrol.verdict.caps.left, patrol.verdict.caps.right) == (None, None)


def test_a_turn_stops_before_a_corner_hits_an_obstacle() -> None:
    turn = Velocity(angular_z=1.0)
    values = near(-125, 0.244)
    patrol = Patrol()
    patrol.go(20, commanded=turn)
    assert patrol.go(5, commanded=turn, values=values) == ["zone_turn_left"]
    assert patrol.verdict.caps == SpeedCaps(turn_left=0.0)  # ahead, back and the other way are free


def test_an_obstacle_on_the_curve_stops_the_body() -> None:
    """The point (0.26, 0.05) is 0.185 m ahead, but 0.13 m along a left curve of 0.2 m radius."""
    curve = Velocity(linear_x=0.2, angular_z=1.0)
    values = near(11, 0.265)
    straight, curving = Patrol(), Patrol()
    straight.go(60, commanded=AHEAD)
    curving.go(60, commanded=curve)
    assert straight.go(5, commanded=AHEAD, values=values) == []
    assert curving.go(5, commanded=curve, values=values) == ["zone_ahead"]


def test_a_tight_curve_needs_a_shorter_free_distance() -> None:
    """The margin of 0.08 m is for the corner: it moves 3.6 times as far as the middle.

    At 0.05 m/s a curve of 6 cm needs 0.040 m, not 0.097 m. The posts are 0.071 and 0.036 m away.
    """
    curve = Velocity(linear_x=0.05, angular_z=0.8)
    patrol = Patrol()
    patrol.go(60, commanded=curve)
    assert patrol.go(5, commanded=curve, values=near(30, 0.21)) == []
    assert patrol.go(5, commanded=curve, values=near(-20, 0.23)) == ["zone_ahead"]


@pytest.mark.long
@pytest.mark.parametrize("angular_acceleration", [0.6, pytest.param(3.0, marks=pytest.mark.slow)])
def test_on_any_allowed_curve_the_body_stops_before_a_post(angular_acceleration: float) -> None:
    """It goes on for the reaction time, and then brakes speed and turn at its limits."""
    body = replace(BODY, max_angular_acceleration=angular_acceleration)
    posts, allowed = np.random.default_rng(1), 0
    for _ in range(400):
        degrees, distance = int(posts.integers(360)), float(posts.uniform(0.15, 0.5))
        twist = Velocity(
            linear_x=float(posts.uniform(0.03, 0.26)), angular_z=float(posts.uniform(-1.8, 1.8))
        )
        bearing = math.radians(degrees)
        post = distance * np.array((math.cos(bearing), math.sin(bearing)))
        motion = Motion(measured=twist, commanded=twist, requested=twist)
        now = state(5)
        seen = scan(near(degrees, distance), 5)
        field = ProtectiveField().then(body, seen, now, PoseHistory().then(now), motion)
        if room(body, post) > 0.03 and not field.stopped:
            allowed += 1
            assert least_room(body, twist, post) > 0.0, (twist, degrees, distance)
    assert allowed > 100


def least_room(body: BodyDescription, twist: Velocity, post: Floats) -> float:
    """Return the least distance of the body from `post` (2,) [m] until it rests."""
    v, w, x, y, yaw, nearest, dt = twist.linear_x, twist.angular_z, 0.0, 0.0, 0.0, math.inf, 0.01
    for tick in range(600):
        if tick * dt >= body.thresholds.reaction_time:
            v = max(0.0, v - body.max_linear_deceleration * dt)
            w -= math.copysign(min(abs(w), body.max_angular_acceleration * dt), w)
        x, y, yaw = x + v * math.cos(yaw) * dt, y + v * math.sin(yaw) * dt, yaw + w * dt
        nearest = min(nearest, room(body, np.array(to_frame(Pose(x=x, y=y, yaw=yaw), *post))))
    return nearest


def room(body: BodyDescription, post: Floats) -> float:
    return float(depth(edges(body.footprint), post))


def test_the_zone_depends_on_the_larger_of_measured_and_commanded_speed() -> None:
    values = near(0, 0.22)  # 0.145 m free: enough at rest, not at 0.2 m/s
    at_rest, coasting, starting = Patrol(), Patrol(), Patrol()
    assert at_rest.go(5, values=values) == []
    coasting.go(60, commanded=AHEAD)
    coasting.go(10, moves=AHEAD)  # commanded to stop, but still moving
    assert coasting.go(5, moves=AHEAD, values=values) == ["zone_ahead"]
    starting.go(10, commanded=AHEAD, moves=Velocity())  # commanded to go, but not moving yet
    assert starting.go(5, commanded=AHEAD, moves=Velocity(), values=values) == ["zone_ahead"]


def test_the_zone_does_not_flicker_before_a_wall() -> None:
    """The wall is at 0.15 m, with a noise of 1 cm: once stopped, the direction stays so."""
    patrol, rng, found = Patrol(), np.random.default_rng(1), []
    patrol.go(60, commanded=AHEAD)
    for _ in range(60):
        values = near(0, 0.075 + 0.15 + rng.normal(0.0, 0.01))
        obeyed = patrol.memory.tracking.commanded
        found.append(tuple(patrol.go(5, commanded=AHEAD, moves=obeyed, values=values)))
    closed = found.index(("zone_ahead",))
    assert set(found[closed:]) == {("zone_ahead",)}


def test_a_sector_without_beams_keeps_its_last_range() -> None:
    patrol = Patrol()
    wall = np.full(360, np.inf)
    wall[80:91] = 0.5
    patrol.go(5, values=wall)
    wall[80:91] = np.nan
    patrol.go(5, values=wall)
    sector = 80 * SECTORS // 360
    assert patrol.memory.field.sectors[sector] == pytest.approx(0.5)


def test_the_range_of_a_sector_without_beams_shrinks_as_the_body_moves() -> None:
    patrol = Patrol()
    values = np.full(360, np.inf)
    values[-12:] = values[:12] = 1.0  # a wall ahead
    patrol.go(60, commanded=AHEAD, values=values)
    values[0:10] = np.nan  # one sector of it has no valid beam any more
    found = patrol.ticks_until("zone_ahead", 300, commanded=AHEAD, values=values)
    assert found * 0.02 * 0.2 == pytest.approx(1.0 - 0.075 - 0.144, abs=0.05)


def test_that_range_shrinks_also_while_the_lidar_is_blind() -> None:
    patrol, wall, dark = Patrol(), np.full(360, 1.0), np.full(360, 1.0)
    wall[90:], dark[90:], dark[0:10] = 2.0, 2.0, np.nan
    patrol.go(20, commanded=AHEAD, values=wall)
    patrol.go(20, commanded=AHEAD, values=np.full(360, np.nan))  # 8 cm
    patrol.go(5, values=dark)  # it rests
    assert patrol.memory.field.sectors[0] == pytest.approx(0.92)


def test_a_jump_of_the_odometry_shrinks_that_range_only_by_what_the_body_can_drive() -> None:
    patrol, dark = Patrol(), np.full(360, 2.0)
    dark[10:] = 3.0
    patrol.go(5, values=dark)
    dark[0:10] = np.nan
    patrol.pose = replace(patrol.pose, x=5.0)
    patrol.go(5, values=dark)
    assert patrol.memory.field.sectors[0] == pytest.approx(2.0 - 0.1 * 0.26)


def test_a_sector_keeps_its_direction_while_the_body_turns() -> None:
    patrol = Patrol()
    values = np.full(360, np.inf)
    values[80:91] = 0.30
    patrol.go(5, values=values)
    dark = np.full(360, np.inf)
    dark[20:32] = np.nan  # the same direction, after a turn of 60 degrees to the left
    patrol.pose = replace(patrol.pose, yaw=np.pi / 3)
    patrol.go(5, values=dark)
    assert patrol.memory.field.sectors[8] == pytest.approx(0.30)
    forward = patrol.verdict.caps.forward
    assert forward is not None
    assert forward < 0.26


def test_without_an_echo_a_lidar_with_unknown_no_returns_keeps_its_last_range() -> None:
    body = replace(WAFFLE, lidar=replace(LIDAR, no_return="unknown"), thresholds=Thresholds())
    room = np.linspace(1.0, 2.0, 360)
    patrol = Patrol(body, room)
    room[30:41] = np.inf
    patrol.go(5, values=room)
    assert patrol.memory.field.sectors[3] == pytest.approx(1.083, abs=0.001)
    free = Patrol()
    free.go(5, values=room)
    assert free.memory.field.sectors[3] == np.inf


def test_a_sector_never_seen_stops_motion_towards_it() -> None:
    masked = np.full(360, np.inf)
    masked[0:10] = np.nan
    patrol = Patrol(values=masked)
    assert patrol.verdict.caps.forward == 0.0
    assert patrol.verdict.caps.turn_left is None
    assert patrol.verdict.caps.turn_right is None
