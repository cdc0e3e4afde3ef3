"""Faults of the lidar: scans that say nothing, or what cannot be."""

import math

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.geometry.scan import Floats
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.faults.bodies import description_of
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.rig import Rig
from gigabrain_zenoh.qa.faults.stopping import Stop, stop_by
from gigabrain_zenoh.qa.faults.tampered import go_on, tampered
from gigabrain_zenoh.safety.step import Inputs, Memory, step

KINDS = ("nan", "half", "crooked")
LONG_KINDS = ("nan", "half", "crooked", "minus-inf", "zero", "most", "short")


async def blind_lidar(rig: Rig) -> Measured:
    """Kind after kind, in perception and safety; then while a robot drives by it."""
    body = description_of(rig)
    for name, values in blindness(body).items():
        _noticed(body, name, values)
    kinds, stops = LONG_KINDS if rig.long else KINDS, list[Stop]()
    async with tampered(rig, *kinds) as subject:
        for _ in kinds:
            stops.append(await stop_by(subject, lambda: go_on(subject)))
            go_on(subject)
    return {
        "brakes after": max(stop.brakes_ms for stop in stops),
        "zero after": max(stop.zero_ms for stop in stops),
    }


def blindness(body: BodyDescription) -> dict[str, Floats]:
    """Ranges (n,) [m] of scans that no lidar can mean."""
    assert body.lidar
    count = body.lidar.beams
    half = np.ones(count)
    half[: (count + 1) // 2] = np.nan
    return {
        "nan": np.full(count, np.nan),
        "inf": np.full(count, np.inf),
        "minus inf": np.full(count, -np.inf),
        "zero": np.zeros(count),
        "most": np.full(count, body.lidar.range_max),
        "half": half,
        "short": np.ones(count - 1),
        "long": np.ones(count + 1),
    }


def _noticed(body: BodyDescription, name: str, values: Floats) -> None:
    """Raise Failed where perception believes such a scan, or safety does not stop for it.

    All-inf is blindness where the lidar cannot tell it from free space.
    """
    assert body.lidar
    if name == "inf":
        body = replace(body, lidar=replace(body.lidar, no_return="unknown"))
    seen = LaserScan(
        angle_min=0.0,
        angle_increment=math.tau / len(values),
        range_min=0.1,
        range_max=10.0,
        ranges=ranges_bytes(values),
    )
    if perception.step(PerceptionConfig(), body, seen).scan_ok:
        raise Failed(f"perception believes a scan of all {name}")
    example, memory = EXAMPLES[RobotState.__name__], Memory()
    assert isinstance(example, RobotState)
    for tick in range(5, 25, 5):
        state = replace(example, boot=1, tick=tick, basis=tick)
        scan = replace(seen, boot=1, tick=tick, basis=tick)
        memory, verdict = step(body, memory, Inputs(state=state, scan=scan, scan_age_ns=TICK_NS))
    if "scan_blind" not in {cause.code for cause in verdict.causes}:
        raise Failed(f"safety believes a scan of all {name}")
