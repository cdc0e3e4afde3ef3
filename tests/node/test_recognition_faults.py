"""Recognition logs a camera with broken pictures once, by its own name."""

import logging

from gigabrain_zenoh.testing.waiting import until
from tests.node.test_recognition import CAMERA, REAR, running

BROKEN = b"x" * 900


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
