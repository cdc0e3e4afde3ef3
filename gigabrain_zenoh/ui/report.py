"""Report of a demo run, and its one-line summary."""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct

from gigabrain_schemas.safety import Health
from gigabrain_schemas.tasks import TaskStatus

MOTION_M = 0.05  # a shorter distance counts as no motion


class Latency(Struct, frozen=True, kw_only=True):
    """Latency from a scan's departure at the driver to the command based on it [ms]."""

    p50: float | None
    p99: float | None


class Observed(Struct, frozen=True, kw_only=True):
    """Observations of a run from outside the driver."""

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
    mapped_m2: float | None = None  # None unless a map is built
    tasks: TaskStatus | None = None  # None where no process has tasks
    answered: bool = True  # the driver answered the final request for its report


class Report(Struct, frozen=True, kw_only=True):
    """Results of one run. Contacts, clearance and distance are MuJoCo's ground truth.

    A body that is not simulated has no ground truth: contacts and clearance are null, and the
    distance is from odometry. They are null too if the driver did not answer at the end. So are
    figures that its last health message did not contain.
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
    mapped_m2: float | None = None  # area of the map known to be free or occupied
    tasks_done: int = 0  # among the last 16 that ended: goals reached and missions completed
    verdict: str  # "ok", or the faults in words

    @property
    def ok(self) -> bool:
        """Return whether the robot moved, touched nothing and lost no process."""
        return self.verdict == "ok"


def make_report(told: Mapping[str, Any], seen: Observed) -> Report:
    """Combine the driver's own report (`told`) with the observations from outside (`seen`)."""
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
    """Return the part of a driver's report that its last health message contains.

    Used when the driver no longer answers.
    """
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
    """Format the report as one line for people."""
    p50, p99 = report.scan_to_cmd_ms.p50 or 0.0, report.scan_to_cmd_ms.p99 or 0.0
    parts = [
        f"{report.verdict}: {report.distance_m:.2f} m in {report.sim_seconds:.0f} s",
        *_done(report),
    ]
    if report.contacts is not None and report.min_clearance_m is not None:
        parts += [_count(report.contacts, "contact"), f"closest {report.min_clearance_m:.2f} m"]
    return ", ".join([*parts, f"scan to command {p50:.1f} ms (p99 {p99:.1f})"])


def _done(report: Report) -> list[str]:
    """Return the work done in words: turns, or mapped area and tasks for a robot that maps."""
    if report.mapped_m2 is None:
        return [_count(report.turns, "turn")]
    done = [_count(report.tasks_done, "task") + " done"] if report.tasks_done else []
    return [f"{report.mapped_m2:.0f} m² mapped", *done]


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
