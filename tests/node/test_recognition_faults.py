"""Recognition logs a camera with broken pictures once, by its own name."""

import logging

from gigabrain_zenoh.testing.waiting import until
from tests.node.test_recognition import CAMERA, REAR, running

BROKEN = b"x" * 900


async def test_a_broken_camera_is_named_once_while_another_one_is_whole(caplog):
    caplog.set_level(logging.INFO)
    async with running(CAMERA, REAR) as robot:
        for count in range(1, 5):
            robot.show(40)
            robot.show(40, BROKEN, name="rear", depth=False)
            await robot.finds(count)
            await until(lambda: robot.own.counters["broken_pictures"] == count)  # noqa: B023
            await robot.pass_s(1)
        robot.show(40, name="rear", depth=False)
        assert (await robot.finds(5)).camera == "rear"
        begun, ended = [one.message for one in caplog.records]
        assert begun.startswith("camera rear: skipped a picture: ")
        assert ended == "camera rear: its pictures are whole again"


async def test_a_camera_with_broken_pictures_now_and_then_is_named_once(caplog):
    caplog.set_level(logging.INFO)
    async with running() as robot:
        for count in range(1, 5):
            robot.show(40, BROKEN)
            await until(lambda: robot.own.counters["broken_pictures"] == count)  # noqa: B023
            await robot.pass_s(0.2)
            robot.show(40)
            await robot.finds(count)
            await robot.pass_s(0.2)
        assert len(caplog.records) == 1
