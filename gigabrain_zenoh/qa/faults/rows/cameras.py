"""A camera's process that is killed or frozen: the body does not go ahead blind."""

import asyncio
import importlib.util
from collections.abc import Callable

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_MS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.faults.rig import ZERO, Rig, deployment_of
from gigabrain_zenoh.qa.judging import Figure, Measured, Skipped, fault_row, worse_of
from gigabrain_zenoh.qa.probe import Probe, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest

LOST = "camera_lost"
BLIND_TICKS = 100  # for which a frozen camera stays frozen
SLOW_M_S = 0.01
DRIVING_SHARE = 0.5  # least share of the brain's speed of a robot that drives again

NAMED = Figure("named after", "ms")
WENT_AHEAD = Figure("went ahead blind", "m/s")
SEES_AGAIN = Figure("sees again after", "s", wall=True)


@fault_row(
    50, "", NAMED.at_most(500), ZERO.at_most(860), WENT_AHEAD.at_most(SLOW_M_S),
    SEES_AGAIN.at_most(10), needs=("eyes",),
)  # fmt: skip
async def camera_killed_or_frozen(rig: Rig) -> Measured:
    """Kill the camera's process; then freeze and thaw it."""
    _needs_cameras()
    deployment = replace(deployment_of(rig.options, "sim"), cameras=True)
    async with rig.own_robot(deployment) as robot:
        killed = await _blinded(robot, lambda: robot.kill("camera"))
        frozen = await _blinded(robot, lambda: robot.freeze("camera"), robot.thaw)
    return worse_of(killed, frozen)


def _needs_cameras() -> None:
    """Raise Skipped where no camera can be simulated."""
    from gigabrain_drivers.sim.graphics import open_graphics

    if not importlib.util.find_spec("cv2"):
        raise Skipped("needs gigabrain-zenoh[eyes]: cv2 is missing")
    try:
        open_graphics(64, 64).free()
    except ConfigError as error:
        raise Skipped(str(error)) from None


async def _blinded(
    robot: RobotUnderTest, fault: Callable[[], object], mend: Callable[[], object] | None = None
) -> Measured:
    """Return how a driving body stops when its pictures end, and when it drives again.

    Without `mend` the supervisor mends.
    """
    loop, probe = asyncio.get_running_loop(), robot.probe
    await robot.until_driving()
    start = probe.state
    fault()
    await until(lambda: LOST in _verdict(probe)[1], "safety names the camera")
    named = probe.state.tick
    await until(lambda: probe.state.velocity.linear_x < SLOW_M_S, "the body stops")
    stopped = probe.state
    if mend:
        await probe.ticks(BLIND_TICKS)
        mend()
    begin_s = loop.time()
    await until(lambda: LOST not in _verdict(probe)[1], "pictures come again")
    seeing, _ = _verdict(probe)
    seeing_s = loop.time() - begin_s
    await robot.until_driving(share=DRIVING_SHARE)
    return {
        NAMED: (named - start.tick) * TICK_MS,
        ZERO: (stopped.tick - start.tick) * TICK_MS,
        WENT_AHEAD: max(s.velocity.linear_x for s in probe.since(stopped) if s.tick < seeing),
        SEES_AGAIN: seeing_s,
    }


def _verdict(probe: Probe) -> tuple[int, set[str]]:
    """Return the tick of safety's newest verdict, and the codes of its causes."""
    verdict = probe.safety.current
    return (verdict.tick, {cause.code for cause in verdict.causes}) if verdict else (0, set())
