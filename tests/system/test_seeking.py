"""A whole robot drives to things and tags that its camera sees.

The test stands in for the recognition process, with the truth of the simulator.
"""

import contextlib
import json
import math
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from gigabrain_schemas.base import Pose
from gigabrain_schemas.objects import Detection, Detections, TagDetection
from gigabrain_schemas.sim import SimPoses, SimRequest, SimScene, Thing
from gigabrain_schemas.topics import DETECTIONS, SIM_CHANGE, SIM_POSES, SIM_SCENE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.geometry.pose import ORIGIN, relative, to_frame
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import Home, robot_of
from gigabrain_zenoh.testing.waiting import until
from tests.system.test_cameras import can_draw

COMPILE_TIMEOUT_S = 600.0  # the first start compiles
SIGHT_M, HALF_VIEW = 2.5, 0.45
CORNERS = ((100.0, 100.0), (120.0, 100.0), (120.0, 80.0), (100.0, 80.0))
TAG = Pose(x=0.9, y=3.15, yaw=-math.pi / 2)  # on a wall of the world


@dataclass
class FakeRecognition:
    """Publishes true detections of things in the camera's view."""

    bus: Bus
    body: str  # the robot's body in the scene
    cans: list[Thing] = field(default_factory=list)
    tags: dict[int, Pose] = field(default_factory=dict)
    place: Pose = ORIGIN  # the robot's true pose
    pictures: int = 0
    scene: SimScene | None = None

    def watch(self) -> None:
        """Start to publish detections, five times a second."""
        self.bus.latest(STATE)  # its messages need the robot's ticks
        self.bus.latest(SIM_SCENE, self._on_scene)
        self.bus.subscribe(SIM_POSES, lambda _key, poses: self._on_poses(poses))

    def _on_scene(self, scene: SimScene) -> None:
        self.scene = scene

    def _on_poses(self, poses: SimPoses) -> None:
        scene = self.scene
        if scene is None or poses.version != scene.version or poses.tick % 10:
            return
        rows = np.frombuffer(poses.poses, "<f4").reshape(-1, 7)
        x, y, _, w, _, _, z = rows[scene.bodies.index(self.body) - 1].tolist()
        self.place = Pose(x=x, y=y, yaw=2 * math.atan2(z, w))
        self.bus.publish(DETECTIONS, self._picture(), basis=poses.tick)
        self.pictures += 1

    def _picture(self) -> Detections:
        things = [self._can(one) for one in self.cans if self.sees(one.x, one.y)]
        tags = [self._tag(n, at) for n, at in self.tags.items() if self.sees(at.x, at.y)]
        return Detections(
            camera="front", width=320, height=240, things=tuple(things), tags=tuple(tags)
        )

    def _can(self, one: Thing) -> Detection:
        x, y = to_frame(self.place, one.x, one.y)
        return Detection(
            label="can", confidence=0.9, box=(150, 110, 170, 140), position=(x, y, 0.06),
            size=(0.1, 0.12),
        )  # fmt: skip

    def _tag(self, number: int, at: Pose) -> TagDetection:
        seen = relative(self.place, at)
        return TagDetection(
            id=number, corners=CORNERS, size=0.16, position=(seen.x, seen.y, 0.4),
            orientation=(0.0, 0.0, math.sin(seen.yaw / 2), math.cos(seen.yaw / 2)),
        )  # fmt: skip

    def distance_and_bearing(self, x: float, y: float) -> tuple[float, float]:
        """Return distance [m] and absolute bearing [rad] of a place from the robot."""
        ahead, left = to_frame(self.place, x, y)
        return math.hypot(ahead, left), abs(math.atan2(left, ahead))

    def sees(self, x: float, y: float) -> bool:
        distance, turn = self.distance_and_bearing(x, y)
        return distance < SIGHT_M and turn < HALF_VIEW


@contextlib.asynccontextmanager
async def robot_with_recognition(home: Home) -> AsyncIterator[FakeRecognition]:
    """Run a robot with a camera in the arena, and a fake recognition process."""
    file = home.deployment(
        body="turtlebot3_waffle", world="arena", speed=2.0, resume="auto", cameras=True,
        recognition=False, perception={"mapping": "slam"}, decision={"behaviour": "navigate"},
    )  # fmt: skip
    up = home.start("up", str(file))
    endpoint = await robot_of(home, up)
    async with connect(endpoint, "looker", timeout_s=None) as bus, probing(endpoint) as robot:
        await until(lambda: robot.state.gate.mode == "enabled", "driving", COMPILE_TIMEOUT_S)
        recognition = FakeRecognition(bus, "robot/base")
        recognition.watch()
        await until(lambda: recognition.pictures > 5, "the truth")
        yield recognition


@pytest.mark.slow
@pytest.mark.skipif(not can_draw(), reason="there is no OpenGL here")
async def test_it_drives_to_cans_and_tags_and_lists_them(home: Home, tmp_path: Path) -> None:
    async with robot_with_recognition(home) as seen:
        nothing = await home.run("objects")
        assert nothing.out.startswith("no things and no tags")
        can = Thing(name="can", kind="cylinder", x=-1.2, y=1.0, size=(0.1, 0.1, 0.3))
        added = await seen.bus.ask(SIM_CHANGE, SimRequest(do="add", thing=can))
        assert added[0].ok, added[0].text
        seen.cans, seen.tags = [can], {7: TAG}

        there = home.start("goto", "--object", "can")
        assert await there.ended(300.0) == 0, there.err
        distance, turn = seen.distance_and_bearing(can.x, can.y)
        assert 0.3 < distance < 0.8
        assert turn < 0.3
        listed = await home.run("objects", "--json")
        found = json.loads(listed.out)
        assert [one["label"] for one in found["objects"]] == ["can"]

        before = home.start("goto", "--tag", "7")
        assert await before.ended(300.0) == 0, before.err
        distance, turn = seen.distance_and_bearing(TAG.x, TAG.y)
        assert distance < 0.9
        assert turn < 0.3
        lost = await home.run("pose", "50", "-50", "0")
        assert lost.err.startswith("gigabrain: ")
        assert await lost.ended() == 1
        refused = await home.run("goto", "can")
        assert refused.err == (
            "gigabrain: no place is called 'can'; an object is: gigabrain goto --object can\n"
        )
        number = found["objects"][0]["id"]
        forgot = await home.run("objects", "--forget", str(number))
        assert forgot.out == f"forgot object {number}\n"

        mission = tmp_path / "find.yaml"
        mission.write_text("do: [{find: umbrella}]")
        nowhere = home.start("mission", str(mission))
        assert await nowhere.ended(600.0) == 1
        assert "an umbrella was not found: everything reachable was seen" in nowhere.err
