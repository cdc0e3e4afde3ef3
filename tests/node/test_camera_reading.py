"""Camera sources that hang, get lost, or send wrong pictures do not end the process."""

import asyncio
import functools
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_drivers.cameras import process as camera_process
from gigabrain_drivers.cameras.base import CameraLost, CameraSource, Frame
from gigabrain_drivers.cameras.opencv import OpenCvCamera
from gigabrain_schemas.topics import CAMERA, IMAGE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import CameraConfig
from gigabrain_zenoh.testing import samples
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT

BODIES = ROOT / "drivers" / "gigabrain_drivers" / "bodies"
MODEL = BODIES / "turtlebot3_waffle" / "model.xml"
SOURCE = "cameras: {front: {source: opencv, device: x}}"
ROBOT = (
    (BODIES / "turtlebot3_waffle" / "robot.yaml")
    .read_text()
    .replace(
        "sim: {", f"sim: {{model: {MODEL}, cameras: {{front: {{source: opencv, device: x}}}}, "
    )
    .replace("depth: true", "depth: false")
)
SIZE = (240, 320, 3)


class Scripted(CameraSource):
    """A camera whose faults the test sets."""

    opened = 0
    hangs = threading.Event()
    lost, size = "", SIZE
    random = np.random.default_rng(1)

    def open(self) -> None:
        type(self).opened += 1
        if self.lost:
            raise CameraLost(self.lost)

    def read(self) -> Frame:
        threading.Event().wait(0.02)
        while self.hangs.is_set():
            threading.Event().wait(0.01)
        if self.lost:
            raise CameraLost(self.lost)
        blocks = self.random.integers(30, 220, (15, 20, 3), np.uint8)
        picture = np.kron(blocks, np.ones((16, 16, 1), np.uint8))
        return Frame(picture[: self.size[0], : self.size[1]])

    def close(self) -> None: ...


@pytest.fixture(autouse=True)
def scripted(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    Scripted.opened, Scripted.lost, Scripted.size = 0, "", SIZE
    Scripted.hangs.clear()
    monkeypatch.setattr(Scripted, "Options", OpenCvCamera.Options)
    monkeypatch.setattr(camera_process, "source_class", lambda _: Scripted)
    yield
    Scripted.hangs.clear()


@asynccontextmanager
async def running(tmp_path: Path) -> AsyncIterator[tuple[Bus, dict[str, list[Any]]]]:
    (tmp_path / "robot.yaml").write_text(ROBOT)
    network = LocalNetwork()
    bus, robot = (Bus(network.transport(), Clock(), name) for name in ("camera", "driver"))
    received: dict[str, list[Any]] = {"image": [], "camera": []}
    robot.subscribe(IMAGE, lambda _, message: received["image"].append(message))
    robot.subscribe(CAMERA, lambda _, message: received["camera"].append(message))
    robot.time.boot, robot.time.tick = samples.BOOT, 40
    config = CameraConfig(body=str(tmp_path / "robot.yaml"))
    task = asyncio.ensure_future(functools.partial(camera_process.run, config)(bus, lambda: None))
    try:
        await asyncio.sleep(0)
        robot.publish(STATE, samples.state(40))
        await until(lambda: received["image"] or task.done(), "a picture")
        yield bus, received
        assert not task.done()
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await bus.close()
        await robot.close()


def problem(received: dict[str, list[Any]]) -> str:
    return received["camera"][-1].problem if received["camera"] else ""


async def test_a_picture_has_the_newest_tick_and_a_new_stamp(tmp_path: Path) -> None:
    async with running(tmp_path) as (bus, received):
        await until(lambda: received["image"][-1].tick == 40, "the robot's tick")
        newest = received["image"][-1]
        assert (newest.basis, newest.boot, newest.encoding) == (40, samples.BOOT, "jpeg")
        assert 0 <= bus.clock.unix_ns() - newest.stamp_ns < 10**9


async def test_a_hanging_source_is_reported_and_the_process_goes_on(tmp_path: Path) -> None:
    async with running(tmp_path) as (bus, received):
        Scripted.hangs.set()
        await until(lambda: problem(received) == "no picture", "the silence")
        assert bus.progress()
        Scripted.hangs.clear()
        await until(lambda: problem(received) == "", "the end of it")


async def test_a_lost_source_is_reopened(tmp_path: Path) -> None:
    async with running(tmp_path) as (_, received):
        Scripted.lost = "the cable is out"
        await until(lambda: problem(received) == "no picture: the cable is out", "the loss")
        await until(lambda: Scripted.opened >= 3, "more tries")
        Scripted.lost = ""
        before = len(received["image"])
        await until(lambda: len(received["image"]) > before + 3, "pictures")
        assert problem(received) == ""


async def test_the_remedy_depends_on_the_error_of_the_source(tmp_path: Path) -> None:
    def advice(bus: Bus) -> str:
        return bus.problems[0].remedy if bus.problems else ""

    async with running(tmp_path) as (bus, received):
        Scripted.lost = "film.avi has ended"
        await until(lambda: bool(advice(bus)), "the loss")
        assert advice(bus) == "check its source in the robot's file, then its cable"
        Scripted.lost = ""
        await until(lambda: not bus.problems, "the end of it")
        Scripted.hangs.set()
        await until(lambda: problem(received) == "no picture" and bool(bus.problems), "silence")
        assert advice(bus) == "check its cable, or connect it again"


async def test_a_picture_of_wrong_size_is_reported_and_not_published(tmp_path: Path) -> None:
    async with running(tmp_path) as (_, received):
        Scripted.size = (200, 320, 3)
        await until(lambda: "320 x 200" in problem(received), "the size")
        assert problem(received) == "pictures of 320 x 200 pixels; the body's file says 320 x 240"
        before = len(received["image"])
        await asyncio.sleep(0.2)
        assert len(received["image"]) == before
        Scripted.size = SIZE
        await until(lambda: problem(received) == "", "the end of it")


async def test_a_too_large_picture_is_reported_and_not_published(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(tmp_path) as (_, received):
        monkeypatch.setattr("gigabrain_drivers.cameras.output.HEADER_BYTES", 2**20)
        await until(lambda: "at most 1.0 MB are sent" in problem(received), "the size")
        before = len(received["image"])
        await asyncio.sleep(0.2)
        assert len(received["image"]) == before


async def test_an_unexpected_exception_of_a_source_ends_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: Scripted) -> Frame:
        raise ZeroDivisionError

    monkeypatch.setattr(Scripted, "read", broken)
    (tmp_path / "robot.yaml").write_text(ROBOT)
    bus = Bus(LocalNetwork().transport(), Clock(), "camera")
    with pytest.raises(ZeroDivisionError):
        await camera_process.run(CameraConfig(body=str(tmp_path / "robot.yaml")), bus, lambda: None)
    await bus.close()
