"""What a demo run came to."""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct

from gigabrain_schemas.safety import Health
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
    problem: str = ""  # why the run could not be watched to its end
    mapped_m2: float | None = None  # where a map is made
    tasks: TaskStatus | None = None  # where anybody has any
    answered: bool = True  # the driver told the truth in the end


class Report(Struct, frozen=True, kw_only=True):
    """One run. Contacts, clearance and distance are MuJoCo's truth, not the robot's own view.

    A body that is not simulated knows no such truth: its contacts and clearance are null, and its
    distance is that of its odometry. Where the driver did not answer in the end, they are null as
    well, and so is what its last health message did not hold.
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
    stale_commands_executed: int | None
    scan_to_cmd_ms: Latency
    speed: float
    lockstep_timeouts: int | None
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
        stale_commands_executed=told.get("stale_commands_executed"),
        scan_to_cmd_ms=Latency(
            p50=told.get("scan_to_cmd_p50_ms"), p99=told.get("scan_to_cmd_p99_ms")
        ),
        speed=seen.speed,
        lockstep_timeouts=told.get("lockstep_timeouts"),
        decisions=seen.decisions,
        mapped_m2=None if seen.mapped_m2 is None else round(seen.mapped_m2, 1),
        tasks_done=_succeeded(seen.tasks),
        verdict=_verdict(distance, contacts or 0, seen),
    )


def _succeeded(status: TaskStatus | None) -> int:
    return sum(task.state == "succeeded" for task in status.done) if status else 0


def last_told(health: Health | None) -> dict[str, Any]:
    """What the last health message of a driver that no longer answers holds of its report."""
    if health is None:
        return {}
    counted = ("stale_commands_executed", "lockstep_timeouts")
    times = {f"{name}_ms": value for name, value in health.latency_ms.items()}
    return times | {name: health.counters.get(name, 0) for name in counted}


def _verdict(distance_m: float, contacts: int, seen: Observed) -> str:
    faults, deaths = [], seen.deaths
    if contacts:
        faults.append(_count(contacts, "contact"))
    if distance_m < MOTION_M:
        faults.append("no motion")
    if deaths:
        faults.append(f"{deaths} process{'es' if deaths > 1 else ''} died")
    if not seen.answered:
        faults.append("the driver did not answer in the end")
    if seen.problem:
        faults.append(seen.problem)
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
