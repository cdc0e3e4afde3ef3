"""The benchmark commands on a real robot's processes, and their refusals."""

import json
from pathlib import Path

import pytest

from gigabrain_zenoh.qa.bench.peer_frameworks import COMMANDS, installed
from gigabrain_zenoh.testing.processes import Home


@pytest.mark.slow
async def test_the_latency_of_the_chain_is_measured_beside_relays(
    home: Home, tmp_path: Path
) -> None:
    """The relays of dora and rospy run where these are installed; CI has rospy."""
    report = tmp_path / "chain.json"
    options = ("--seconds", "1", "--rounds", "1", "--rates", "50", "--peers", "--json", str(report))
    command = await home.run("bench", "chain", *options)
    assert await command.ended() == 0, command.err
    result = json.loads(report.read_bytes())
    (rate,) = result["rates"]
    there = [framework.name for framework in installed()]
    assert list(rate["frameworks"]) == there
    for name in COMMANDS.keys() - {*there}:
        assert f"{name} is left out: there is no command" in command.out + command.err
    for runs in (rate["chain"], rate["relay"], [rate["peers"]], *rate["frameworks"].values()):
        assert runs[0]["n"] >= 10
        assert 0 < runs[0]["p50_ms"] <= runs[0]["p99_ms"]
    assert [hop["name"] for hop in result["hops"]] == [
        "scan → world", "world → intent", "intent → cmd_vel", "cmd_vel → driver",
    ]  # fmt: skip
    assert result["payload_bytes"][0] > 1440  # 360 beams
    assert "ratio p50" in command.out


@pytest.mark.slow
async def test_a_whole_robot_is_measured(home: Home, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    pytest.importorskip("gtsam")
    report = tmp_path / "stack.json"
    command = home.start("bench", "stack", "--seconds", "2", "--goal", "--json", str(report))
    assert await command.ended(600.0) == 0, command.err  # the first run compiles
    result = json.loads(report.read_bytes())
    names = [process["name"] for process in result["processes"]]
    assert names == ["router", "driver", "perception", "decision", "control", "safety"]
    assert all(process["rss_bytes"] > 1e7 for process in result["processes"])
    assert result["ready_s"] > 0
    assert result["physics_cpu"] > 0
    goal = result["first_goal"]
    assert goal["answer"].startswith("goal-1: ")
    assert 0 < goal["accepted_s"] < goal["drives_s"]
    assert 0 < goal["accepted_cpu_s"] <= goal["drives_cpu_s"]
    assert "physics and lidar" in command.out


@pytest.mark.slow
async def test_the_processes_of_an_arm_are_measured_while_it_moves_things(
    home: Home, tmp_path: Path
) -> None:
    pytest.importorskip("mujoco")
    report = tmp_path / "arm.json"
    options = ("--body", "so101", "--link", "emulated", "--seconds", "5", "--json", str(report))
    command = home.start("bench", "stack", *options)
    assert await command.ended(600.0) == 0, command.err
    result = json.loads(report.read_bytes())
    assert (result["world"], result["arm_hz"]) == ("table", 100.0)
    assert "emulator" in [process["name"] for process in result["processes"]]
    assert "100 commands a second to its arm" in command.out


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("chain", "--rates", "51"), "--rates: expected above 0, at most 50, got 51"),
        (("chain", "--seconds", "0"), "--seconds: expected a number above 0, got 0"),
        (("stack", "--body", "turtlebot3_wafle"), "did you mean 'turtlebot3_waffle'?"),
    ],
)
async def test_impossible_measurements_are_refused(
    home: Home, options: tuple[str, ...], complaint: str
) -> None:
    command = await home.run("bench", *options)
    assert complaint in command.err
    assert await command.ended() == 2
