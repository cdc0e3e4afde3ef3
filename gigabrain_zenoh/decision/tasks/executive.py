"""The queue of tasks, and the one that is being carried out. No clock, no bus, no disk."""

import itertools

import msgspec
from msgspec import Struct
from py_trees.common import Status

from gigabrain_schemas.tasks import Goal, How, Task, TaskState, TaskStatus
from gigabrain_zenoh.decision.tasks import checks
from gigabrain_zenoh.decision.tasks.conditions import Read
from gigabrain_zenoh.decision.tasks.job import Job, SavedJob
from gigabrain_zenoh.decision.tasks.mission import Mission, goal_mission
from gigabrain_zenoh.decision.tasks.moment import Moment, Start
from gigabrain_zenoh.decision.tasks.orders import Order, Outcome, where
from gigabrain_zenoh.errors import ConfigError, Refused

MOST_WAITING, MOST_DONE = 32, 16
AFTER_A_RESTART = "the robot was started anew; resume it, or cancel it"


class Saved(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="gigabrain tasks"):
    """All tasks, as the file holds them."""

    boot: int = 0  # start of the driver in which they were begun
    count: int = 0  # tasks that there have been
    jobs: tuple[SavedJob, ...] = ()  # the present one first


class Executive:
    """Carries out one task after the other."""

    def __init__(self, read: Read, start: Start, saved: Saved) -> None:
        self._read, self._start, self._numbers = read, start, itertools.count(1)
        self._count, self._boot = saved.count, saved.boot
        self._jobs: list[Job] = []
        self._done: list[Task] = []
        self._outcome: Outcome | None = None
        for one in saved.jobs:
            try:
                mission = checks.loads(one.mission, one.label)
            except ConfigError as error:
                self._done.insert(0, _unreadable(one, error))
                continue
            self._jobs.append(Job(one, mission, self._moment()))
        self._from_disk = list(self._jobs)

    def meet(self, boot: int) -> None:
        """Take note of the driver's start: what the disk has of another one waits for a person."""
        if self._boot != boot:
            for job in self._from_disk:
                job.held, job.why_held = True, AFTER_A_RESTART
        self._boot, self._from_disk = boot, []

    def go_to(self, goal: Goal, how: How, source: str) -> str:
        """A new goal; its name. Raises Refused where too many wait."""
        return self._add("goal", goal_mission(goal), where(goal), how, source)

    def carry_out(self, mission: Mission, label: str, how: How, source: str) -> str:
        """A new mission; its name. Raises Refused where too many wait."""
        return self._add("mission", mission, label, how, source)

    def cancel(self, name: str, source: str) -> str:
        """End a task, the present one without a name, or all; in words. Raises Refused."""
        if name == "all":
            count = len(self._jobs)
            while self._jobs:
                self._end(self._jobs[-1], "cancelled", f"cancelled by {source}")
            return f"{count} tasks are cancelled" if count != 1 else "1 task is cancelled"
        job = self._named(name)
        self._end(job, "cancelled", f"cancelled by {source}")
        return f"{job.id} is cancelled"

    def pause(self, name: str, source: str) -> str:
        """Have a task wait for a person; in words. Raises Refused."""
        job = self._named(name)
        job.held, job.why_held = True, f"paused by {source}"
        return f"{job.id} is paused"

    def resume(self, name: str) -> str:
        """Have a task that waits for a person go on; in words. Raises Refused."""
        job = self._named(name)
        if not job.held:
            raise Refused(f"{job.id} is not paused")
        job.held, job.why_held = False, ""
        return f"{job.id} goes on"

    def step(self, seconds: float, outcome: Outcome | None) -> Order | None:
        """Go on, `seconds` after the last step; what is wanted of whoever drives."""
        self._outcome = outcome
        while self._jobs:
            job = self._jobs[0]
            if job.held:
                return None
            status = job.step(seconds, outcome)
            if status is Status.RUNNING:
                return job.order
            succeeded = status is Status.SUCCESS
            reason = outcome.reason if outcome and succeeded else job.moment.problem
            self._end(job, "succeeded" if succeeded else "failed", reason, outcome)
            outcome, seconds = None, 0.0
        return None

    def knows(self, boot: int) -> bool:
        """Whether this start of the driver is the one that it, or the disk, was last at work in."""
        return self._boot == boot

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return not self._jobs

    @property
    def waits(self) -> str:
        """What the robot waits for where nothing is wanted of whoever drives, in words."""
        if not self._jobs:
            return "waiting: for a goal"
        job = self._jobs[0]
        if job.held:
            return f"{job.id} is paused: {job.why_held}"
        return job.moment.doing or "waiting: for a goal"

    @property
    def saved(self) -> Saved:
        """What survives a restart."""
        jobs = tuple(job.saved for job in self._jobs)
        return Saved(boot=self._boot, count=self._count, jobs=jobs)

    @property
    def status(self) -> TaskStatus:
        """All that others may know."""
        queue = tuple(_waiting(job, self._jobs[0].id) for job in self._jobs[1:])
        done = tuple(self._done)
        if not self._jobs:
            return TaskStatus(done=done)
        job = self._jobs[0]
        if job.held:
            return TaskStatus(current=job.told("paused", job.why_held), queue=queue, done=done)
        moment, outcome = job.moment, self._outcome
        if moment.order is None or outcome is None or outcome.number != moment.order.number:
            outcome = Outcome(number=0, progress=moment.progress or 0.0, eta=moment.left_s)
        return TaskStatus(
            current=job.told("active", outcome.reason or moment.doing),
            doing=moment.doing[:500],
            drives=moment.order is not None,
            progress=min(1.0, max(0.0, outcome.progress)),
            distance_remaining=outcome.distance,
            eta=outcome.eta,
            goal=outcome.goal,
            path=outcome.path,
            queue=queue,
            done=done,
        )

    def _add(self, kind: str, mission: Mission, label: str, how: How, source: str) -> str:
        if how != "replace" and len(self._jobs) > MOST_WAITING:
            raise Refused(f"{MOST_WAITING} tasks wait already; cancel some first")
        self._count += 1
        name = f"{kind}-{self._count}"
        saved = SavedJob(
            id=name, kind="goal" if kind == "goal" else "mission", label=label, source=source,
            mission=msgspec.json.encode(mission).decode(),
        )  # fmt: skip
        job = Job(saved, mission, self._moment())
        while how == "replace" and self._jobs:
            self._end(self._jobs[-1], "cancelled", f"replaced by {name}")
        self._jobs.insert(len(self._jobs) if how == "queue" else 0, job)
        return name

    def _moment(self) -> Moment:
        return Moment(self._read, self._start, self._numbers)

    def _named(self, name: str) -> Job:
        if not self._jobs:
            raise Refused("there is nothing to do, so nothing to change")
        if not name:
            return self._jobs[0]
        for job in self._jobs:
            if job.id == name:
                return job
        there = ", ".join(job.id for job in self._jobs)
        raise Refused(f"there is no task {name!r} any more; there is: {there}")

    def _end(self, job: Job, state: TaskState, reason: str, outcome: Outcome | None = None) -> None:
        self._jobs.remove(job)
        job.stop()
        self._done = [job.told(state, reason, outcome), *self._done][:MOST_DONE]


def _waiting(job: Job, first: str) -> Task:
    if job.held:
        return job.told("paused", job.why_held)
    return job.told("paused", f"until {first} is done") if job.begun else job.told("queued")


def _unreadable(one: SavedJob, error: ConfigError) -> Task:
    return Task(
        id=one.id[:64], kind=one.kind, label=one.label[:64], source=one.source[:64],
        state="failed", reason=f"it cannot be carried out any more: {error}"[:500],
    )  # fmt: skip
