"""Tests of the judge itself: rclpy programs find each other, and leave no process behind."""

import os

import pytest

from tests.ros2.judge import Ended, Judge, free_domain, is_free

TWIST = "geometry_msgs/msg/Twist"
NAVIGATE = {"action": "/navigate_to_pose", "type": "nav2_msgs/action/NavigateToPose"}
SERVICE = {"service": "/estop", "type": "std_srvs/srv/SetBool"}


def test_a_program_receives_values_of_another_with_rates_and_endpoints(judge: Judge) -> None:
    listen = judge.start("listen", node="ears")
    listen.ask("subscribe", topic="/cmd_vel", type=TWIST, qos={"depth": 5})
    drive = judge.start("drive", node="hands", namespace="/left")
    drive.ask("drive", linear=0.25, angular=-0.5, hz=20)
    report = listen.poll("report", lambda found: found["count"] >= 10, topic="/cmd_vel")
    assert report["values"][0]["linear"] == {"x": 0.25, "y": 0.0, "z": 0.0}
    assert report["values"][0]["angular"]["z"] == -0.5
    assert len(report["times_ns"]) == report["count"]
    found = listen.ask("endpoints", topic="/cmd_vel")
    (publisher,), (subscriber,) = found["publishers"], found["subscribers"]
    assert (publisher["node"], publisher["namespace"]) == ("hands", "/left")
    assert publisher["hash"].startswith("RIHS01_9c45bf16")
    assert (subscriber["node"], subscriber["reliable"]) == ("ears", True)


def test_a_service_call_reports_values_and_duration(judge: Judge) -> None:
    serve = judge.start("serve")
    serve.ask("service", **SERVICE, success=True, message="stopped")
    call = judge.start("call", node="caller")
    call.poll("available", lambda answer: answer["available"], **SERVICE)
    call.ask("call", **SERVICE, data=True)
    response = call.wait("response")
    assert response["value"] == {"success": True, "message": "stopped"}
    assert response["took_s"] > 0
    assert serve.wait("request")["value"] == {"data": True}


def test_goals_are_followed_cancelled_and_preempted(judge: Judge) -> None:
    serve = judge.start("serve")
    steps = [{"distance_remaining": float(metres)} for metres in range(200, 0, -1)]
    serve.ask("action", **NAVIGATE, feedback=steps, hz=50)
    client = judge.start("navigate", node="client")
    client.poll("available", lambda answer: answer["available"], **NAVIGATE)
    goal = {"pose": {"header": {"frame_id": "map"}, "pose": {"position": {"x": 1.5}}}}
    client.ask("send", **NAVIGATE, name="first", goal=goal)
    client.wait("accepted", name="first")
    assert serve.wait("goal")["value"]["pose"]["pose"]["position"]["x"] == 1.5
    assert client.wait("feedback", name="first")["value"]["distance_remaining"] > 0
    client.ask("send", **NAVIGATE, name="second", goal=goal)
    assert client.wait("result", name="first")["status"] == "aborted"
    client.wait("feedback", name="second")
    client.ask("cancel", name="second")
    assert client.wait("cancelled", name="second")["goals"] == 1
    assert client.wait("result", name="second")["status"] == "canceled"


def test_a_result_has_its_error_code(judge: Judge) -> None:
    serve = judge.start("serve")
    result = {"error_code": 208, "error_msg": "no way"}
    serve.ask("action", **NAVIGATE, result=result, outcome="abort")
    client = judge.start("navigate", node="client")
    client.poll("available", lambda answer: answer["available"], **NAVIGATE)
    client.ask("send", **NAVIGATE, name="first", goal={})
    assert client.wait("result", status="aborted")["value"] == result


def test_the_graph_names_nodes_topics_and_services(judge: Judge) -> None:
    judge.start("serve", node="server", namespace="/robot").ask("service", **SERVICE)
    graph = judge.start("graph", node="viewer")
    graph.poll("graph", lambda found: "/robot/server" in found["nodes"])
    found = graph.poll("graph", lambda found: "/estop" in found["services"])
    assert found["services"]["/estop"] == ["std_srvs/srv/SetBool"]
    assert found["topics"]["/rosout"] == ["rcl_interfaces/msg/Log"]


def test_the_codec_serialises_and_deserialises_generated_types(judge: Judge) -> None:
    codec = judge.start("codec")
    hashes = codec.ask("hashes")["hashes"]
    assert hashes["std_msgs/msg/String"].startswith("RIHS01_df668c74")
    assert "control_msgs/action/FollowJointTrajectory_SendGoal" in hashes
    value = {"goal": {"behavior_tree": "here", "pose": {"header": {"frame_id": "map"}}}}
    kind = "nav2_msgs/action/NavigateToPose_SendGoal_Request"
    payload = codec.ask("serialize", type=kind, value=value)["payload"]
    back = codec.ask("deserialize", type=kind, payload=payload)["value"]
    assert back["goal"]["behavior_tree"] == "here"
    assert back["goal_id"]["uuid"] == [0] * 16


def test_a_killed_program_is_reaped_and_a_frozen_one_is_silent(judge: Judge) -> None:
    drive = judge.start("drive")
    drive.ask("drive", linear=0.1, hz=50)
    drive.wait("sent", nth=5)
    with drive.frozen():
        sent = len(drive.seen("sent"))
        with pytest.raises(TimeoutError):
            drive.wait("sent", within_s=0.3, nth=sent + 5)
    drive.wait("sent", nth=sent + 5)
    drive.kill()
    with pytest.raises(Ended, match="exit code -9"):
        drive.wait("never")
    with pytest.raises(ProcessLookupError):
        os.kill(drive.pid, 0)


def test_a_judge_leaves_no_process_behind_even_if_frozen(judge: Judge) -> None:
    programs = [judge.start("drive"), judge.start("listen")]
    with programs[0].frozen():
        judge.close()
    for program in programs:
        with pytest.raises(ProcessLookupError):
            os.kill(program.pid, 0)


def test_a_failed_command_ends_the_program_with_its_error(judge: Judge) -> None:
    listen = judge.start("listen")
    with pytest.raises(Ended, match="no_such_msgs"):
        listen.ask("subscribe", topic="/a", type="no_such_msgs/msg/A", qos={})


def test_a_domain_is_claimed_only_once_and_not_if_in_use(judge: Judge) -> None:
    with free_domain() as first, free_domain() as second:
        assert len({first, second, judge.domain}) == 3
    judge.start("graph")
    assert not is_free(judge.domain)
