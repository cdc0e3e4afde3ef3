"""A robot with recognition, also after its process died or hung."""

import os
import signal
from typing import Any

import pytest

from gigabrain_schemas.objects import Detections
from gigabrain_schemas.topics import DETECTIONS
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import AVOID, Home, robot_of
from gigabrain_zenoh.testing.waiting import until
from tests.system.test_cameras import can_draw

WORLD = """
size: [4, 4]
start: [0, 0, 0]
boxes: [{at: [1.6, 0], size: [0.2, 1.0, 0.6], material: white}]
tags: [{id: 7, at: [1.49, 0.1], yaw: 3.1416, z: 0.25, size: 0.2}]
"""


@pytest.mark.skipif(not can_draw(), reason="there is no OpenGL here")
@pytest.mark.slow
async def test_tags_are_found_again_after_the_process_died_or_hung(
    home: Home,
) -> None:
    world = home.folder / "tags.yaml"
    world.write_text(WORLD)
    options = ("--cameras", "--headless", "--world", str(world), "--set", "tags.size=0.2")
    demo = home.start(*AVOID, *options)
    endpoint = await robot_of(home, demo)
    async with connect(endpoint, "looker", timeout_s=None) as bus, probing(endpoint) as robot:
        received: list[Detections] = []
        bus.subscribe(DETECTIONS, lambda _, message: received.append(message))

        async def seen(what: str) -> Any:
            received.clear()
            await until(lambda: len(received) >= 3, what)
            return received[-1]

        await until(lambda: any(one.tags for one in received), "the tag")
        first = next(one for one in received if one.tags)
        assert (first.camera, first.width, first.height) == ("front", 320, 240)
        assert first.tags[0].id == 7
        boot = first.boot
        for how in (signal.SIGKILL, signal.SIGSTOP):
            (pid,) = home.processes("recognition")
            os.kill(pid, how)
            await until(
                lambda: home.processes("recognition") not in ([pid], []),  # noqa: B023
                "another process",
            )
            assert (await seen(f"pictures after {how.name}")).boot == boot
        assert robot.bodies.current
    demo.send(signal.SIGINT)
    assert await demo.ended() == 0


async def test_a_missing_net_is_refused_in_one_line_before_the_start(
    home: Home,
) -> None:
    (home.folder / "coco.txt").write_text("can\n")
    sets = ("onnx=my.onnx", "layout=yolo", f"labels={home.folder / 'coco.txt'}")
    options = [word for one in sets for word in ("--set", f"recognizer.{one}")]
    demo = await home.run(*AVOID, "--headless", "--cameras", *options)
    assert await demo.ended() == 2
    assert "my.onnx: no such file" in demo.err
    assert len(demo.err.splitlines()) == 1
