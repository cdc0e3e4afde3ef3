"""Control keeps to a trajectory with a body that answers late, and brakes when it cannot."""

import math
from collections import deque
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import CmdVel, Intent, Response, TrajectoryPoint
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, STATE
from gigabrain_zenoh import control
from gigabrain_zenoh.control import Inputs, Memory, step
from gigabrain_zenoh.planar import compose, relative
from gigabrain_zenoh.tracking_control import predicted
from tests.brain_rig import WAFFLE, Bench, body, state

AGILE = replace(
    WAFFLE, max_linear_speed=1.0, max_linear_acceleration=2.0, max_angular_acceleration=6
)
SIDEWAYS = replace(AGILE, drive_type="omni", max_lateral_speed=1.0)
CAR = replace(AGILE, drive_type="ackermann", max_angular_speed=2.0)
SLOW = Response(delay=0.1, lag=0.15)

Motion = tuple[Pose, Velocity]
Path = Callable[[float], Velocity]  # velocity in the body's frame at a time [s]


class Course:
    """A path by its velocities, walked in steps of a millisecond."""

    def __init__(self, velocity: Path, seconds: float) -> None:
        self._velocity = velocity
        self.poses = [Pose(x=0.0, y=0.0, yaw=0.0)]
        for i in range(round(seconds * 1000)):
            v = velocity(i / 1000)
            move = Pose(x=v.linear_x / 1e3, y=v.linear_y / 1e3, yaw=v.angular_z / 1e3)
            self.poses.append(compose(self.poses[-1], move))

    def at(self, t: float) -> Motion:
        return self.poses[min(round(t * 1000), len(self.poses) - 1)], self._velocity(t)

    def intent(self, tick: int, response: Response, *, follow: bool = True) -> Intent:
        """What decision would say in this tick: the next 2 s, as seen from where it should be."""
        here, now = self.at(tick * 0.02)
        points = []
        for i in range(21):
            pose, v = self.at(tick * 0.02 + 0.1 * i)
            seen = relative(here, pose)
            points.append(
                TrajectoryPoint(
                    0.1 * i, seen.x, seen.y, seen.yaw, v.linear_x, v.linear_y, v.angular_z
                )
            )
        return Intent(
            twist=now,
            trajectory=tuple(points),
            follow=follow,
            response=response,
            behaviour="navigate",
            reason="because",
            boot=7,
            tick=tick,
            basis=tick,
        )


class Plant:
    """A body that answers after a delay, by and by; control, and its gate at rest at first."""

    def __init__(
        self,
        body: BodyDescription = AGILE,
        response: Response = SLOW,
        *,
        gain: float = 1.0,
        slip: float = 1.0,
    ) -> None:
        self.body, self.memory, self.tick = body, Memory(), 0
        self.pose, self.velocity = Pose(x=0.0, y=0.0, yaw=0.0), Velocity()
        self._late = deque([CmdVel(linear_x=0.0)] * round(response.delay / 0.02))
        self._follows = 1 - math.exp(-0.02 / response.lag) if response.lag else 1.0
        self._gain, self._slip = gain, slip

    def go(self, intent: Intent | None, caps: SpeedCaps | None = None) -> CmdVel:
        """One tick."""
        self.tick += 1
        pose, v = self.pose, self.velocity
        now = state(self.tick, pose=(pose.x, pose.y, pose.yaw))
        inputs = Inputs(state=replace(now, velocity=v), intent=intent, caps=caps or SpeedCaps())
        self.memory, told = step(self.body, self.memory, inputs)
        self._late.append(told)
        acts, share = self._late.popleft(), self._follows
        self.velocity = v = Velocity(
            linear_x=v.linear_x + share * (self._gain * acts.linear_x - v.linear_x),
            linear_y=v.linear_y + share * (self._gain * acts.linear_y - v.linear_y),
            angular_z=v.angular_z
            + share * (self._slip * self._gain * acts.angular_z - v.angular_z),
        )
        turned = v.angular_z * 0.02
        middle = replace(pose, yaw=pose.yaw + turned / 2)
        move = Pose(x=v.linear_x * 0.02, y=v.linear_y * 0.02, yaw=turned / 2)
        self.pose = compose(middle, move)
        return told


def errors(
    course: Course,
    plant: Plant,
    seconds: float,
    *,
    follow: bool = True,
    response: Response = SLOW,
    late: int = 1,
) -> list[float]:
    """How far the body is from where it should be, tick by tick [m]; ten intents a second.

    Decision takes its time: each intent is of `late` ticks before.
    """
    found = []
    intent = None
    for i in range(round(seconds * 50)):
        if i % 5 == 1:
            basis = max(0, plant.tick + 1 - late)
            intent = relocated(course.intent(basis, response, follow=follow), course, plant)
        plant.go(intent)
        should, _ = course.at(plant.tick * 0.02 + 0.02)
        found.append(math.hypot(plant.pose.x - should.x, plant.pose.y - should.y))
    return found


def relocated(intent: Intent, course: Course, plant: Plant) -> Intent:
    """The trajectory as the body sees it from where it really was at the basis."""
    here = plant.memory.history.at(7, intent.basis) or plant.pose
    should, _ = course.at(intent.basis * 0.02)
    seen_from = relative(here, should)
    points = []
    for point in intent.trajectory:
        seen = compose(seen_from, Pose(x=point.x, y=point.y, yaw=point.yaw))
        points.append(
            TrajectoryPoint(
                point.t, seen.x, seen.y, seen.yaw, point.linear_x, point.linear_y, point.angular_z
            )
        )
    return replace(intent, trajectory=tuple(points))


def ess(t: float) -> Velocity:
    """An S at 0.5 m/s, after half a second to get going."""
    speed = min(0.5, 1.0 * max(0.0, t - 0.2))
    return Velocity(linear_x=speed, angular_z=2 * speed * math.sin(math.tau * t / 4))


def sideways(t: float) -> Velocity:
    """A circle round something that is looked at all the while."""
    speed = min(0.4, 1.0 * max(0.0, t - 0.2))
    return Velocity(linear_y=speed, angular_z=-speed)


def back(t: float) -> Velocity:
    return replace(ess(t), linear_x=-ess(t).linear_x)


def on_the_spot(t: float) -> Velocity:
    return Velocity(angular_z=min(1.0, 2.0 * max(0.0, t - 0.2)) * math.cos(t))


def test_an_s_curve_is_driven_ten_times_as_exactly_as_with_a_twist_alone() -> None:
    course = Course(ess, 11.0)
    twist = errors(course, Plant(), 8.0, follow=False)
    follow = errors(course, Plant(), 8.0)
    assert max(twist) == pytest.approx(0.160, abs=0.01)
    assert max(follow) < 0.01


@pytest.mark.parametrize(
    ("body", "path"),
    [(AGILE, back), (SIDEWAYS, sideways), (SIDEWAYS, ess), (CAR, ess), (CAR, back)],
)
def test_every_kind_of_body_keeps_to_its_trajectory(body: BodyDescription, path: Path) -> None:
    assert max(errors(Course(path, 9.0), Plant(body), 6.0)) < 0.015


@pytest.mark.parametrize("late", [2, 5, 10])
@pytest.mark.parametrize(("body", "path"), [(AGILE, ess), (SIDEWAYS, sideways)])
def test_a_late_trajectory_begins_where_the_body_was_when_it_was_thought_of(
    body: BodyDescription, path: Path, late: int
) -> None:
    found = errors(Course(path, 9.0), Plant(body), 6.0, late=late)
    assert max(found[100:]) < 0.015  # the first of them comes when the course has begun


def test_turning_on_the_spot_it_keeps_to_the_heading() -> None:
    course, plant = Course(on_the_spot, 9.0), Plant()
    assert max(errors(course, plant, 6.0)) < 0.001
    assert plant.pose.yaw == pytest.approx(course.at(6.02)[0].yaw, abs=0.02)


@pytest.mark.parametrize("gain", [0.8, 1.2])
def test_a_body_that_goes_slower_or_faster_than_told_is_corrected(gain: float) -> None:
    assert max(errors(Course(ess, 11.0), Plant(gain=gain), 8.0)) < 0.07


@pytest.mark.parametrize("slip", [0.6, 0.8, 1.1])
def test_a_body_that_slips_as_it_turns_is_told_to_turn_more(slip: float) -> None:
    response, course = replace(SLOW, turn_gain=slip), Course(ess, 11.0)
    assert max(errors(course, Plant(slip=slip), 8.0, response=response)) < 0.02
    assert max(errors(course, Plant(slip=slip), 8.0, response=SLOW)) < 0.12


@pytest.mark.parametrize(
    "believed", [Response(delay=0.04, lag=0.15), Response(delay=0.1, lag=0.06), Response()]
)
def test_with_a_response_that_is_not_the_bodys_it_is_still_better_than_the_twist(
    believed: Response,
) -> None:
    assert max(errors(Course(ess, 11.0), Plant(), 8.0, response=believed)) < 0.1


@pytest.mark.parametrize("response", [Response(), Response(delay=0.3, lag=0.0), Response(lag=0.5)])
def test_bodies_without_delay_or_lag_and_slow_ones_are_driven_too(response: Response) -> None:
    plant = Plant(response=response)
    assert max(errors(Course(ess, 11.0), plant, 8.0, response=response)[150:]) < 0.04


def test_beside_its_trajectory_a_body_comes_back_to_it() -> None:
    course, plant = Course(ess, 11.0), Plant()
    plant.pose = Pose(x=-0.1, y=0.15, yaw=0.3)
    found = errors(course, plant, 6.0)
    assert max(found[200:]) < 0.02


def test_what_the_body_will_do_with_commands_on_their_way_is_foreseen() -> None:
    plant, seen = Plant(), []
    course = Course(ess, 11.0)
    for i in range(150):
        if i % 5 == 1:
            intent = course.intent(plant.tick, SLOW)
        seen.append((plant.pose, plant.velocity, plant.memory.told))
        plant.go(intent if i else None)
    pose, velocity, _ = seen[100]
    told = seen[101][2]  # before that state
    found = predicted(pose, velocity, told, 5, SLOW)
    later = seen[105][0]
    assert (found.x, found.y, found.yaw) == pytest.approx((later.x, later.y, later.yaw), abs=1e-3)


def test_when_the_trajectory_is_over_the_body_comes_to_rest() -> None:
    course, plant = Course(ess, 11.0), Plant()
    errors(course, plant, 3.0)
    last = course.intent(plant.tick, SLOW)
    short = replace(last, trajectory=last.trajectory[:6])  # half a second
    speeds = [plant.go(short).linear_x for _ in range(70)]
    assert speeds[10] > 0.3
    assert speeds[50:] == [0.0] * 20


def test_without_a_trajectory_it_comes_to_rest() -> None:
    plant = Plant()
    errors(Course(ess, 11.0), plant, 3.0)
    empty = replace(Course(ess, 1.0).intent(plant.tick, SLOW), trajectory=())
    assert [plant.go(empty).linear_x for _ in range(40)][30:] == [0.0] * 10


@pytest.mark.parametrize("jump", [Pose(x=0.4, y=0.0, yaw=0.0), Pose(x=0.0, y=0.0, yaw=1.2)])
def test_too_far_off_the_trajectory_it_brakes_and_says_so(jump: Pose) -> None:
    course, plant = Course(ess, 11.0), Plant()
    errors(course, plant, 3.0)
    intent = course.intent(plant.tick, SLOW)
    plant.go(relocated(intent, course, plant))
    assert not plant.memory.off_track
    plant.pose = compose(plant.pose, jump)
    before = plant.go(relocated(intent, course, plant)).linear_x
    assert plant.memory.off_track
    assert before - plant.go(relocated(intent, course, plant)).linear_x == pytest.approx(0.02)


async def test_the_process_brakes_and_says_so_once_when_it_is_too_far_off(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "gigabrain_zenoh.control")
    course, speeds = Course(lambda t: Velocity(linear_x=0.2), 6.0), []
    async with Bench(control.run) as bench:
        bench.send(BODY, body())
        x = 0.0
        for tick in range(1, 121):
            x += 0.02 * (speeds[-1] if speeds else 0.0) + (0.5 if tick in (51, 81) else 0.0)
            now = state(tick, v=speeds[-1] if speeds else 0.0, pose=(x, 0.0, 0.0))
            bench.send(STATE, now)
            basis = max(1, 10 * ((tick - 1) // 10))  # of the jump decision does not know yet
            bench.send(INTENT, replace(course.intent(basis, Response()), tick=tick))
            speeds += [command.linear_x for command in bench.sent(CMD_VEL)][-1:]
    assert [record.message for record in caplog.records] == [
        "braking: too far off the trajectory",
        "on the trajectory again",
    ] * 2
    assert speeds[48] == pytest.approx(0.2, abs=0.02)
    assert speeds[59] == 0.0
    assert speeds[79] == pytest.approx(0.2, abs=0.02)
    assert speeds[119] == pytest.approx(0.2, abs=0.02)


def test_a_basis_of_which_the_place_is_not_known_moves_nothing() -> None:
    plant = Plant()
    intent = replace(Course(ess, 11.0).intent(0, SLOW), basis=0)
    assert {plant.go(intent).linear_x for _ in range(10)} == {0.0}
    assert not plant.memory.off_track


def test_caps_of_safety_and_the_bodys_limits_hold_on_a_trajectory_too() -> None:
    course, plant = Course(lambda t: Velocity(linear_x=1.4, angular_z=2.2), 11.0), Plant()
    before, caps = 0.0, SpeedCaps(forward=0.2, rotation=0.3)
    for i in range(200):
        intent = course.intent(plant.tick, SLOW)
        told = plant.go(intent, caps if i >= 100 else None)
        assert abs(told.linear_x - before) <= 2.0 * 0.02 + 1e-9
        assert told.linear_x <= 1.0
        assert told.angular_z <= 1.82
        before = told.linear_x
    assert 0.15 < told.linear_x <= 0.2
    assert 0.2 < told.angular_z <= 0.3


def test_asked_again_within_a_tick_it_answers_the_same() -> None:
    course, plant = Course(ess, 11.0), Plant()
    errors(course, plant, 2.0)
    pose = plant.pose
    now = replace(state(plant.tick + 1, pose=(pose.x, pose.y, pose.yaw)), velocity=plant.velocity)
    inputs = Inputs(state=now, intent=course.intent(plant.tick, SLOW))
    once = step(plant.body, plant.memory, inputs)
    assert step(plant.body, once[0], inputs) == once
    without = replace(inputs, intent=None)
    assert step(plant.body, step(plant.body, plant.memory, without)[0], inputs) == once


def test_a_response_beyond_reason_makes_no_command_beyond_reason() -> None:
    plant, course = Plant(), Course(ess, 11.0)
    errors(course, plant, 2.0)
    mad = Response(delay=1e9, lag=1e9, turn_gain=1e-310)
    still = replace(course.intent(plant.tick, mad), trajectory=(TrajectoryPoint(60.0, 0, 0, 0),))
    assert max(abs(plant.go(still).linear_x) for _ in range(5)) <= 0.52
    assert all(math.isfinite(plant.go(still).angular_z) for _ in range(5))


def test_points_at_one_time_and_out_of_order_make_no_command_that_is_not_a_number() -> None:
    plant = Plant()
    errors(Course(ess, 11.0), plant, 2.0)
    point = TrajectoryPoint(0.3, 0.1, 0.0, 0.0, 0.5)
    for points in ((point,) * 4, (point, replace(point, t=0.0), replace(point, t=9.0))):
        intent = replace(Course(ess, 1.0).intent(plant.tick, SLOW), trajectory=points)
        assert all(math.isfinite(plant.go(intent).linear_x) for _ in range(30))
