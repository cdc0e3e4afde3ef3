"""The simulated TurtleBot3 behaves as the real one, even if its node is killed or frozen."""

import math
import os
from typing import Any

import pytest

from tests.ros2.judge import Event, Judge, Program, frozen

ROOM = [[-2, -1, 2, -1], [2, -1, 2, 1], [2, 1, -2, 1], [-2, 1, -2, -1]]
SENSOR = {"reliable": False}


def listening(judge: Judge, **topics: tuple[str, dict[str, Any]]) -> Program:
    listen = judge.start("listen", node="ears")
    for topic, (kind, qos) in topics.items():
        listen.ask("subscribe", topic=f"/{topic}", type=kind, qos=qos)
    return listen


def newest(listen: Program, topic: str, at_least: int = 1) -> dict[str, Any]:
    report = listen.poll("report", lambda found: found["count"] >= at_least, topic=topic)
    return dict(report["values"][-1])


def moving(robot: Program) -> Event:
    return robot.poll("truth", lambda truth: truth["speed_mps"] > 0.19)


def test_it_publishes_the_topics_of_a_turtlebot3(judge: Judge) -> None:
    judge.start("turtlebot3", walls=ROOM, start=[0.0, 0.0, math.pi / 2])
    listen = listening(
        judge,
        scan=("sensor_msgs/msg/LaserScan", SENSOR),
        odom=("nav_msgs/msg/Odometry", {}),
        imu=("sensor_msgs/msg/Imu", {}),
        battery_state=("sensor_msgs/msg/BatteryState", {}),
        joint_states=("sensor_msgs/msg/JointState", {}),
        tf=("tf2_msgs/msg/TFMessage", {}),
        tf_static=("tf2_msgs/msg/TFMessage", {"transient_local": True}),
    )
    scan = newest(listen, "/scan")
    assert (scan["header"]["frame_id"], len(scan["ranges"])) == ("base_scan", 230)
    # the lidar is 32 mm behind the middle of the robot, which faces a wall 1 m ahead
    assert scan["ranges"][0] == pytest.approx(1.032, abs=2e-3)
    assert scan["ranges"][115] == pytest.approx(0.968, abs=2e-3)
    odom = newest(listen, "/odom")
    assert (odom["header"]["frame_id"], odom["child_frame_id"]) == ("odom", "base_footprint")
    assert odom["pose"]["pose"]["position"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert newest(listen, "/battery_state")["percentage"] == pytest.approx(83.33, abs=0.01)
    assert newest(listen, "/imu")["orientation"]["z"] == pytest.approx(math.sqrt(0.5))
    joints = newest(listen, "/joint_states")
    assert joints["name"] == ["wheel_left_joint", "wheel_right_joint"]
    transforms = newest(listen, "/tf")["transforms"] + newest(listen, "/tf_static")["transforms"]
    pairs = {(each["header"]["frame_id"], each["child_frame_id"]) for each in transforms}
    assert {("odom", "base_footprint"), ("base_link", "base_scan")} <= pairs


def test_it_drives_as_commanded_and_measures_it(judge: Judge) -> None:
    robot = judge.start("turtlebot3", walls=ROOM)
    drive = judge.start("drive")
    drive.ask("drive", linear=0.209)
    truth = robot.poll("truth", lambda truth: truth["pose"][0] > 0.3)
    assert truth["speed_mps"] == pytest.approx(0.20)  # truncated to hundredths
    drive.ask("rest")
    drive.ask("drive", linear=0.0, angular=1.0)
    robot.poll("truth", lambda truth: truth["pose"][2] > 1.0)
    drive.ask("drive", linear=0.0)
    truth = robot.poll("truth", lambda found: found["turn_radps"] == found["speed_mps"] == 0)
    listen = listening(judge, odom=("nav_msgs/msg/Odometry", {}))
    place = newest(listen, "/odom", 5)["pose"]["pose"]["position"]
    assert place["x"] == pytest.approx(truth["pose"][0], abs=0.02)
    assert truth["contacts"] == 0


def test_a_wall_stops_it_and_counts_as_a_contact(judge: Judge) -> None:
    robot = judge.start("turtlebot3", walls=[[0.3, -1, 0.3, 1]])
    judge.start("drive").ask("drive", linear=0.2)
    truth = robot.poll("truth", lambda found: found["contacts"])
    assert truth["pose"][0] == pytest.approx(0.195, abs=0.01)


def test_a_silent_commander_does_not_stop_it_but_a_dead_node_does(judge: Judge) -> None:
    robot = judge.start("turtlebot3")
    drive = judge.start("drive")
    drive.ask("drive", linear=0.2)
    moving(robot)
    drive.kill()
    start = robot.ask("truth")["pose"][0]
    robot.poll("truth", lambda truth: truth["pose"][0] > start + 0.2)  # a second later
    os.kill(robot.wait("node")["pid"], 9)
    assert robot.wait("node_ended")["code"] == -9
    robot.poll("truth", lambda truth: truth["speed_mps"] == 0)
    robot.ask("start_node")
    judge.start("drive").ask("drive", linear=0.2)
    moving(robot)


def test_a_frozen_node_stops_it_until_the_next_command(judge: Judge) -> None:
    robot = judge.start("turtlebot3")
    drive = judge.start("drive")
    drive.ask("drive", linear=0.2)
    moving(robot)
    with frozen(robot.wait("node")["pid"]):
        drive.ask("rest")
        robot.poll("truth", lambda truth: truth["speed_mps"] == 0)
    drive.ask("drive", linear=0.2)
    moving(robot)


@pytest.mark.slow
def test_two_robots_with_namespaces_have_separate_topics(judge: Judge) -> None:
    left = judge.start("turtlebot3", namespace="/left", stamped=True)
    judge.start("turtlebot3", namespace="/right")
    drive = judge.start("drive")
    kind = "geometry_msgs/msg/TwistStamped"
    drive.ask("drive", linear=0.2, topic="/left/cmd_vel", type=kind)
    moving(left)
    listen = listening(judge, **{"right/scan": ("sensor_msgs/msg/LaserScan", SENSOR)})
    assert newest(listen, "/right/scan")["header"]["frame_id"] == "right/base_scan"
