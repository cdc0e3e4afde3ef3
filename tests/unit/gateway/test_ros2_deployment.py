"""Deployment of the gateway to ROS: its host, settings and rights."""

import json

import pytest

from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment, load_deployment
from gigabrain_zenoh.launch.processes import grants, process_type
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.security.acl import Table

ROS = Ros2Config()


def specs(deployment, tmp_path, host="robot"):
    found = process_specs(deployment, host, tmp_path, tmp_path)
    return {spec.name: (spec, json.loads(spec.config)) for spec in found}


def test_a_part_of_the_file_starts_it_beside_the_driver_unless_it_is_placed(tmp_path):
    assert "ros2" not in specs(Deployment(), tmp_path)
    assert "ros2" in specs(Deployment(ros2=ROS), tmp_path)
    split = Deployment(
        ros2=ROS,
        router="tcp/127.0.0.1:7447",
        hosts={"robot": ("router", "driver"), "brain": ("perception", "decision")},
    )
    assert "ros2" in specs(split, tmp_path)
    assert "ros2" not in specs(split, tmp_path, "brain")
    placed = Deployment(
        ros2=ROS,
        router="tcp/127.0.0.1:7447",
        hosts={"robot": ("router", "driver"), "base": ("ros2",)},
    )
    assert "ros2" not in specs(placed, tmp_path)
    assert list(specs(placed, tmp_path, "base")) == ["ros2"]


def test_the_robot_goes_on_without_it_and_it_keeps_its_priority(tmp_path):
    spec, _ = specs(Deployment(ros2=ROS), tmp_path)["ros2"]
    assert spec.optional
    row = process_type("ros2")
    assert (row.prompt, row.stops, row.looks_on) == (True, False, False)


def test_its_ros_router_is_the_robots_own_unless_the_file_names_one(tmp_path):
    def router(**settings):
        deployment = Deployment(ros2=Ros2Config(**settings), router="tcp/127.0.0.1:7555")
        return specs(deployment, tmp_path)["ros2"][1]["settings"]["router"]

    assert router() == "tcp/127.0.0.1:7555"
    assert router(router="tcp/10.0.0.2:7447") == "tcp/10.0.0.2:7447"
    assert router(transport="dds") == ""


def test_a_router_with_keys_serves_no_nodes_of_ros(tmp_path):
    def of(**settings):
        return Deployment(ros2=Ros2Config(**settings), keys=str(tmp_path / "keys"))

    with pytest.raises(ConfigError, match="ROS nodes have no keys for this router"):
        specs(of(), tmp_path)
    assert specs(of(transport="dds"), tmp_path)["ros2"][1]["settings"]["transport"] == "dds"


def test_its_own_identity_may_command_and_ask_and_nothing_else():
    puts, queries, served = Table({}, grants=grants()).keys_of_process("ros2")
    fleet = ["tf", "battery_state", "navigate_to_pose/_action/*"]
    assert puts == ["robot/health/ros2", "robot/log", "robot/cmd_vel", "robot/estop", *fleet]
    asked = {one.removeprefix("robot/") for one in queries}
    assert asked >= {"estop", "release", "enable", "goal", "mission", "task_change", "pose_set",
                     "map_save"}  # fmt: skip
    assert asked.isdisjoint({"map_load", "zones_change", "sim_change", "param/*", "audit_log"})
    assert served == ["robot/param/ros2", "robot/describe/ros2", *fleet]
    assert process_type("ros2").roles == ("process",)


def test_open_rmf_needs_a_name_of_the_robot(tmp_path):
    fleet = Ros2Config(free_fleet=True)
    with pytest.raises(ConfigError, match="free_fleet needs the robot's namespace"):
        specs(Deployment(ros2=fleet), tmp_path)
    _, started = specs(Deployment(ros2=fleet, namespace="red"), tmp_path)["ros2"]
    assert started["settings"]["free_fleet"]
    assert started["endpoint"]["namespace"] == "red"


def written(tmp_path, text):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    return path


def test_a_file_sets_it_up_with_its_types_beside_itself(tmp_path):
    path = written(tmp_path, "ros2: {transport: dds, domain: 7, namespace: /a/b, types: [msgs]}\n")
    found = load_deployment(path).ros2
    assert (found.transport, found.domain, found.namespace) == ("dds", 7, "/a/b")
    assert found.types == (str(tmp_path / "msgs"),)
    assert load_deployment(written(tmp_path, "ros2: {}\n")).ros2 == Ros2Config()


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("ros2: {transport: udp}", "robot.yaml:1: .*rmw_zenoh"),
        ("ros2: {domain: 233}", "robot.yaml:1: .*232"),
        ("ros2: {cmd_vel_timeout: 0.3}", "robot.yaml:1: .*0.2"),
        ("hosts: {robot: [router, driver, ros2]}", "ros2 needs settings"),
        ("ros2: {free_fleet: true, leave_out: [/tf]}", "robot.yaml:1: .*free_fleet needs /tf"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_line(tmp_path, text, error):
    with pytest.raises(ConfigError, match=error):
        load_deployment(written(tmp_path, text))
