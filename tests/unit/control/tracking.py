"""A plant that answers late, and trajectories for control to keep to."""

import math
from collections import deque
from collections.abc import Callable

from msgspec.structs import replace

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import ActuationModel, CmdVel, Intent, TrajectoryPoint
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.control.node import ControlInputs, ControlMemory, step
from gigabrain_zenoh.geometry.pose import compose, relative
from gigabrain_zenoh.testing.samples import WAFFLE, state

AGILE = replace(
    WAFFLE, max_linear_speed=1.0, max_linear_acceleration=2.0, max_angular_acceleration=6
)
SLOW = ActuationModel(delay=0.1, lag=0.15)

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

    def intent(self, tick: int, response: ActuationModel, *, follow: bool = True) -> Intent:
        """Return the intent of a tick: the next 2 s of the course, relative to its pose now."""
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
    """Control, and a body with a delay and a first-order lag, at rest at first."""

    def __init__(
        self,
        body: BodyDescription = AGILE,
        response: ActuationModel = SLOW,
        *,
        gain: float = 1.0,
        slip: float = 1.0,
    ) -> None:
        self.body, self.memory, self.tick = body, ControlMemory(), 0
        self.pose, self.velocity = Pose(x=0.0, y=0.0, yaw=0.0), Velocity()
        self._delayed = deque([CmdVel(linear_x=0.0)] * round(response.delay / 0.02))
        self._follows = 1 - math.exp(-0.02 / response.lag) if response.lag else 1.0
        self._gain, self._slip = gain, slip

    def go(self, intent: Intent | None, caps: SpeedCaps | None = None) -> CmdVel:
        """One tick."""
        self.tick += 1
        pose, v = self.pose, self.velocity
        now = state(self.tick, pose=(pose.x, pose.y, pose.yaw))
        inputs = ControlInputs(
            state=replace(now, velocity=v), intent=intent, caps=caps or SpeedCaps()
        )
        self.memory, command = step(self.body, self.memory, inputs)
        self._delayed.append(command)
        acts, share = self._delayed.popleft(), self._follows
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
        return command


def errors(
    course: Course,
    plant: Plant,
    seconds: float,
    *,
    follow: bool = True,
    response: ActuationModel = SLOW,
    late: int = 1,
) -> list[float]:
    """Return the distance of the body from its place on the course, tick by tick [m].

    Ten intents a second are sent. Each was made `late` ticks before, as decision takes time.
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
