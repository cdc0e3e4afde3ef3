"""Faults of processes: killed, frozen, hanging, and dying again and again."""

from gigabrain_zenoh.faults.fault import Measured
from gigabrain_zenoh.faults.rig import Rig
from gigabrain_zenoh.faults.stopping import Stop, creep, stop_by
from gigabrain_zenoh.faults.subject import Subject

RESTED_TICKS = 50  # how long a robot has to stand after all is well again


async def decision_killed(rig: Rig) -> Measured:
    """kill -9 while it drives."""
    return _figures(*await _killed(await rig.robot("sim"), "decision"))


async def decision_frozen(rig: Rig) -> Measured:
    """SIGSTOP while it drives: liveliness would not notice."""
    return _figures(*await _frozen(await rig.robot("sim"), "decision"))


async def perception_killed(rig: Rig) -> Measured:
    """kill -9: what the brain knows grows old."""
    return _figures(*await _killed(await rig.robot("sim"), "perception"))


async def _killed(subject: Subject, victim: str) -> tuple[Stop, float]:
    """What came of it, and how far the body moved once the victim was back."""
    pid = subject.pid(victim)
    stop = await stop_by(subject, lambda: subject.kill(victim), victim)
    await subject.restarted(victim, pid)
    await subject.onlooker.ticks(RESTED_TICKS)
    return stop, await subject.distance() - stop.distance_m


async def _frozen(subject: Subject, victim: str) -> tuple[Stop, float]:
    """What came of it, and how far the body moved while the victim stood still."""
    stop = await stop_by(subject, lambda: subject.freeze(victim), victim)
    return stop, await creep(subject, RESTED_TICKS)


def _figures(stop: Stop, again_m: float) -> dict[str, float]:
    return {"zero after": stop.zero_ms, "travel": stop.travel_m, "moved again": again_m}
