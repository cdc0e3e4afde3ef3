"""Exposures as messages of the bus."""

import numpy as np

from gigabrain_drivers.cameras.base import CameraOptions, Frame
from gigabrain_drivers.cameras.output import CameraOutput
from gigabrain_schemas.body import Camera
from gigabrain_schemas.topics import DEPTH
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock


async def test_depth_that_readers_would_refuse_is_named() -> None:
    """One pixel in four holds noise, so one plane is too large, but not the message."""
    camera = Camera(name="front", width=1280, height=960, depth=True)
    bus = Bus(LocalNetwork().transport(), FakeClock(), "camera")
    output = CameraOutput(camera, CameraOptions(source="x"), bus, lambda: 0.0)
    depth = np.zeros((960, 1280), np.uint16)
    packed = output.pack(Frame(None, depth))
    assert packed.depth
    assert not packed.problem
    codec.Codec(DEPTH.type, DEPTH.max_bytes).decode(codec.encode(packed.depth))
    depth[::2, ::2] = np.random.default_rng(0).integers(0, 2**16, (480, 640))
    assert output.pack(Frame(None, depth)).problem == (
        "a plane of depth of 0.6 MB; at most 0.3 MB are sent"
    )
    await bus.close()
