"""Observation of a demo run from outside, and the report on it."""

import asyncio
import contextlib
import time
from collections.abc import Mapping
from typing import Any

import psutil
from msgspec import Struct, structs

from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import (
    DESCRIBE,
    MAP,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.robot_view import SampledView
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.causes import LATE

UNKNOWN_CELL = b"\xff"
QUERY_TIMEOUT_S, QUERY_PAUSE_S = 1.0, 0.1  # of one query, and before the next
STARTED_S = psutil.Process().create_time()
MIN_DISTANCE_M = 0.05  # a shorter distance counts as no motion


class StartTimes(Struct, frozen=True, kw_only=True):
    """Times of events, in seconds of wall time since the command's start; None: not yet."""

    state_s: float | None = None  # first state of the body
    motion_s: float | None = None  # MIN_DISTANCE_M driven
    metre_s: float | None = None  # the first metre driven
    path_s: float | None = None  # first path planned in the robot's own map


class RunMonitor(SampledView):
    """Newest messages of a robot, and the distance that it has driven."""

    def __init__(self, bus: Bus) -> None:
        self.start_times = StartTimes()
        self.distance_m = 0.0  # by odometry
        self.turns = 0  # turns on the spot that the brain decided on
        self._turning = False
        self._boot = self._tick = 0
        self._ticks_before = 0  # sum of the driver's earlier starts
        self._last: RobotState | None = None
        super().__init__(bus)
        self.map = bus.latest(MAP)

    def look(self) -> None:
        """Decode the newest messages, and count. Called ten times a second."""
        for topic in self.sampled.values():
            topic.poll()
        self._count_ticks()
        self._add_distance(self.state.newest)
        self._count_turn(self.intent.newest)
        self._note_start_times()

    @property
    def problem(self) -> str:
        """Return the error that ended the processing of messages; an empty text without one."""
        failed = self.bus.failed
        return str(failed.exception()) if failed.done() else ""

    @property
    def seconds(self) -> float:
        """Return the robot's time since the first start of its driver [s]."""
        time = self.bus.time
        before = self._ticks_before + (self._tick if time.boot != self._boot else 0)
        return (before + time.tick) * TICK_S

    @property
    def drives(self) -> bool:
        """Return whether the body has a base."""
        return self.body is None or self.body.description.has_base

    @property
    def mapped_m2(self) -> float | None:
        """Return the area of the map known to be free or occupied [m2]; None without a map."""
        grid = self.map.current
        if grid is None:
            return None
        return (len(grid.cells) - grid.cells.count(UNKNOWN_CELL)) * grid.resolution**2

    def _note_start_times(self) -> None:
        """Store the time of each event that happened since the last look."""
        task = self.task.current
        happened = {
            "state_s": self.state.newest is not None,
            "motion_s": self.distance_m >= MIN_DISTANCE_M,
            "metre_s": self.distance_m >= 1.0,
            "path_s": task is not None and task.path != (),
        }
        stored = {name for name in happened if getattr(self.start_times, name) is not None}
        now_s = round(time.time() - STARTED_S, 2)
        new = {name: now_s for name, now in happened.items() if now and name not in stored}
        self.start_times = structs.replace(self.start_times, **new)

    @property
    def held_by_load(self) -> bool:
        """Return whether the brain is late for the gate while the processors are fully loaded."""
        state, verdict = self.state.newest, self.safety.current
        if state is None or verdict is None or not state.gate.enables:
            return False
        busy = any(warning.code == "cpu_busy" for warning in verdict.warnings)
        late = any(cause.code in LATE for cause in (*state.gate.causes, *verdict.causes))
        return busy and late and state.gate.mode in ("idle", "stopping")

    async def describe(self, process: str, timeout_s: float = 0.3) -> Description | None:
        """Return a process's description of itself; None without an answer in `timeout_s`.

        The query is repeated until then. After a stall of the machine, either side may have lost
        its session. The session recovers by itself, but queries in between are lost.
        """
        loop = asyncio.get_running_loop()
        end_s = loop.time() + timeout_s
        while (left_s := end_s - loop.time()) > 0:
            with contextlib.suppress(Refused):
                for reply in await self.bus.ask(
                    DESCRIBE,
                    DescribeRequest(),
                    timeout_s=min(left_s, QUERY_TIMEOUT_S),
                    name=process,
                ):
                    return reply
            await asyncio.sleep(min(left_s, QUERY_PAUSE_S))
        return None

    def _count_turn(self, intent: Intent | None) -> None:
        twist = intent.twist if intent else None
        turning = twist is not None and twist.angular_z != 0.0 and twist.linear_x == 0.0
        self.turns += turning and not self._turning
        self._turning = turning

    def _count_ticks(self) -> None:
        time = self.bus.time
        if time.boot != self._boot:
            self._ticks_before += self._tick
        self._boot, self._tick = time.boot, time.tick

    def _add_distance(self, state: RobotState | None) -> None:
        last, self._last = self._last, state
        if last and state and last.boot == state.boot:
            dx, dy = state.pose.x - last.pose.x, state.pose.y - last.pose.y
            self.distance_m += (dx * dx + dy * dy) ** 0.5


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
    drives: bool = True  # the body has a base, which is expected to move
    decisions: tuple[tuple[float, str], ...]
    turns: int  # turns on the spot that the brain decided on
    deaths: int
    restarts: int
    rejected: int
    problem: str = ""  # error that ended the observation early
    mapped_m2: float | None = None  # None unless a map is built
    tasks: TaskStatus | None = None  # None where no process has tasks
    start: StartTimes = StartTimes()
    answered: bool = True  # the driver answered the final request for its report


class Report(Struct, frozen=True, kw_only=True):
    """Results of one run. Contacts, clearance and distance are MuJoCo's ground truth.

    A body that is not simulated has no ground truth: contacts and clearance are null, and the
    distance is from odometry. They are also null if the driver did not answer at the end. Then
    figures that its last health message did not contain are null, too.
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
    tasks_done: int = 0  # goals reached and missions completed, of the last 16 tasks
    start: StartTimes = StartTimes()
    verdict: str  # "ok", or the faults in words

    @property
    def ok(self) -> bool:
        """Return whether the robot moved, touched nothing and lost no process."""
        return self.verdict == "ok"


def make_report(truth: Mapping[str, Any], seen: Observed) -> Report:
    """Combine the driver's own report (`truth`) with the observations from outside (`seen`)."""
    distance, contacts = float(truth.get("distance_m", seen.distance_m)), truth.get("contacts")
    return Report(
        body=truth.get("body", seen.body),
        world=seen.world,
        seed=seen.seed,
        sim_seconds=truth.get("sim_seconds", round(seen.seconds, 2)),
        distance_m=round(distance, 3),
        contacts=contacts,
        min_clearance_m=truth.get("min_clearance_m"),
        turns=seen.turns,
        restarts=seen.restarts,
        rejected_messages=seen.rejected,
        stale_commands_executed=truth.get("stale_commands_executed"),
        scan_to_cmd_ms=Latency(
            p50=truth.get("scan_to_cmd_p50_ms"), p99=truth.get("scan_to_cmd_p99_ms")
        ),
        speed=seen.speed,
        lockstep_timeouts=truth.get("lockstep_timeouts"),
        decisions=seen.decisions,
        mapped_m2=None if seen.mapped_m2 is None else round(seen.mapped_m2, 1),
        tasks_done=_succeeded(seen.tasks),
        start=seen.start,
        verdict=_verdict(distance, contacts or 0, seen),
    )


def _succeeded(status: TaskStatus | None) -> int:
    return sum(task.state == "succeeded" for task in status.done) if status else 0


def truth_in_health(health: Health | None) -> dict[str, Any]:
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
    if seen.drives and distance_m < MIN_DISTANCE_M:
        faults.append("no motion")
    if deaths:
        faults.append(f"{deaths} process{'es' if deaths > 1 else ''} died")
    if not seen.answered:
        faults.append("the driver did not answer at the end")
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
