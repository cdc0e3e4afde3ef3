"""Processes that freeze and never thaw: the supervisor kills them and starts them again."""

import asyncio

from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.qa.faults.fault import Measured, Stage
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.managed_process import Backoff

VICTIMS: dict[Stage, tuple[str, ...]] = {
    "auto": ("perception", "decision", "control", "safety"),
    "line": ("driver",),
}
ROOM_M = 0.8
UNDER_WAY = 0.05  # [m/s], [rad/s]


async def frozen_for_ever(rig: Rig) -> Measured:
    """SIGSTOP without SIGCONT of each part of the brain, and of a driver whose body lives on."""
    await rig.give_up()
    longest_s, stale = 0.0, 0.0
    for stage, victims in VICTIMS.items():
        deployment = deployment_of(rig.options, stage, "auto")
        robot = rig.new(deployment, backoff=Backoff(), keep_stuck=False)
        async with robot as subject:
            await subject.settle()
            for victim in victims:
                longest_s = max(longest_s, await again_after_s(subject, victim))
            truth = await subject.onlooker.truth()
            stale += float(truth["stale_commands_executed"])
            await subject.check()
    return {"drives again after": longest_s, "stale executed": stale}


async def again_after_s(subject: Subject, victim: str) -> float:
    """From the freeze until the robot drives under another process of that name [s]."""
    loop = asyncio.get_running_loop()
    await subject.drive(ROOM_M)
    pid = subject.pid(victim)
    subject.freeze(victim)
    frozen_s = loop.time()
    await subject.restarted(victim, pid)
    await subject.release()
    await until(lambda: _drives(subject.onlooker.state), "it drives again")
    return loop.time() - frozen_s


def _drives(state: RobotState) -> bool:
    speed = max(abs(state.velocity.linear_x), abs(state.velocity.angular_z))
    return state.gate.mode == "enabled" and speed > UNDER_WAY
