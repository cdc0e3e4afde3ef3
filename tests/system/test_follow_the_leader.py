"""The example `examples/follow_the_leader`: two plug-ins follow a person through a hall."""

import asyncio
import importlib
import math
import os
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import DetectedObject, Objects, WorldModel
from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.sim import SimPoses
from gigabrain_schemas.topics import DESCRIBE, SIM_POSES, STATE
from gigabrain_zenoh.decision.behaviours import Inputs
from gigabrain_zenoh.perception.perceptors import PerceptorInputs
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import Home, robot_of
from gigabrain_zenoh.testing.samples import open_space, scan
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT

EXAMPLE = ROOT / "examples/follow_the_leader"
LEADER_PATH_M = 13.0  # a round and one more corner
NEAREST_M, FARTHEST_M = 0.5, 1.2  # between the middles of two bodies of some 0.2 m radius
CAUGHT_UP_M = 1.0


class HomeWithExample(Home):
    """A home folder where the example is installed."""

    @property
    def environment(self) -> dict[str, str]:
        """Return the environment of its processes."""
        found = super().environment
        return found | {"PYTHONPATH": f"{found['PYTHONPATH']}{os.pathsep}{self.folder / 'site'}"}


def install(site: Path) -> None:
    """Copy the example into `site` and write its metadata, as pip does."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = site / "follow_the_leader-0.1.0.dist-info"
    info.mkdir(parents=True)
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {where}" for name, where in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    shutil.copy(EXAMPLE / "follow_the_leader.py", site)


def test_it_backs_away_from_a_leader_who_comes_nearer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    example = importlib.import_module("follow_the_leader")
    for away, sign in ((0.6, -1.0), (1.5, 1.0)):
        leader = DetectedObject(
            id=1, x=away, y=0.0, velocity_x=0.0, velocity_y=0.0, radius=0.25, label="leader"
        )
        objects = {"leader": Objects(objects=(leader,))}
        world = WorldModel(scan_ok=True, obstacle_ahead=False)
        inputs = Inputs(world=world, pose=Pose(x=0.0, y=0.0, yaw=0.0), objects=objects)
        intent, _ = example.Follow(example.FollowConfig()).step(inputs)
        assert math.copysign(1.0, intent.twist.linear_x) == sign


def test_a_leader_at_the_first_beam_is_found_as_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    example = importlib.import_module("follow_the_leader")
    left = [(0.9, 0.0), (0.9, 0.1), (0.9, 0.2)]
    right = [(0.9, -0.2), (0.9, -0.1)]
    behind = [(-0.9, 0.1), (-0.9, 0.0), (-0.9, -0.1)]
    found = example.clusters(np.array([*left, *behind, *right]), 0.7)
    assert [one.tolist() for one in found] == [
        [list(point) for point in (*right, *left)],
        [list(point) for point in behind],
    ]
    (alone,) = example.clusters(np.array(left), 0.7)
    assert len(alone) == 3


def inputs(x: float | None, tick: int, boot: int = 1) -> PerceptorInputs:
    """Return the inputs for a scan of one object at `x` [m] ahead or behind; None for no object."""
    body = load_robot("turtlebot3_waffle").description()
    assert body.lidar
    ranges = open_space()
    if x is not None:
        middle = 0 if x > 0 else 180
        ranges[np.arange(middle - 4, middle + 5) % 360] = abs(x - body.lidar.x)
    return PerceptorInputs(
        scan=scan(ranges, tick, boot=boot),
        world=WorldModel(scan_ok=True, obstacle_ahead=False),
        pose=Pose(x=0.0, y=0.0, yaw=0.0),
        body=body,
    )


def test_a_hidden_leader_is_not_confused_with_an_object_across_the_hall(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    example = importlib.import_module("follow_the_leader")
    leader = example.Leader(example.LeaderConfig())
    assert len(leader.step(inputs(1.0, 5))) == 1
    for hidden in range(14):
        assert leader.step(inputs(None, 10 + 5 * hidden)) == ()
    assert leader.step(inputs(-2.0, 80)) == ()
    (found,) = leader.step(inputs(1.5, 85))
    assert found.x == pytest.approx(1.65, abs=0.1)


def test_the_leader_is_searched_again_after_a_restart_of_the_driver(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    example = importlib.import_module("follow_the_leader")
    leader = example.Leader(example.LeaderConfig())
    leader.step(inputs(0.8, 1000))
    (walking,) = leader.step(inputs(1.0, 1005))
    assert walking.velocity_x > 0.1
    (found,) = leader.step(inputs(1.6, 5, boot=2))
    assert (found.velocity_x, found.velocity_y) == (0.0, 0.0)


@pytest.mark.slow
async def test_it_follows_a_person_round_corners_at_a_distance_without_contact(
    tmp_path: Path,
) -> None:
    home = HomeWithExample(tmp_path)
    install(home.folder / "site")
    distances: list[float] = []  # true ones, from person to robot [m]
    way = [0.0, 0.0]  # driven by person and robot [m]
    last: list[np.ndarray] = []

    def measure(_key: str, message: SimPoses) -> None:
        person, robot = np.frombuffer(message.poses, "<f4").reshape(-1, 7)[:2, :2]
        distances.append(math.dist(person, robot))
        if last:
            for i, (now, before) in enumerate(zip((person, robot), last, strict=True)):
                way[i] += math.dist(now, before)
        last[:] = person, robot

    try:
        file = shutil.copytree(EXAMPLE, tmp_path / "example") / "follow.yaml"
        up = home.start("up", str(file), "--set", "router=tcp/127.0.0.1:0", "--set", "speed=2")
        async with asyncio.timeout(240), connect(await robot_of(home, up), "test") as bus:
            states = bus.latest(STATE)
            await until(lambda: states.newest and states.newest.gate.mode == "enabled", "it may")
            bus.subscribe(SIM_POSES, measure)
            # the person walked on while the robot's processes started
            await until(lambda: distances and distances[-1] < CAUGHT_UP_M, "it has caught up")
            distances.clear()
            await until(lambda: way[0] > LEADER_PATH_M, "the person has walked", within_s=90)
            (driver,) = await bus.ask(DESCRIBE, DescribeRequest(), timeout_s=10, name="driver")
    finally:
        home.close()
    assert driver.report["contacts"] == 0
    assert min(distances) > NEAREST_M
    assert max(distances) < FARTHEST_M
    assert way[1] > 0.7 * LEADER_PATH_M  # the robot cuts corners
