"""What a demo run came to."""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct

from gigabrain_schemas.tasks import TaskStatus

MOTION_M = 0.05  # less than this is no motion


class Latency(Struct, frozen=True, kw_only=True):
    """From a scan's departure at the driver to the command that rests on it [ms]."""

    p50: float | None
    p99: float | None


class Observed(Struct, frozen=True, kw_only=True):
    """What was seen of a run from outside."""

    body: str
    world: str
    seed: int
    speed: float
    seconds: float  # of the robot's time
    distance_m: float  # by odometry
    decisions: tuple[tuple[float, str], ...]
    deaths: int
    restarts: int
    rejected: int
    mapped_m2: float | None = None  # where a map is made
    tasks: TaskStatus | None = None  # where anybody has any


class Report(Struct, frozen=True, kw_only=True):
    """One run. Contacts, clearance and distance are MuJoCo's truth, not the robot's own view.

    A body that is not simulated knows no such truth: its contacts and clearance are null, and its
    distance is that of its odometry.
    """

    body: str
    world: str
    seed: int
    sim_seconds: float
    distance_m: float
    contacts: int | None
    min_clearance_m: float | None
    turns: int
    restarts: int
    rejected_messages: int
    stale_commands_executed: int
    scan_to_cmd_ms: Latency
    speed: float
    lockstep_timeouts: int
    decisions: tuple[tuple[float, str], ...]  # simulated time [s] and the decision in words
    mapped_m2: float | None = None  # of the map, known to be free or taken
    tasks_done: int = 0  # of the last 16 that ended: goals reached, missions carried out
    verdict: str  # "ok", or why not

    @property
    def ok(self) -> bool:
        """Whether the robot moved, touched nothing and lost no process."""
        return self.verdict == "ok"


def make_report(told: Mapping[str, Any], seen: Observed) -> Report:
    """Put together what the driver says of itself and of the truth, and what else was seen."""
    distance, contacts = float(told.get("distance_m", seen.distance_m)), told.get("contacts")
    return Report(
        body=told.get("body", seen.body),
        world=seen.world,
        seed=seen.seed,
        sim_seconds=told.get("sim_seconds", round(seen.seconds, 2)),
        distance_m=round(distance, 3),
        contacts=contacts,
        min_clearance_m=told.get("min_clearance_m"),
        turns=sum(words.startswith("turning") for _, words in seen.decisions),
        restarts=seen.restarts,
        rejected_messages=seen.rejected,
        stale_commands_executed=told["stale_commands_executed"],
        scan_to_cmd_ms=Latency(p50=told["scan_to_cmd_p50_ms"], p99=told["scan_to_cmd_p99_ms"]),
        speed=seen.speed,
        lockstep_timeouts=told["lockstep_timeouts"],
        decisions=seen.decisions,
        mapped_m2=None if seen.mapped_m2 is None else round(seen.mapped_m2, 1),
        tasks_done=_succeeded(seen.tasks),
        verdict=_verdict(distance, contacts or 0, seen.deaths),
    )


def _succeeded(status: TaskStatus | None) -> int:
    return sum(task.state == "succeeded" for task in status.done) if status else 0


def _verdict(distance_m: float, contacts: int, deaths: int) -> str:
    faults = []
    if contacts:
        faults.append(_count(contacts, "contact"))
    if distance_m < MOTION_M:
        faults.append("no motion")
    if deaths:
        faults.append(f"{deaths} process{'es' if deaths > 1 else ''} died")
    return ", ".join(faults) or "ok"


def summary(report: Report) -> str:
    """One line for people."""
    p50, p99 = report.scan_to_cmd_ms.p50 or 0.0, report.scan_to_cmd_ms.p99 or 0.0
    parts = [
        f"{report.verdict}: {report.distance_m:.2f} m in {report.sim_seconds:.0f} s",
        *_done(report),
    ]
    if report.contacts is not None and report.min_clearance_m is not None:
        parts += [_count(report.contacts, "contact"), f"closest {report.min_clearance_m:.2f} m"]
    return ", ".join([*parts, f"scan to command {p50:.1f} ms (p99 {p99:.1f})"])


def _done(report: Report) -> list[str]:
    """What it has done: a robot that maps does not count its turns."""
    if report.mapped_m2 is None:
        return [_count(report.turns, "turn")]
    done = [_count(report.tasks_done, "task") + " done"] if report.tasks_done else []
    return [f"{report.mapped_m2:.0f} m² mapped", *done]


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
