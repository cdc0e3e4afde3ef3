"""A package may bring its own behaviour: entry point `gigabrain.behaviours`."""

from pathlib import Path

import pytest

from gigabrain_schemas.brain import Intent
from gigabrain_zenoh.cli.config import merged_values
from gigabrain_zenoh.cli.demo import RobotOptions
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.launch.deployment import load_deployment
from tests.node.plane import ROOM, Plane, drawn

SOURCE = '''"""Somebody's behaviours."""

from msgspec import Struct

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.behaviours import NavigationConfig
from gigabrain_zenoh.decision.behaviours import DriveCommand, StepOutcome


class SpinConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of `spin`."""

    rate: float = 0.5  # [rad/s]


class Spin:
    """Turns in place."""

    Config = SpinConfig
    PARAMS = {"rate": "a number [rad/s]"}
    DEMO = {"rate": 0.25}

    def __init__(self, config):
        self.config = config

    def configure(self, config):
        self.config = config

    def step(self, inputs):
        twist = Velocity(angular_z=self.config.rate)
        intent = Intent(twist=twist, behaviour="spin", reason="spinning")
        return intent, StepOutcome(activity="spinning")


class ThereConfig(NavigationConfig, frozen=True, kw_only=True):
    """Settings of `there`."""

    x: float
    y: float


class There:
    """Drives to the place in its settings, without being asked."""

    Config = ThereConfig
    PARAMS = {}
    DEMO = {"x": 1.0, "y": 1.0}

    def __init__(self, config):
        self.config = config

    def configure(self, config):
        self.config = config

    def step(self, inputs):
        goal = Goal(x=self.config.x, y=self.config.y)
        return inputs.drive(inputs.command or DriveCommand(-1, "goto", goal))
'''
ENTRY_POINTS = """[gigabrain.behaviours]
spin = foreign_behaviours:Spin
there = foreign_behaviours:There
"""


@pytest.fixture(autouse=True)
def package(site: Path) -> None:
    """Write the package's module and metadata into `site`, as pip does."""
    info = site / "foreign_behaviours-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: foreign-behaviours\nVersion: 1.0\n"
    )
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (site / "foreign_behaviours.py").write_text(SOURCE)


async def test_a_packaged_behaviour_drives_with_its_own_settings_and_parameters(
    tmp_path: Path,
) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text("decision: {behaviour: spin, settings: {rate: 0.4}}\n")
    config = load_deployment(file).decision
    behaviours.check(config, file)
    async with Plane(drawn(ROOM), config=config) as plane:
        await plane.go(1.0)
        assert plane.velocity.angular_z == pytest.approx(0.4)
        assert plane.bench.bus.params.change("rate", "0.1") == ("0.4", "0.1")
        await plane.go(1.0)
        assert plane.velocity.angular_z == pytest.approx(0.1)


async def test_a_packaged_behaviour_that_needs_a_map_gets_the_navigator() -> None:
    config = DecisionConfig(behaviour="there", settings={"x": 4.0, "y": 0.8})
    assert behaviours.needs_map("there")
    intents: list[Intent] = []
    async with Plane(drawn(ROOM), config=config) as plane:
        while abs(plane.x - 4.0) > 0.15 and plane.tick < 3000:
            await plane.go(0.5)
            intents.append(plane.intent)
        assert abs(plane.x - 4.0) <= 0.15
    assert {intent.behaviour for intent in intents} == {"there"}


def test_a_demo_of_a_packaged_behaviour_uses_its_settings_and_a_map() -> None:
    spin = RobotOptions(behaviour="spin").values()
    assert spin["decision"] == {"behaviour": "spin", "settings": {"rate": 0.25}}
    assert "perception" not in spin
    there = merged_values(RobotOptions(behaviour="there").values(), (), ("x=2.5",)).deployment
    assert there.decision.settings == {"x": 2.5, "y": 1.0}
    assert there.perception.mapping == "slam"


def test_name_and_settings_of_a_packaged_behaviour_are_checked() -> None:
    with pytest.raises(UnknownName, match=r"did you mean 'spin'\? known: avoid, navigate, spin, t"):
        behaviours.load("spinn")
    with pytest.raises(ConfigError, match="unknown field 'speed'; known: rate"):
        behaviours.check(DecisionConfig(behaviour="spin", settings={"speed": 1}))
