"""Motions by odometry, on a body that follows its commands with a delay and a lag."""

import math
from collections import deque

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Cause, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, GateStatus, RobotState
from gigabrain_zenoh.client.motion import OdometryMotion, Reached
from gigabrain_zenoh.errors import Unsupported
from gigabrain_zenoh.gate.causes import SAFETY_STOP
from gigabrain_zenoh.geometry.limits import clamp, limits_of

BODY = BodyDescription(
    robot_type="toy", drive_type="differential",
    footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)),
    max_linear_speed=0.3, max_angular_speed=1.5, max_linear_acceleration=0.5,
    max_linear_deceleration=0.5, max_angular_acceleration=2.0,
)  # fmt: skip
TICK_S = 0.02


class Plant:
    """A body with 80 ms of delay; the gate stops it between two ticks."""

    def __init__(self, *, yaw: float = 0.0, held: tuple[int, int] = (0, 0)) -> None:
        self._pose, self._velocity, self._tick = Pose(x=1.0, y=-2.0, yaw=yaw), Velocity(), 100
        self._sent = deque([Velocity()] * 4, maxlen=4)
        self._held = held

    @property
    def state(self) -> RobotState:
        gate = GateStatus(mode="stopping", causes=(SAFETY_STOP,)) if self._is_held else GateStatus()
        return RobotState(
            robot_type="toy", pose=self._pose, velocity=self._velocity, gate=gate,
            boot=1, tick=self._tick,
        )  # fmt: skip

    def follow(self, wanted: Velocity) -> None:
        self._sent.append(Velocity() if self._is_held else clamp(wanted, limits_of(BODY)))
        linear = _towards(self._velocity.linear_x, self._sent[0].linear_x, 0.5 * TICK_S)
        angular = _towards(self._velocity.angular_z, self._sent[0].angular_z, 2.0 * TICK_S)
        self._velocity, self._tick = Velocity(linear_x=linear, angular_z=angular), self._tick + 1
        yaw = math.remainder(self._pose.yaw + angular * TICK_S, math.tau)
        x = self._pose.x + linear * TICK_S * math.cos(yaw)
        y = self._pose.y + linear * TICK_S * math.sin(yaw)
        self._pose = Pose(x=x, y=y, yaw=yaw)

    @property
    def _is_held(self) -> bool:
        return self._held[0] <= self._tick < self._held[1]


def _towards(now: float, wanted: float, step: float) -> float:
    return now + min(max(wanted - now, -step), step)


def run(plant: Plant, distance: float = 0.0, angle: float = 0.0) -> Reached:
    motion = OdometryMotion(BODY, plant.state, distance, angle)
    for _ in range(3000):
        plant.follow(motion.step(plant.state))
        if motion.done:
            break
    return motion.result()


@pytest.mark.parametrize("distance", [0.5, -0.5, 0.05, 3.0])
def test_a_move_ends_within_two_centimetres(distance: float) -> None:
    reached = run(Plant(yaw=2.5), distance)
    assert reached.ok
    assert reached.distance == pytest.approx(distance, abs=0.02)
    assert reached.pose.x == pytest.approx(1.0 + distance * math.cos(2.5), abs=0.02)
    assert reached.held_back == ()


@pytest.mark.parametrize("angle", [math.pi / 2, -math.pi, math.tau, 0.1])
def test_a_turn_ends_within_two_degrees_whatever_the_heading(angle: float) -> None:
    reached = run(Plant(yaw=3.0), angle=angle)
    assert reached.ok
    assert reached.angle == pytest.approx(angle, abs=math.radians(2))


def test_a_stop_on_the_way_is_named_and_the_motion_continues() -> None:
    reached = run(Plant(held=(120, 200)), 0.5)
    assert (reached.ok, reached.held_back) == (True, ("safety_stop",))


def test_a_motion_that_is_held_for_good_gives_up_and_says_how_far_it_came() -> None:
    reached = run(Plant(held=(150, 10**9)), 2.0)
    assert (reached.ok, reached.held_back) == (False, ("safety_stop",))
    assert 0.05 < reached.distance < 0.5


AHEAD = Cause(code="zone_ahead", text="obstacle ahead of the body")


@pytest.mark.parametrize(
    ("distance", "angle", "held_back"),
    [(1.0, 0.0, ("zone_ahead",)), (-1.0, 0.0, ()), (0.0, 1.0, ())],
)
def test_an_obstacle_is_named_by_a_motion_towards_it(
    distance: float, angle: float, held_back: tuple[str, ...]
) -> None:
    plant = Plant()
    motion = OdometryMotion(BODY, plant.state, distance, angle)
    motion.step(plant.state, safety=(AHEAD,))
    assert motion.result().held_back == held_back


def test_a_car_is_not_asked_to_turn_on_the_spot() -> None:
    car, start = replace(BODY, drive_type="ackermann", min_turning_radius=0.4), Plant().state
    with pytest.raises(Unsupported, match=r"toy cannot turn on the spot: .* 0\.40 m"):
        OdometryMotion(car, start, 0.0, math.pi)
    assert OdometryMotion(car, start, 0.5, 0.0).step(start).linear_x > 0
    nowhere = OdometryMotion(car, start, 0.0, 0.0)  # `move(0.0)`
    assert nowhere.step(start) == Velocity()
    assert (nowhere.done, nowhere.result().ok) == (True, True)


def test_a_motion_whose_script_was_stopped_for_a_minute_goes_on() -> None:
    plant = Plant()
    motion = OdometryMotion(BODY, plant.state, 1.0, 0.0)
    motion.step(plant.state)
    for _ in range(3000):
        plant.follow(Velocity())
    while not motion.done:
        plant.follow(motion.step(plant.state))
    assert motion.result().distance == pytest.approx(1.0, abs=0.02)
