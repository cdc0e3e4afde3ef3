"""A relay, the router of a second host: which hosts have one, and that the robot stays safe."""

import os
import signal
from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.probe import Probe, at_rest, probing
from gigabrain_zenoh.runtime import audit
from gigabrain_zenoh.security.authority import issue, new_fleet
from gigabrain_zenoh.testing.processes import Home, free_port
from gigabrain_zenoh.testing.waiting import until
from tests.system.test_netns import REST_TICKS, STOP_TICKS, BusRecorder

ROBOT: tuple[str, ...] = ("router", "driver", "control", "safety")
BRAIN: tuple[str, ...] = ("perception", "decision")


def configs(deployment: Deployment, host: str, folder: Path) -> dict[str, ProcessConfig]:
    specs = process_specs(deployment, host, folder, folder)
    return {s.name: msgspec.json.decode(s.config, type=ProcessConfig) for s in specs}


@pytest.mark.parametrize(
    ("processes", "relayed"),
    [
        (("perception", "decision"), True),
        (("perception", "decision", "control"), True),
        (("perception", "decision", "recorder"), True),
        (("perception",), False),
        (("recorder", "safety"), False),
        (("driver", "control", "safety", "perception", "decision"), False),
        (("router", "perception", "decision"), False),
    ],
)
def test_a_host_with_only_perception_and_decision_has_a_relay(
    processes: tuple[str, ...], relayed: bool, tmp_path: Path
) -> None:
    made = configs(Deployment(hosts={"here": processes}), "here", tmp_path)
    assert set(made) == {*processes, "relay"} if relayed else set(processes)


def test_only_the_relay_connects_to_the_router_and_others_use_its_socket(
    tmp_path: Path,
) -> None:
    deployment = Deployment(
        router="tcp/192.168.1.10:7447", insecure=True, hosts={"robot": ROBOT, "brain": BRAIN}
    )
    made = configs(deployment, "brain", tmp_path)
    (socket,) = made["relay"].endpoint.listen
    assert socket.startswith("unixsock-stream/")
    assert made["relay"].endpoint.connect == ("tcp/192.168.1.10:7447",)
    for name in BRAIN:
        assert (made[name].endpoint.connect, made[name].endpoint.listen) == ((socket,), ())
    assert list(made) == ["relay", "perception", "decision"]


async def assert_stops_without_relay(robot: Probe, *, killed: bool) -> None:
    """Kill or freeze the relay; assert that the robot stops, and drives again by itself."""
    relay = await robot.pid("relay")
    recorder = BusRecorder(robot)
    await robot.driving_straight(0.19)
    start = robot.state
    os.kill(relay, signal.SIGKILL if killed else signal.SIGSTOP)
    await robot.ticks(REST_TICKS)
    if not killed:
        os.kill(relay, signal.SIGCONT)
    await robot.driving_straight(0.15, room=0.0)
    last, first = recorder.silence(start.tick)
    assert first - last > STOP_TICKS
    late = [c.linear_x for c in recorder.commands if last + STOP_TICKS <= c.tick < first]
    assert late
    assert all(speed < 0.19 for speed in late)  # the robot slows down from the first one on
    stood = [s for s in robot.states if last + REST_TICKS <= s.tick < first]
    assert all(map(at_rest, stood))
    truth = await robot.truth()
    assert (truth["stale_commands_executed"], truth["contacts"]) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "secure",
    [
        pytest.param(False, id="bare", marks=pytest.mark.qa),
        pytest.param(True, id="with keys in a fleet"),
    ],
)
async def test_a_robot_whose_brain_loses_its_relay_stops_and_drives_again(
    secure: bool, tmp_path: Path
) -> None:
    values: dict[str, object] = {
        "router": f"tcp/127.0.0.1:{free_port()}",
        "resume": "auto",
        "hosts": {"robot": ROBOT, "brain": BRAIN},
    }
    operator, namespace = "", "red" if secure else ""
    if secure:
        fleet = tmp_path / "keys"
        new_fleet("home", fleet)
        issue(fleet, "robot", robot="red", name="robot")
        issue(fleet, "brain", robot="red", name="brain")
        operator = str(issue(fleet, "operator"))
        values |= {"keys": str(fleet), "namespace": "red", "fleet": ["blue"]}
    robots, brains = Home(tmp_path / "robot"), Home(tmp_path / "brain")
    try:
        file = str(robots.deployment(**values))
        brain = brains.start("up", file, "--host", "brain")
        await until(lambda: "waiting for it" in brain.out, "it says what it waits for")
        robots.start("up", file, "--host", "robot")
        where = Endpoint(connect=(str(values["router"]),), keys=operator, namespace=namespace)
        async with probing(where) as robot:
            await assert_stops_without_relay(robot, killed=False)
            await assert_stops_without_relay(robot, killed=True)
            for name in ("relay", *BRAIN):
                answers = await robot.bus.ask(DESCRIBE, DescribeRequest(), name=name, timeout_s=20)
                assert len(answers) == 1, name
            pressed = await brains.run("estop")
            assert "NOT CONFIRMED" not in pressed.out
            assert "CONFIRMED" in pressed.out
            await robot.ticks(75)  # until the audit of the router is on disk
        folder = robots.folder / "state" / "gigabrain" / "robots"
        folder /= namespace or "turtlebot3_waffle"
        audited = {record.what for record in audit.read_audit(folder, 1000)}
        assert "estop" in audited
        assert not audited & {"refused", "stranger"}
    finally:
        brains.close()
        robots.close()
