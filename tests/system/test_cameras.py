"""A robot with cameras: pictures on the bus, a dying process, and a machine without OpenGL."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import CAMERA, DEPTH, IMAGE, Topic
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import AVOID, Home, robot_of
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.vision.pictures import decoded


def can_draw() -> bool:
    try:
        open_graphics(64, 64).free()
    except ConfigError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.skipif(not can_draw(), reason="there is no OpenGL here")
async def test_a_demo_with_cameras_publishes_pictures_also_after_a_restart(
    home: Home,
) -> None:
    demo = home.start(*AVOID, "--cameras", "--headless")
    endpoint = await robot_of(home, demo)
    async with connect(endpoint, "looker", timeout_s=None) as bus, probing(endpoint) as robot:
        received: dict[str, list[Any]] = {}

        def listen(topic: Topic[Any]) -> None:
            bus.subscribe(topic, lambda key, message: received.setdefault(key, []).append(message))

        for topic in (IMAGE, DEPTH, CAMERA):
            listen(topic)

        def newest(topic: Topic[Any]) -> Any:
            return received.get(topic.at("front"), [None])[-1]

        def pictures() -> int:
            return len(received.get(IMAGE.at("front"), []))

        await until(lambda: pictures() >= 10 and newest(CAMERA), "ten pictures")
        assert decoded(newest(IMAGE)).shape == (240, 320, 3)
        depth = newest(DEPTH).array()
        assert depth.shape == (240, 320)
        assert 0.2 < (depth > 0).mean() < 0.99  # the floor has a depth, the sky has none
        assert newest(CAMERA).camera == load_robot("turtlebot3_waffle").cameras[0]
        ticks: list[Message] = received[DEPTH.at("front")][-5:]
        assert all(one.tick == one.basis and one.tick % 5 == 0 for one in ticks)
        body = robot.bodies.current
        assert body
        assert [one.name for one in body.description.cameras] == ["front"]

        (pid,) = home.processes("camera")
        os.kill(pid, signal.SIGKILL)
        await until(lambda: home.processes("camera") not in ([pid], []), "another process")
        before, boot = pictures(), newest(IMAGE).boot
        await until(lambda: pictures() > before + 5, "pictures again")
        assert newest(IMAGE).boot == boot  # the driver did not restart
    demo.send(signal.SIGINT)
    assert await demo.ended() == 0


@pytest.mark.slow
async def test_without_opengl_the_robot_drives_without_cameras_with_one_warning(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports = []
    for cameras in ((), ("--cameras",)):
        monkeypatch.setenv("MUJOCO_GL", "egl")
        monkeypatch.setenv("PYOPENGL_PLATFORM", "glx")  # EGL refuses it
        path = home.folder / f"report{len(cameras)}.json"
        options = ("--headless", "--seconds", "6", "--speed", "10", "--lockstep-timeout", "30")
        demo = await home.run(*AVOID, *options, "--report", str(path), *cameras)
        assert await demo.ended() == 0
        assert ("apt-get install" in demo.err) is bool(cameras)
        assert len(demo.err.splitlines()) == len(cameras)
        assert demo.out.count("camera") == 0
        reports.append(machine_independent_results(path))
    assert reports[0] == reports[1]


def machine_independent_results(path: Path) -> dict[str, Any]:
    """Return the results of a run that do not depend on the speed of this machine."""
    report = json.loads(path.read_bytes())
    names = ("sim_seconds", "distance_m", "turns", "min_clearance_m", "contacts", "true_x")
    return {name: report.get(name) for name in names}


@pytest.mark.parametrize("options", [("--body", "turtlebot3_burger"), ("--body", "mock")])
async def test_cameras_for_a_body_without_them_are_refused(
    home: Home, options: tuple[str, ...]
) -> None:
    demo = await home.run(*AVOID, "--headless", "--cameras", *options)
    assert await demo.ended() == 2
    assert "has no cameras; add a part `cameras:`" in demo.err
    assert len(demo.err.splitlines()) == 1
