"""Faults of processes: killed, frozen, and with a part that hangs."""

import asyncio
import signal
import sys
from collections.abc import Mapping
from dataclasses import replace

from gigabrain_schemas.requests import EnableRequest
from gigabrain_schemas.topics import ENABLE
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.qa.faults.fault import Measured
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.stopping import TICK_MS, Stop, creep, stop_by
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

RESTED_TICKS = 50  # how long a robot has to stand after all is well again
FROZEN_TICKS, FROZEN_LONG_TICKS = 250, 3000  # 5 s, 60 s
ASKED = 5  # how often somebody tries to enable a robot that must not be


async def decision_killed(rig: Rig) -> Measured:
    """kill -9 while it drives."""
    stop, again_m = await _killed(await rig.robot("sim"), "decision")
    return _figures(stop, again_m)


async def decision_frozen(rig: Rig) -> Measured:
    """SIGSTOP while it drives: liveliness would not notice."""
    stop, again_m = await _frozen(await rig.robot("sim"), "decision", RESTED_TICKS)
    return _figures(stop, again_m)


async def frozen_and_thawed(rig: Rig) -> Measured:
    """SIGCONT after a while, of decision and of the driver: the past moves nothing."""
    subject = await rig.robot("sim")
    ticks = FROZEN_LONG_TICKS if rig.long else FROZEN_TICKS
    stop, _ = await _frozen(subject, "decision", ticks)
    decision = await _thawed(subject, stop.distance_m)
    await subject.drive()
    subject.freeze("driver")
    await asyncio.sleep(ticks * TICK_MS / 1e3)  # the robot's own time stands still with it
    subject.thaw()
    await until(lambda: subject.onlooker.state.gate.mode == "idle", "the gate shuts")
    await subject.onlooker.still()
    return _worse(decision, await _thawed(subject, await subject.distance()))


async def control_killed_or_frozen(rig: Rig) -> Measured:
    """The same for control: killed, frozen, thawed."""
    subject = await rig.robot("sim")
    killed = _figures(*await _killed(subject, "control"))
    stop, again_m = await _frozen(subject, "control", RESTED_TICKS)
    frozen = _worse(_figures(stop, again_m), await _thawed(subject, stop.distance_m))
    return _worse(killed, frozen)


async def perception_killed_or_frozen(rig: Rig) -> Measured:
    """What the brain knows grows old."""
    subject = await rig.robot("sim")
    killed = _figures(*await _killed(subject, "perception"))
    return _worse(killed, _figures(*await _frozen(subject, "perception", RESTED_TICKS)))


async def safety_killed_or_frozen(rig: Rig) -> Measured:
    """Nobody can enable the robot without it."""
    subject = await rig.robot("sim")
    killed = _figures(*await _killed(subject, "safety"))
    stop, _ = await _frozen(subject, "safety", 0)
    bus, enabled = subject.onlooker.bus, 0
    for _ in range(ASKED):
        replies = await bus.ask(ENABLE, EnableRequest(source=BRAIN))
        enabled += any(reply.ok for reply in replies)
        await subject.onlooker.ticks(5)
    frozen = _figures(stop, await subject.distance() - stop.distance_m)
    return {**_worse(killed, frozen), "enabled without it": enabled}


async def one_part_of_decision_hangs(rig: Rig) -> Measured:
    """Its thinking hangs, while it goes on repeating its last word 50 times a second."""
    await rig.give_up()
    async with rig.new(deployment_of(rig.options, "sim"), _hanging) as subject:
        stop = await stop_by(subject, lambda: subject.send("decision", signal.SIGUSR1))
        await subject.check()
    return stop.figures()


def _hanging(specs: list[ProcessSpec]) -> list[ProcessSpec]:
    """The same processes, with a decision that can be made to hang."""
    command = (sys.executable, "-P", "-m", "gigabrain_zenoh.qa.faults.hanging")
    return [
        replace(spec, argv=(*command, spec.argv[-1])) if spec.name == "decision" else spec
        for spec in specs
    ]


async def _killed(subject: Subject, victim: str) -> tuple[Stop, float]:
    """What came of it, and how far the body moved once the victim was back."""
    pid = subject.pid(victim)
    stop = await stop_by(subject, lambda: subject.kill(victim), victim)
    await subject.restarted(victim, pid)
    await subject.onlooker.ticks(RESTED_TICKS)
    return stop, await subject.distance() - stop.distance_m


async def _frozen(subject: Subject, victim: str, ticks: int) -> tuple[Stop, float]:
    """What came of it, and how far the body moved while the victim stood still so long."""
    stop = await stop_by(subject, lambda: subject.freeze(victim), victim)
    return stop, await creep(subject, ticks)


async def _thawed(subject: Subject, rest_m: float) -> dict[str, float]:
    """What the victim of a freeze has done since it thawed, until a person enables the robot."""
    subject.thaw()
    await subject.onlooker.ticks(RESTED_TICKS)
    truth = await subject.onlooker.truth()
    again_m = await subject.distance() - rest_m
    return {"stale executed": float(truth["stale_commands_executed"]), "moved again": again_m}


def _worse(one: Mapping[str, float], two: Mapping[str, float]) -> dict[str, float]:
    """All figures of both; of those that both have, the greater."""
    return {name: max(one.get(name, 0.0), two.get(name, 0.0)) for name in {**one, **two}}


def _figures(stop: Stop, again_m: float) -> dict[str, float]:
    return {**stop.figures(), "moved again": again_m}
