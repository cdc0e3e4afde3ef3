"""Safety on the bus with a depth camera: pictures, floods, garbage and counters."""

import random

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.topics import BODY, DEPTH, SAFETY, SCAN, STATE
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh import codec
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import (
    BOOT,
    DRIVING,
    TICK_NS,
    WAFFLE,
    body,
    open_space,
    scan,
    state,
)
from tests.unit.safety.depth_scene import CAMERA, SEEING, Eye, Scene, image

ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)
SCRIPT = replace(DRIVING, commander="script")  # the brain need not run
MAST = replace(CAMERA, x=-0.2, z=0.2, pitch=0.3)  # sees the floor right ahead of the body
LOOKING = replace(SEEING, cameras=(MAST,), body_height=0.2)
NEAR = Scene(boxes=((0.13, 0.4, -0.2, 0.2, 0.0, 0.1),))


class Watch(NodeBench):
    """Safety with a body and its camera in a scene."""

    def __init__(self, description: BodyDescription = LOOKING, scene: Scene | None = None) -> None:
        super().__init__(safety.run)
        self.description, self.scene = description, scene or Scene()
        self.eye, self.tick = Eye(MAST), 0
        self.verdict = SafetyState(verdict="stop")

    def picture(self, name: str = "front", **changes: object) -> bytes:
        """Publish the camera's present picture; return the payload."""
        seen = self.eye.picture(self.scene, ORIGIN, self.tick)
        return self.publish(replace(seen, **changes), name)

    def publish(self, seen: DepthImage, name: str = "front") -> bytes:
        """Publish a picture; return the payload."""
        payload = codec.encode(seen)
        self.network.deliver(DEPTH.at(name), payload)
        return payload

    async def go(self, ticks: int, *, pictures: bool = True) -> SafetyState:
        """Run some ticks, with a scan and a picture every 5 ticks; return the last verdict."""
        if not self.tick:
            self.send(BODY, body(self.description))
        for _ in range(ticks):
            self.tick += 1
            self.send(STATE, state(self.tick, gate=SCRIPT))
            if self.tick % 5 == 0:
                self.send(SCAN, scan(open_space(), self.tick))
                if pictures:
                    self.picture()
            await self.clock.advance(TICK_NS)
        self.verdict = (self.sent(SAFETY) or [self.verdict])[-1]
        return self.verdict


def codes(verdict: SafetyState) -> list[str]:
    return [cause.code for cause in verdict.causes]


async def test_a_picture_is_judged_at_once() -> None:
    async with Watch() as watch:
        assert codes(await watch.go(24)) == []
        watch.scene = NEAR
        await watch.go(1, pictures=False)
        watch.sent(SAFETY)
        watch.picture()
        verdict = watch.sent(SAFETY)[-1]
    assert (verdict.tick, verdict.caps.forward) == (25, 0.0)
    assert codes(verdict) == ["zone_ahead"]


async def test_a_picture_that_overtakes_the_state_of_its_tick_waits_for_it() -> None:
    async with Watch() as watch:
        await watch.go(24)
        watch.scene, watch.tick = NEAR, 25
        watch.picture()
        assert watch.sent(SAFETY) == []
        watch.send(STATE, state(25, gate=SCRIPT))
        assert codes(watch.sent(SAFETY)[-1]) == ["zone_ahead"]


async def test_a_silent_camera_is_reported_within_half_a_second() -> None:
    async with Watch() as watch:
        await watch.go(25)
        verdict = await watch.go(14, pictures=False)
        assert codes(verdict) == ["camera_lost"]
        assert verdict.caps == SpeedCaps(forward=0.0)
        assert codes(await watch.go(6)) == ["camera_lost"]
        assert codes(await watch.go(55)) == []


async def test_pictures_of_another_boot_do_not_count() -> None:
    async with Watch() as watch:
        await watch.go(25)
        for _ in range(15):
            await watch.go(1, pictures=False)
            watch.picture(boot=BOOT + 1)
        verdict = await watch.go(1, pictures=False)
    assert codes(verdict) == ["camera_lost"]


async def test_without_cameras_safety_does_not_subscribe_to_pictures() -> None:
    async with Watch(WAFFLE, NEAR) as watch:
        verdict = await watch.go(25)
        assert DEPTH.at("*") not in watch.bus.listens
    assert (codes(verdict), verdict.caps) == ([], SpeedCaps())


@pytest.mark.long
@pytest.mark.parametrize("changes", [{"basis": 999}, {"tick": 999}])
async def test_pictures_of_the_future_do_not_block_present_ones(changes: dict[str, int]) -> None:
    async with Watch() as watch:
        await watch.go(25)
        for _ in range(25):
            await watch.go(1, pictures=watch.tick % 5 == 4)
            watch.picture(**changes)
            watch.picture(**changes)
        assert codes(await watch.go(1)) == []
        assert watch.bus.counters["refused_pictures"] == 50


async def test_a_flood_of_old_and_repeated_pictures_is_counted() -> None:
    async with Watch() as watch:
        await watch.go(25)
        old = codec.encode(watch.eye.picture(NEAR, ORIGIN, 20))
        for _ in range(50):
            for _ in range(4):
                watch.network.deliver(DEPTH.at("front"), old)
            await watch.go(1)
        assert codes(await watch.go(5)) == []
        assert watch.bus.counters["repeated_pictures"] == 200


@pytest.mark.long
async def test_pictures_of_unknown_cameras_are_counted() -> None:
    async with Watch() as watch:
        await watch.go(25)
        for number in range(100):
            watch.picture(f"camera{number}")
        assert codes(await watch.go(5)) == []
        assert watch.bus.counters["refused_pictures"] == 100


@pytest.mark.long
async def test_garbage_on_the_camera_key_stops_motion_but_not_the_process() -> None:
    """Random bytes, damaged pictures and wrong sizes; good pictures end the fault."""
    chance = random.Random(7)
    async with Watch() as watch:
        await watch.go(25)
        good = bytearray(watch.picture())
        for _ in range(300):
            damaged = bytearray(good)
            for _ in range(chance.randint(1, 30)):
                damaged[chance.randrange(len(damaged))] = chance.randrange(256)
            watch.network.deliver(DEPTH.at("front"), bytes(damaged))
            watch.network.deliver(DEPTH.at("front"), chance.randbytes(chance.randint(0, 500)))
            await watch.go(1, pictures=False)
        assert not watch.bus.failed.done()
        assert watch.bus.rejected[DEPTH.at("*")] > 300
        sizes = ((16, 16), (240, 320), (4096, 4096), (320, 240))
        for number in range(60):
            await watch.go(1, pictures=False)
            height, width = sizes[number % len(sizes)]
            plane = chance.randbytes(chance.randint(0, 1000))
            made = image(np.ones((16, 16)), watch.tick)
            watch.publish(replace(made, height=height, width=width, planes=(plane,) * 4))
        verdict = await watch.go(1, pictures=False)
        assert codes(verdict) == ["camera_wrong"]
        assert verdict.caps.forward == 0.0
        assert codes(await watch.go(15)) == []


async def test_a_restart_of_the_driver_forgets_obstacles() -> None:
    async with Watch(scene=NEAR) as watch:
        assert codes(await watch.go(25)) == ["zone_ahead"]
        watch.send(BODY, body(LOOKING, boot=BOOT + 1))
        for tick in range(1, 20):
            watch.send(STATE, state(tick, boot=BOOT + 1, gate=SCRIPT))
            await watch.clock.advance(TICK_NS)
        found = codes(watch.sent(SAFETY)[-1])
    assert "zone_ahead" not in found
    assert "camera_lost" in found


async def test_a_new_description_replaces_the_cameras() -> None:
    async with Watch() as watch:
        await watch.go(25)
        rear = replace(MAST, name="rear", yaw=3.1416, x=0.0)
        watch.send(BODY, body(replace(LOOKING, cameras=(MAST, rear))))
        verdict = await watch.go(10)
    assert codes(verdict) == ["camera_lost"]
    assert verdict.caps == SpeedCaps(backward=0.0)
