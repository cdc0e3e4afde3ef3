"""Recognition logs a camera with broken pictures once, by its own name."""

import logging

import pytest

from gigabrain_schemas.topics import DEPTH
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.testing.waiting import until
from tests.node.test_recognition import CAMERA, DEPTH_PICTURE, REAR, running

BROKEN = b"x" * 900
WRONG_DEPTHS = {
    "a plane of depth cannot be unpacked": (320, 240, (b"no", b"zlib", b"at", b"all")),
    "depth of 160 x 120 pixels; the body's file": (160, 120, pack_depth(DEPTH_PICTURE[::2, ::2])),
}


async def test_a_broken_camera_is_logged_once_while_another_works(caplog):
    caplog.set_level(logging.INFO)
    async with running(CAMERA, REAR) as robot:
        for count in range(1, 5):
            robot.publish_picture(40)
            robot.publish_picture(40, BROKEN, name="rear", depth=False)
            await robot.wait_for_detections(count)
            await until(lambda: robot.recognition_bus.counters["broken_pictures"] == count)  # noqa: B023
            await robot.advance_s(1)
        robot.publish_picture(40, name="rear", depth=False)
        assert (await robot.wait_for_detections(5)).camera == "rear"
        begun, ended = [one.message for one in caplog.records]
        assert begun.startswith("camera rear: skipped a picture: ")
        assert ended == "camera rear: its pictures are whole again"


async def test_a_camera_with_occasional_broken_pictures_is_logged_once(caplog):
    caplog.set_level(logging.INFO)
    async with running() as robot:
        for count in range(1, 5):
            robot.publish_picture(40, BROKEN)
            await until(lambda: robot.recognition_bus.counters["broken_pictures"] == count)  # noqa: B023
            await robot.advance_s(0.2)
            robot.publish_picture(40)
            await robot.wait_for_detections(count)
            await robot.advance_s(0.2)
        assert len(caplog.records) == 1


@pytest.mark.parametrize("problem", [*WRONG_DEPTHS])
async def test_a_picture_with_broken_depth_is_recognised_as_one_without_depth(caplog, problem):
    caplog.set_level(logging.INFO)
    width, height, planes = WRONG_DEPTHS[problem]
    async with running() as robot:
        for count in range(1, 4):
            wrong = DepthImage(frame_id="front", width=width, height=height, planes=planes)
            robot.bus.publish(DEPTH, wrong, basis=40, name="front")
            robot.publish_picture(40, depth=False)
            (ball,) = (await robot.wait_for_detections(count)).things
            assert (ball.label, ball.position, ball.in_map) == ("ball", None, None)
            assert robot.recognition_bus.counters["broken_depths"] == count
            await robot.advance_s(1)
        robot.publish_picture(40)
        assert (await robot.wait_for_detections(4)).things[0].position
        assert robot.recognition_bus.counters["broken_pictures"] == 0
        begun, ended = [one.message for one in caplog.records]
        assert begun.startswith(f"camera front: recognised without depth: {problem}")
        assert ended == "camera front: its depth is whole again"
