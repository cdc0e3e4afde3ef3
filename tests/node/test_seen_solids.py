"""An arm picks up things that its depth camera sees: perception, and missions with its solids."""

import functools
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import ArmModel, Joint
from gigabrain_schemas.objects import Detection, Detections, SeenSolid
from gigabrain_schemas.topics import ARM_MODEL, BODY, DEPTH, DETECTIONS, SOLIDS, STATE
from gigabrain_zenoh import codec
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.manipulation.arm_mask import ArmMask
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.bench.hands_camera import ArmCamera
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import BOOT, body, state
from tests.node.arm_rig import Rig
from tests.unit.vision.scenes import Box, depth_of, image, millimetres

SO101 = load_robot("so101").description()
(TOP,) = SO101.fixed_cameras
MODEL = robot_path("so101").with_name("model.xml").read_text()
assert SO101.arm
ON_PEDESTAL = replace(SO101, arm=replace(SO101.arm, floor=-0.2))
HOME = dict(zip((joint.name for joint in SO101.joints), SO101.arm.home, strict=True))
CUBE = Box(x=0.2, y=0.12, half_x=0.015, half_y=0.015, top=0.03)
BESIDE = Box(x=0.12, y=-0.15, half_x=0.02, half_y=0.01, top=0.03)
BESIDE_ITS_HAND = (0.15, -0.16)
BELOW_ITS_HAND = (0.17, 0.0)  # of the arm in home posture
PARTS = tuple(  # of the cube, cut off by the picture's edges: their label does not count
    Detection(label="can", confidence=1.0, box=box, position=(0.21, 0.11, 0.015))
    for box in ((0, 50, 90, 99), (50, 0, 90, 99), (50, 50, 320, 99), (50, 50, 90, 240))
)
NAMED = Detection(label="cube", confidence=0.9, box=(90, 90, 99, 99), position=(0.21, 0.11, 0.015))


class ArmPerception(NodeBench):
    """Perception of an arm with a camera above its table."""

    def __init__(self, model: str = MODEL) -> None:
        super().__init__(functools.partial(perception.run, PerceptionConfig(mapping="off")))
        self._model = model

    async def look(self, tick: int, *boxes: Box) -> None:
        """Publish a depth picture of boxes at a tick."""
        if tick == 1:
            await self.ready()
            self.send(BODY, body(SO101))
            self.send(ARM_MODEL, ArmModel(mjcf=self._model))
        joints = tuple(Joint(name=name, position=place) for name, place in HOME.items())
        self.send(STATE, replace(state(tick), joints=joints))
        seen = image(millimetres(TOP, depth_of(TOP, boxes)))
        picture = replace(seen, frame_id="top", boot=BOOT, tick=tick, basis=tick)
        self.network.deliver(DEPTH.at("top"), codec.encode(picture))
        await self.clock.advance(0)

    def seen(self) -> tuple[SeenSolid, ...]:
        """Return the solids that were published last."""
        return self.sent(SOLIDS)[-1].solids


async def test_perception_publishes_the_solids_on_the_table_of_an_arm() -> None:
    async with ArmPerception() as perceiving:
        for tick in (1, 11):
            await perceiving.look(tick, CUBE, BESIDE)
        one, other = sorted(perceiving.seen(), key=lambda one: -one.position[1])
        assert one.position == pytest.approx((0.2, 0.12, 0.015), abs=0.003)
        assert one.size == pytest.approx((0.03, 0.03, 0.03), abs=0.004)
        assert sorted(other.size) == pytest.approx([0.02, 0.03, 0.04], abs=0.004)
        perceiving.send(DETECTIONS, Detections(
            camera="top", width=320, height=240, things=(NAMED, *PARTS),
            boot=BOOT, tick=11, basis=11,
        ))  # fmt: skip
        for tick in (21, 31, 41):
            await perceiving.look(tick, CUBE)
        (left,) = perceiving.seen()
        assert (left.id, left.label) == (one.id, "cube")


async def test_the_arm_itself_and_things_hidden_by_it_are_no_solids() -> None:
    hand = Box(x=0.2, y=0.0, half_x=0.04, half_y=0.02, top=0.17, bottom=0.11)  # at its hand
    hidden = Box(x=0.2, y=0.0, half_x=0.015, half_y=0.03, top=0.03)
    async with ArmPerception() as perceiving:
        for tick in (1, 11, 21):
            await perceiving.look(tick, hand, hidden)
        assert perceiving.seen() == ()


async def test_without_a_usable_arm_model_no_solids_are_published() -> None:
    async with ArmPerception("<mujoco/>") as perceiving:
        for tick in (1, 11):
            await perceiving.look(tick, CUBE)
        assert perceiving.sent(SOLIDS) == []


class CameraRig(Rig):
    """An arm with a queue of tasks and a camera."""

    camera: ArmCamera

    def look(self) -> None:
        """Take pictures with the camera."""
        self.seen = self.camera.look(self.arm.state())

    def tick(self) -> None:
        """Advance by 20 ms."""
        self.seen = tuple(replace(one, age=one.age + TICK_S) for one in self.seen)
        super().tick()


@pytest.fixture
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[CameraRig]:
    made = CameraRig(tmp_path, request.param)
    made.arm.description = SO101
    with closing(ArmCamera(SO101, MODEL, made.arm.simulation, 1)) as made.camera:
        yield made


@pytest.mark.parametrize("rig", [BESIDE_ITS_HAND], indirect=True)
def test_a_mission_picks_up_a_seen_thing_and_puts_it_down(rig: CameraRig) -> None:
    rig.look()
    done = rig.run_mission(
        "things: {cube: {box: [0.03, 0.03, 0.03]}}\n"
        "do: [{pick: cube}, {place: [0.14, 0.15, 0.015]}]"
    )
    assert done.state == "succeeded", done.reason
    x, y, _ = rig.arm.thing()
    assert (x, y) == pytest.approx((0.14, 0.15), abs=0.01)


@pytest.mark.parametrize("rig", [BESIDE_ITS_HAND], indirect=True)
def test_an_arm_on_a_pedestal_picks_up_a_seen_thing(rig: CameraRig) -> None:
    rig.look()
    rig.arm.description = ON_PEDESTAL
    (cube,) = rig.seen
    x, y, z = cube.position
    rig.seen = (replace(cube, position=(x, y, z + 0.2), label="cube"),)  # z counts from the floor
    rig.run_mission("things: {cube: {label: cube}}\ndo: [{pick: cube}]")
    assert rig.arm.thing()[2] > 0.03


def test_the_mask_of_an_arm_on_a_pedestal_is_raised() -> None:
    level, raised = ArmMask(MODEL, SO101), ArmMask(MODEL, ON_PEDESTAL)
    points = np.random.default_rng(1).uniform((-0.1, -0.2, 0.0), (0.3, 0.2, 0.3), (2000, 3))
    own = level.covers(points, HOME)
    assert 20 < np.count_nonzero(own) < 1000
    assert (raised.covers(points + np.array((0.0, 0.0, 0.2)), HOME) == own).all()


@pytest.mark.slow
@pytest.mark.parametrize("rig", [BELOW_ITS_HAND], indirect=True)
def test_a_thing_hidden_by_its_hand_is_seen_after_the_arm_moved_away(rig: CameraRig) -> None:
    rig.look()
    assert rig.seen == ()
    rig.add_mission("things: {cube: {box: [0.03, 0.03, 0.03]}}\ndo: [{pick: cube}]")
    for _ in range(1500):
        rig.tick()
        if rig.queue.status.done:
            break
        if abs(rig.arm.measured("shoulder_pan")) > 1.3:
            rig.look()
    assert rig.queue.status.done[0].state == "succeeded"
    assert "looking for cube" in rig.phases
    assert rig.arm.thing()[2] > 0.03


@pytest.mark.parametrize("rig", [BESIDE_ITS_HAND], indirect=True)
def test_a_pick_of_an_unseen_thing_fails_in_one_line(rig: CameraRig) -> None:
    done = rig.run_mission("things: {can: {label: can}}\ndo: [{pick: can}]")
    assert done.state == "failed"
    assert done.reason == "picking up can: can is not seen"


@pytest.mark.parametrize("rig", [BESIDE_ITS_HAND], indirect=True)
def test_a_thing_still_seen_at_its_place_is_not_in_the_gripper(rig: CameraRig) -> None:
    rig.look()
    rig.add_mission(
        "things: {cube: {box: [0.03, 0.03, 0.03]}}\ndo: [{pick: cube}, {posture: home}]"
    )
    while rig.phases[-1:] != ["lift"]:
        rig.tick()
    (standing,) = rig.seen
    for _ in range(300):
        rig.seen = (replace(standing, age=0.0),)
        rig.tick()
        if rig.queue.status.done:
            break
    done = rig.queue.status.done[0]
    assert done.state == "failed"
    assert "cube is not in the gripper: it is seen where it was" in done.reason
