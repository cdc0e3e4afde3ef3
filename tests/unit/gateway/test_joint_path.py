"""Trajectories of joints from ROS: what is refused, with its code, and what is between points."""

import math
from typing import Any

import numpy as np
import pytest

from gigabrain_zenoh.gateway.joint_path import Code, Unfit, judged, tolerances
from gigabrain_zenoh.geometry.joint_ramp import JointPoint
from tests.ros2.nodes import types
from tests.unit.control.arm import arm_body

BODY = arm_body()  # pan and lift: 1.5 rad both ways, 2 rad/s, 20 rad/s2
HERE = (JointPoint(0.0), JointPoint(0.5))
NOW_NS = 1_000_000_000_000
NAN, INF = math.nan, math.inf


def point(t: float, *positions: float, **fields: Any) -> dict[str, Any]:
    sec = math.floor(t)
    since = {"sec": sec, "nanosec": round((t - sec) * 1e9)}
    rest = {name: np.array(values, float) for name, values in fields.items()}
    return {"time_from_start": since, "positions": np.array(positions, float), **rest}


def trajectory(*points: dict[str, Any], names: Any = ("pan", "lift"), stamp_s: float = 0.0) -> Any:
    made = [types().make("trajectory_msgs/msg/JointTrajectoryPoint", **one) for one in points]
    stamp = {"sec": int(stamp_s), "nanosec": round(stamp_s % 1 * 1e9)}
    return types().make(
        "trajectory_msgs/msg/JointTrajectory",
        header={"stamp": stamp},
        joint_names=list(names),
        points=made,
    )


def path_of(message: Any, now: tuple[JointPoint, ...] = HERE) -> Any:
    return judged(BODY, message, now, NOW_NS)[0]


def test_positions_alone_are_joined_by_straight_lines_from_where_joints_are() -> None:
    path = path_of(trajectory(point(1.0, 1.0, 0.5), point(2.0, 1.0, -0.5)))
    assert path.seconds == 2.0
    positions, velocities = path.at(0.25)
    assert positions == pytest.approx([0.25, 0.5])
    assert velocities == pytest.approx([1.0, 0.0])
    positions, velocities = path.at(1.5)
    assert positions == pytest.approx([1.0, 0.0])
    assert velocities == pytest.approx([0.0, -1.0])
    assert path.at(-1.0)[0] == pytest.approx([0.0, 0.5])
    positions, velocities = path.at(7.0)
    assert positions == pytest.approx([1.0, -0.5])
    assert velocities == pytest.approx([0.0, 0.0])


def test_velocities_make_cubics_from_the_present_velocity() -> None:
    moving = (JointPoint(0.0, 0.8), JointPoint(0.5))
    points = (
        point(1.0, 0.8, 0.5, velocities=(0.4, 0.0)),
        point(2.0, 1.0, 0.5, velocities=(0.0, 0.0)),
    )
    path = path_of(trajectory(*points), moving)
    assert path.at(0.0)[1][0] == pytest.approx(0.8)
    assert path.at(0.5)[0][0] == pytest.approx(0.45)  # Hermite: (p0 + p1)/2 + (v0 - v1)/8
    assert path.at(1.0)[1][0] == pytest.approx(0.4)
    assert path.at(1.0 - 1e-9)[0][0] == pytest.approx(0.8)


def test_accelerations_make_quintics() -> None:
    rest = {"velocities": (0.0, 0.0), "accelerations": (0.0, 0.0)}
    path = path_of(trajectory(point(2.0, 1.0, 0.5, **rest)))
    assert path.at(0.5)[0][0] == pytest.approx(10 / 64 - 15 / 256 + 6 / 1024)  # minimum jerk
    assert path.at(1.0)[1][0] == pytest.approx(1.875 / 2)


def test_a_first_point_at_zero_is_where_the_path_begins() -> None:
    path = path_of(trajectory(point(0.0, 0.1, 0.5), point(1.0, 1.0, 0.5)))
    assert path.at(0.0)[0] == pytest.approx([0.1, 0.5])
    assert path_of(trajectory(point(0.0, 0.1, 0.5))).seconds == 0.0
    with pytest.raises(Unfit, match=r"it starts 0\.4 from where pan is"):
        path_of(trajectory(point(0.0, 0.4, 0.5), point(1.0, 1.0, 0.5)))


def test_a_part_of_the_joints_in_any_order_is_enough() -> None:
    path = path_of(trajectory(point(1.0, 1.0), names=("lift",)))
    assert path.names == ("lift",)
    assert path.at(0.5)[0] == pytest.approx([0.75])
    assert path_of(trajectory(point(1.0, 1.0, 0.0), names=("lift", "pan"))).at(0.0)[
        0
    ] == pytest.approx([0.5, 0.0])


ROUND = point(1.0, 0.5, 0.5)
WRONG = {
    "no names": (trajectory(ROUND, names=()), Code.INVALID_JOINTS, "names no joint"),
    "an empty name": (trajectory(ROUND, names=("", "lift")), Code.INVALID_JOINTS, "no joint ''"),
    "unknown": (trajectory(ROUND, names=("pan", "tilt")), Code.INVALID_JOINTS, "'tilt'"),
    "twice": (trajectory(ROUND, names=("pan", "pan")), Code.INVALID_JOINTS, "twice"),
    "no points": (trajectory(), Code.INVALID_GOAL, "no points"),
    "no positions": (trajectory(point(1.0)), Code.INVALID_GOAL, "positions are missing"),
    "too few": (trajectory(point(1.0, 0.5)), Code.INVALID_GOAL, "expected 2 in each point, got 1"),
    "some": (trajectory(ROUND, point(2.0)), Code.INVALID_GOAL, "got 0 to 2"),
    "nan": (trajectory(point(1.0, NAN, 0.5)), Code.INVALID_GOAL, "finite"),
    "infinite": (trajectory(point(1.0, 0.5, INF)), Code.INVALID_GOAL, "finite"),
    "far": (trajectory(point(1.0, 0.5, 1.6)), Code.INVALID_GOAL, r"lift: expected -1.5 to 1.5"),
    "very far": (trajectory(point(1.0, -1e308, 0.5)), Code.INVALID_GOAL, "pan: expected"),
    "fast": (trajectory(point(0.2, 0.5, 0.5)), Code.INVALID_GOAL, "pan would have to move at 2.5"),
    "in no time": (trajectory(point(1e-9, 0.5, 0.5)), Code.INVALID_GOAL, "move at 5e.08"),
    "fast between": (
        trajectory(point(1.0, 1.4, 0.5, velocities=(0.0, 0.0))),
        Code.INVALID_GOAL,
        r"move at 2\.1",
    ),
    "overshoots": (
        trajectory(
            point(1.0, 1.4, 0.5, velocities=(1.9, 0.0)), point(2.0, 1.4, 0.5, velocities=(0, 0))
        ),
        Code.INVALID_GOAL,
        "pan: expected -1.5 to 1.5",
    ),
    "a wild velocity": (
        trajectory(
            point(1.0, 0.5, 0.5, velocities=(1e308, 0.0)), point(2.0, 0.5, 0.5, velocities=(0, 0))
        ),
        Code.INVALID_GOAL,
        "pan would have to move",
    ),
    "a wild acceleration": (
        trajectory(point(1.0, 0.5, 0.5, velocities=(0, 0), accelerations=(1e308, 0.0))),
        Code.INVALID_GOAL,
        "pan would have to accelerate",
    ),
    "moves at its end": (
        trajectory(point(1.0, 0.5, 0.5, velocities=(0.1, 0.0))),
        Code.INVALID_GOAL,
        "last point has a velocity",
    ),
    "efforts": (trajectory(point(1.0, 0.5, 0.5, effort=(1, 1))), Code.INVALID_GOAL, "efforts"),
    "backwards": (trajectory(ROUND, point(0.5, 0.4, 0.5)), Code.INVALID_GOAL, "have to rise"),
    "the same time": (trajectory(ROUND, ROUND), Code.INVALID_GOAL, "have to rise"),
    "before its start": (trajectory(point(-1.0, 0.0, 0.5)), Code.INVALID_GOAL, "have to rise"),
    "in many years": (trajectory(point(2.0**31 - 1, 0.5, 0.5)), Code.INVALID_GOAL, "have to rise"),
    "later": (trajectory(ROUND, stamp_s=1020.0), Code.INVALID_GOAL, "it begins in 20 s"),
    "over": (
        trajectory(ROUND, stamp_s=998.0), Code.OLD_HEADER_TIMESTAMP, "it ended 1.00 s ago",
    ),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_refused_with_its_code(wrong: str) -> None:
    message, code, text = WRONG[wrong]
    with pytest.raises(Unfit, match=text) as found:
        path_of(message)
    assert found.value.code is code


def test_a_stamp_says_when_it_begins_and_what_is_over_is_left_out() -> None:
    message = trajectory(ROUND, point(3.0, 1.0, 0.5), stamp_s=1000.5)
    path, waits_s = judged(BODY, message, HERE, NOW_NS)
    assert (path.seconds, waits_s) == (3.0, 0.5)
    message = trajectory(ROUND, point(3.0, 1.0, 0.5), stamp_s=998.5)
    path, waits_s = judged(BODY, message, HERE, NOW_NS)
    assert (path.seconds, waits_s) == (1.5, 0.0)
    assert path.at(0.75)[0] == pytest.approx([0.5, 0.5])


def goal(time_s: float = 0.0, **lists: dict[str, tuple[float, float]]) -> Any:
    def one(name: str, position: float, velocity: float) -> Any:
        kind = "control_msgs/msg/JointTolerance"
        return types().make(kind, name=name, position=position, velocity=velocity)

    made = {key: [one(name, *both) for name, both in each.items()] for key, each in lists.items()}
    sec = math.floor(time_s)
    return types().make(
        "control_msgs/action/FollowJointTrajectory_Goal",
        goal_time_tolerance={"sec": sec, "nanosec": round((time_s - sec) * 1e9)},
        **made,
    )


def test_tolerances_of_zero_are_the_bodys_and_of_minus_one_none() -> None:
    assert tolerances(BODY).body is BODY
    assert tolerances(BODY, goal()).body == BODY
    given = {"pan": (0.1, 0.0), "lift": (-1.0, 0.5)}
    found = tolerances(BODY, goal(2.5, path_tolerance=given, goal_tolerance={"pan": (0.0, -1.0)}))
    assert [joint.path_tolerance for joint in found.body.joints] == [0.1, 0.0]
    assert [joint.goal_tolerance for joint in found.body.joints] == [0.05, 0.05]
    assert (found.path_speeds, found.goal_speeds) == ({"lift": 0.5}, {})
    assert found.body.arm
    assert found.body.arm.goal_time == 2.5
    unlimited = tolerances(BODY, goal(-1.0)).body.arm
    assert unlimited
    assert unlimited.goal_time == 600.0


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        (goal(path_tolerance={"tilt": (0.1, 0.0)}), Code.INVALID_JOINTS),
        (goal(goal_tolerance={"": (0.1, 0.0)}), Code.INVALID_JOINTS),
        (goal(path_tolerance={"pan": (-0.5, 0.0)}), Code.INVALID_GOAL),
        (goal(goal_tolerance={"pan": (NAN, 0.0)}), Code.INVALID_GOAL),
        (goal(goal_tolerance={"pan": (0.1, INF)}), Code.INVALID_GOAL),
        (goal(-2.0), Code.INVALID_GOAL),
    ],
)
def test_tolerances_that_mean_nothing_are_refused(asked: Any, code: Code) -> None:
    with pytest.raises(Unfit) as found:
        tolerances(BODY, asked)
    assert found.value.code is code
