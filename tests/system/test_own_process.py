"""A user's process that raises or hangs affects only itself, and is named everywhere."""

import asyncio
import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.safety import Health, LogRecord
from gigabrain_schemas.topics import HEALTH, LOG, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import CommandProcess, Home, free_port
from gigabrain_zenoh.testing.waiting import until

SOURCE = '''"""Bad company: raises or hangs, as the file `how` says."""

import time
from pathlib import Path

from msgspec import Struct


class Config(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings."""

    how: str


def act(config):
    how = Path(config.how)
    while how.exists():
        if how.read_text() == "raise":
            raise ValueError("as asked")
        time.sleep(0.05)


async def run(config, bus, ready):
    ready()
    async for _ in bus.clock.every(50_000_000):
        act(config)


class Perceptor:
    """The same, in each scan."""

    Config = Config

    def __init__(self, config):
        self.config = config

    def step(self, inputs):
        act(self.config)
        return ()


class Behaviour:
    """The same; else it drives."""

    Config = Config
    PARAMS = {}
    DEMO = {}

    def __init__(self, config):
        self.config = config

    def configure(self, config):
        pass

    def step(self, inputs):
        from gigabrain_schemas.base import Velocity
        from gigabrain_schemas.brain import Intent
        from gigabrain_zenoh.decision.behaviours import StepOutcome

        act(self.config)
        intent = Intent(twist=Velocity(angular_z=0.3), behaviour="bad", reason="turning")
        return intent, StepOutcome(activity="turning")
'''
ENTRY_POINTS = """[gigabrain.perceptors]
bad = bad_company:Perceptor
[gigabrain.behaviours]
bad = bad_company:Behaviour
"""


class HomeWithPackage(Home):
    """A home folder where the package is installed."""

    def __init__(self, folder: Path, site: Path) -> None:
        super().__init__(folder)
        self._site = site

    @property
    def environment(self) -> dict[str, str]:
        """Return the environment of its processes."""
        found = super().environment
        return found | {"PYTHONPATH": f"{found['PYTHONPATH']}{os.pathsep}{self._site}"}


class Robot:
    """A running robot, and its messages so far."""

    def __init__(self, home: Home, bus: Bus, up: CommandProcess, how: Path) -> None:
        self.home, self.bus, self.up, self.how = home, bus, up, how
        self.states: list[RobotState] = []
        self.health: dict[str, Health] = {}
        self.log: list[LogRecord] = []
        bus.subscribe(STATE, lambda _key, state: self.states.append(state))
        bus.subscribe(HEALTH, lambda _key, one: self.health.update({one.process: one}))
        bus.subscribe(LOG, lambda _key, one: self.log.append(one))

    async def wait_until_enabled(self) -> None:
        """Wait until the gate is enabled; forget all earlier states."""
        await until(lambda: self.states and self.states[-1].gate.mode == "enabled", "it drives")
        self.states.clear()

    def other_pids(self, name: str) -> set[int]:
        """Return the pids of all processes but one."""
        return set(self.home.processes()) - set(self.home.processes(name))

    @property
    def stop_causes(self) -> set[str]:
        """Return the causes of all stops, without commands that a busy host delayed."""
        assert self.states
        causes = {cause.text for state in self.states for cause in state.gate.causes}
        return causes - {"no valid command for 100 ms"}

    @property
    def moves(self) -> bool:
        """Return whether the gate is enabled and the robot turns."""
        now = self.states[-1]
        return now.gate.mode == "enabled" and now.velocity.angular_z > 0.25

    @property
    def problems(self) -> str:
        """Return the problems in the router's health as one text."""
        router = self.health.get("router")
        return "; ".join(one.text for one in router.problems) if router else ""


@pytest.fixture
async def start(tmp_path: Path) -> AsyncIterator[object]:
    """Start a robot with these parts of a deployment file."""
    site, how = tmp_path / "site", tmp_path / "how"
    info = site / "bad_company-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bad-company\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (site / "bad_company.py").write_text(SOURCE)
    home = HomeWithPackage(tmp_path / "home", site)
    router = f"tcp/127.0.0.1:{free_port()}"
    settings = {"how": str(how)}
    parts: dict[str, object] = {
        "mine": {"processes": {"mine": {"module": "bad_company", "settings": settings}}},
        "bad": {"perceptors": {"bad": {"settings": settings}}},
        "decision": {"decision": {"behaviour": "bad", "settings": settings}},
    }
    async with asyncio.timeout(120):
        stack = []

        async def start_robot(name: str) -> Robot:
            file = home.deployment(
                body="mock",
                router=router,
                resume="auto",
                **parts[name],  # type: ignore[arg-type]
            )
            up = home.start("up", str(file))
            session = connect(Endpoint(connect=(router,)), "test", timeout_s=None)
            stack.append(session)
            robot = Robot(home, await session.__aenter__(), up, how)
            await robot.wait_until_enabled()
            await until(lambda: home.processes(name), "it runs")
            await until(lambda: name in robot.health, "it reports")
            return robot

        try:
            yield start_robot
        finally:
            for session in stack:
                await session.__aexit__(None, None, None)
            home.close()


@pytest.mark.parametrize("name", ["mine", "bad"])
async def test_a_process_that_raises_is_named_and_restarted_while_the_robot_drives(
    name: str, start: object
) -> None:
    robot = await start(name)  # type: ignore[operator]
    other_pids, before = robot.other_pids(name), robot.home.processes(name)
    robot.how.write_text("raise")
    await until(lambda: [one for one in robot.log if one.event == "died"], "it is heard on the bus")
    (died, *_) = [one for one in robot.log if one.event == "died"]
    assert died.process == name
    assert died.text == "died of ValueError: as asked, in bad_company.py:19"
    robot.how.unlink()
    await until(lambda: robot.home.processes(name) not in ([], before), "it is restarted")
    assert robot.other_pids(name) == other_pids
    assert robot.stop_causes == set()
    await robot.wait_until_enabled()


@pytest.mark.parametrize("name", ["mine", "bad"])
@pytest.mark.slow
async def test_a_process_that_hangs_is_killed_with_its_stack_while_the_robot_drives(
    name: str, start: object
) -> None:
    robot = await start(name)  # type: ignore[operator]
    other_pids, before = robot.other_pids(name), robot.home.processes(name)
    robot.how.write_text("hang")
    await until(lambda: f"{name} is silent" in robot.problems, "the router names it")
    await until(lambda: f"{name} has made no progress for 5 s" in robot.up.out, "it is killed")
    await until(lambda: 'bad_company.py", line' in robot.up.out, "where it hung is shown")
    robot.how.unlink()
    await until(lambda: robot.home.processes(name) not in ([], before), "it is restarted")
    await until(lambda: not robot.problems, "it is well again")
    assert robot.other_pids(name) == other_pids
    assert robot.stop_causes == set()
    await robot.wait_until_enabled()
    log = await robot.home.run("log", "--process", name)
    assert f"{name} has made no progress for 5 s" in log.out


@pytest.mark.slow
async def test_a_process_that_always_raises_is_given_up_while_the_robot_drives(
    start: object,
) -> None:
    robot = await start("mine")  # type: ignore[operator]
    robot.how.write_text("raise")
    await until(lambda: "is given up: 5 deaths" in robot.up.out, "it is given up")
    await until(lambda: "mine died of ValueError: as asked" in robot.problems, "it is named")
    assert robot.stop_causes == set()
    await robot.wait_until_enabled()
    why = await robot.home.run("why")
    assert "mine died of ValueError: as asked, in bad_company.py:19" in why.out


@pytest.mark.parametrize("how", ["raise", "hang"])
async def test_a_failing_behaviour_stops_the_robot_but_no_other_process(
    how: str, start: object
) -> None:
    robot = await start("decision")  # type: ignore[operator]
    other_pids, before = robot.other_pids("decision"), robot.home.processes("decision")
    robot.how.write_text(how)
    await until(lambda: robot.states and not robot.moves, "it stands")
    named = "(behaviour 'bad')" if how == "raise" else 'bad_company.py", line'
    await until(lambda: named in robot.up.out, "the behaviour is named")
    robot.how.unlink()
    await until(lambda: robot.home.processes("decision") not in ([], before), "it is restarted")
    await until(lambda: robot.moves, "it drives again")
    assert robot.other_pids("decision") == other_pids
