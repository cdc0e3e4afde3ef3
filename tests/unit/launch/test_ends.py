"""How `demo` and `up` end: without which process, with which exit code and reason."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_zenoh.config.settings import OwnProcess
from gigabrain_zenoh.launch import demo as demo_module
from gigabrain_zenoh.launch.demo import Demo, DemoOptions
from gigabrain_zenoh.launch.deployment import ROBOT, Deployment
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.ui.run_report import RunMonitor

DEPLOYMENT = Deployment(
    router="tcp/127.0.0.1:0",
    hosts={"robot": (*ROBOT, "page", "foxglove", "mine")},
    processes={"mine": OwnProcess(module="json")},
)


class Watch(RunMonitor):
    """A monitor at whose robot each look takes one second."""

    looks = 0

    def look(self) -> None:
        self.looks += 1

    @property
    def seconds(self) -> float:
        return float(self.looks)


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Demo:
    """A demo of three seconds, whose processes are ready; none really runs."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(demo_module, "LOOK_S", 0.001)
    monkeypatch.setattr(demo_module, "ANSWER_S", 0.0)
    made = Demo(DEPLOYMENT, DemoOptions(headless=True, seconds=3.0))
    for status in made._supervisor.statuses.values():
        status.state = "ready"
    return made


@pytest.fixture
async def watch() -> AsyncIterator[Watch]:
    net = Net()
    yield Watch(net.one)
    await net.one.close()
    await net.two.close()


def give_up(demo: Demo, name: str, exit_code: int) -> None:
    """Have a demo see that a process was given up."""
    status = demo._supervisor.statuses[name]
    status.state, status.last_exit = "given up", exit_code
    text = f"{name} ended with exit code {exit_code} and is given up"
    record = {"process": "supervisor", "level": "error", "event": "given up", "text": text}
    demo._record(name, record)


@pytest.mark.parametrize("exit_code", [1, 2])
@pytest.mark.parametrize("name", ["mine", "page", "foxglove"])
async def test_a_demo_goes_on_without_a_process_that_the_robot_does_not_need(
    demo: Demo, watch: Watch, name: str, exit_code: int
) -> None:
    give_up(demo, name, exit_code)
    await demo._watch(watch, asyncio.Event())
    assert watch.seconds > 3.0


@pytest.mark.parametrize("name", ["router", "driver", "decision"])
async def test_a_demo_ends_without_a_process_that_the_robot_needs(
    demo: Demo, watch: Watch, name: str
) -> None:
    give_up(demo, name, 1)
    await demo._watch(watch, asyncio.Event())
    assert watch.seconds == 1.0
