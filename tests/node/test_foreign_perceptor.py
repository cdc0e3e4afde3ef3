"""A package may bring its own perception step: entry point `gigabrain.perceptors`."""

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import Struct

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import DetectedObject, Intent, Objects, WorldModel
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import BODY, GOAL, PERCEIVED, SCAN, STATE, WORLD
from gigabrain_zenoh import codec
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.behaviours import Inputs, StepOutcome, StepResult
from gigabrain_zenoh.decision.detected_objects import with_objects
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.perception import perceptors
from gigabrain_zenoh.perception.perceptors import PerceptorInputs
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import BOOT, body, open_space, scan, state
from tests.node.plane import Plane, drawn

HALL = """
####################
#..................#
#..................#
#..................#
#..................#
#..................#
#..................#
####################
"""
KEY = PERCEIVED.at("people")
SOURCE = '''"""Somebody's perceptors."""

from msgspec import Struct


class PeopleConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings."""

    radius: float = 0.3  # [m]


class People:
    """Finds nobody."""

    Config = PeopleConfig

    def __init__(self, config):
        self.config = config

    def step(self, inputs):
        return ()
'''


@pytest.fixture
def package(site: Path) -> None:
    """Write two modules and their metadata into `site`, as pip does; `ghost_node` is broken."""
    info = site / "people-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: people\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[gigabrain.perceptors]\npeople = people_node:People\nghosts = ghost_node:Ghosts\n"
    )
    (site / "people_node.py").write_text(SOURCE)
    (site / "ghost_node.py").write_text("1 / 0\n")


@pytest.mark.usefixtures("package")
def test_a_perceptor_is_found_by_name_and_a_broken_one_names_its_package() -> None:
    assert perceptors.load("people").__name__ == "People"
    with pytest.raises(UnknownName, match=r"no perceptor 'peple'; did you mean 'people'\?"):
        perceptors.check_known("peple")
    with pytest.raises(ConfigError, match="perceptor 'ghosts' of ghost_node:Ghosts: ZeroDivision"):
        perceptors.load("ghosts")


class RecordingPerceptor:
    """Reports a person at the hit straight ahead, and records its inputs."""

    Config = Struct

    def __init__(self) -> None:
        self.inputs_log: list[PerceptorInputs] = []

    def step(self, inputs: PerceptorInputs) -> Sequence[DetectedObject]:
        self.inputs_log.append(inputs)
        ahead = float(inputs.scan.ranges_m[0])
        return (person(inputs.pose.x + ahead, inputs.pose.y),)


def person(x: float, y: float, **change: Any) -> DetectedObject:
    return DetectedObject(id=1, x=x, y=y, radius=0.25, label="person", **change)


def world(tick: int) -> WorldModel:
    return WorldModel(scan_ok=True, obstacle_ahead=False, boot=BOOT, tick=tick, basis=tick)


@pytest.mark.parametrize("order", ["scan world state", "state scan world", "scan state world"])
async def test_it_gets_scan_world_and_pose_of_one_tick_in_any_order_of_arrival(order: str) -> None:
    """The body is at x = tick metres; the person is always 2 m ahead of it."""
    perceptor = RecordingPerceptor()
    async with NodeBench(functools.partial(perceptors.run, perceptor)) as bench:
        await bench.ready()
        bench.send(BODY, body())
        bench.send(STATE, state(1, pose=(1.0, 0.0, 0.0)))
        for tick in (6, 11):
            for what in order.split():
                if what == "state":
                    bench.send(STATE, state(tick, pose=(float(tick), 0.0, 0.0)))
                elif what == "scan":
                    bench.send(SCAN, scan(open_space(deg_0=2.0), tick))
                else:
                    bench.send(WORLD, world(tick))
                await bench.clock.advance(0)
        sent = [msgspec.msgpack.decode(data, type=Objects)
                for key, data in bench.network.sent if key == "robot/perceived/node"]  # fmt: skip
    assert [(one.scan.basis, one.world.basis) for one in perceptor.inputs_log] == [(6, 6), (11, 11)]
    assert [(one.basis, one.objects[0].x) for one in sent] == [(6, 8.0), (11, 13.0)]


async def test_a_world_without_its_scan_is_skipped() -> None:
    perceptor = RecordingPerceptor()
    async with NodeBench(functools.partial(perceptors.run, perceptor)) as bench:
        await bench.ready()
        bench.send(BODY, body())
        bench.send(STATE, state(6))
        bench.send(SCAN, scan(open_space(deg_0=2.0), 1))
        bench.send(WORLD, world(6))
        await bench.clock.advance(0)
    assert perceptor.inputs_log == []


def test_objects_to_avoid_join_the_obstacles_at_their_predicted_place() -> None:
    moving = person(2.0, 1.0, velocity_x=-0.5, avoid=True)
    found = {"people": Objects(objects=(moving, person(9.0, 9.0)), basis=50)}
    here = Pose(x=1.9, y=0.0, yaw=math.pi / 2)  # faces the person
    merged = with_objects(world(60), here, found)
    (one,) = merged.obstacles
    assert (one.x, one.y, one.radius) == (pytest.approx(1.9), 1.0, 0.25)
    rim = merged.points()
    assert np.hypot(rim[:, 0] - 1.0, rim[:, 1]) == pytest.approx(0.25)
    assert rim[:, 0].min() == pytest.approx(0.75)
    assert np.hypot(*(rim[1] - rim[0])) < 0.05
    assert with_objects(world(60), here, {}) == world(60)


class RecordingBehaviour:
    """Stands still, and records the objects from perceptors."""

    Config = Struct
    PARAMS: dict[str, str] = {}  # noqa: RUF012
    seen: list[dict[str, Any]] = []  # noqa: RUF012

    def __init__(self, config: Any) -> None: ...

    def configure(self, config: Any) -> None: ...

    def step(self, inputs: Inputs) -> StepResult:
        self.seen.append(dict(inputs.objects))
        return Intent(twist=Velocity(), behaviour="seeing", reason="looking"), StepOutcome()


def publish_objects(plane: Plane, *objects: DetectedObject) -> None:
    """Publish objects as a perceptor does for the newest scan, in the odometry's frame."""
    x, y, _ = plane.start
    in_odometry = tuple(msgspec.structs.replace(one, x=one.x - x, y=one.y - y) for one in objects)
    found = Objects(objects=in_odometry, boot=BOOT, tick=plane.tick, basis=plane.tick)
    plane.bench.network.deliver(KEY, codec.encode(found))


async def test_a_behaviour_gets_objects_until_their_perceptor_falls_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(behaviours.SHIPPED, "seeing", RecordingBehaviour)
    RecordingBehaviour.seen.clear()
    async with Plane(drawn(HALL), config=DecisionConfig(behaviour="seeing")) as plane:
        await plane.go(0.2)
        publish_objects(plane, person(3.0, 1.0))
        await plane.go(0.2)
        assert [one.label for one in RecordingBehaviour.seen[-1]["people"].objects] == ["person"]
        await plane.go(0.6)
        assert RecordingBehaviour.seen[-1] == {}
    assert RecordingBehaviour.seen[0] == {}


@pytest.mark.parametrize(("avoid", "clear"), [(False, False), (True, True)])
async def test_the_planner_keeps_clear_only_of_objects_to_avoid(avoid: bool, clear: bool) -> None:
    """The object is half way to the goal, and no beam hits it."""
    closest = math.inf
    async with Plane(drawn(HALL), at=(1.0, 1.0, 0.0)) as plane:
        await plane.go(0.2)
        await plane.ask(GOAL, GoalRequest(x=4.0, y=1.0, source="ann"))
        while not plane.status.done and plane.tick < 3000:
            publish_objects(plane, person(2.5, 1.0, avoid=avoid))
            await plane.go(0.1)
            closest = min(closest, math.hypot(plane.x - 2.5, plane.y - 1.0))
        assert plane.status.done[0].state == "succeeded"
    assert (closest > 0.25 + 0.155) is clear
