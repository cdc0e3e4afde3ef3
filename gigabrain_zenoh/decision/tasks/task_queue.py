"""The queue of tasks with the active one first. Only `TaskFile` uses the disk."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct
from py_trees.common import Status

from gigabrain_schemas.base import Name
from gigabrain_schemas.tasks import MAX_REQUEST_BYTES, Goal, How, Task, TaskState, TaskStatus
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.decision.behaviours import (
    Command,
    DriveCommand,
    Idle,
    StepOutcome,
    describe_goal,
)
from gigabrain_zenoh.decision.known_objects import Seek, Wanted, named
from gigabrain_zenoh.decision.tasks.arm_steps import Held, Solid
from gigabrain_zenoh.decision.tasks.behaviour_tree import (
    Progress,
    TreeBuilder,
    progress_of,
    restore,
)
from gigabrain_zenoh.decision.tasks.conditions import Read
from gigabrain_zenoh.decision.tasks.leaves import Hand, MissionContext, seek_nothing
from gigabrain_zenoh.decision.tasks.mission import Mission, find_mission, goal_mission
from gigabrain_zenoh.decision.tasks.mission_files import restored
from gigabrain_zenoh.decision.tasks.scripts import RunningScripts, StartScript
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.host.files import make_folder, read_bounded, replace_file, too_large

MAX_QUEUED, MAX_DONE = 32, 16
MAX_JSON_GROWTH = 10  # JSON is longer than a mission's text: more digits, places of moved things
MAX_FILE_BYTES = (MAX_QUEUED + 1) * MAX_JSON_GROWTH * MAX_REQUEST_BYTES
LOST = "tasks will not survive a restart"
AFTER_A_RESTART = "the robot was restarted; resume the task, or cancel it"
NO_GOAL = Idle("waiting", "waiting: for a goal")


class SavedJob(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A task in the task file."""

    id: str
    kind: Literal["goal", "mission"]
    label: str
    source: str
    mission: str  # as JSON
    held: bool = False
    why_held: str = ""
    memory: Progress = {}
    things: dict[Name, Solid] | None = None  # their current state; None: as in the mission


class Job:
    """A task with the tree of its mission. A goal is a mission of one step."""

    def __init__(self, saved: SavedJob, mission: Mission, context: MissionContext) -> None:
        self._saved, self.context = saved, context
        self.id, self.begun = saved.id, bool(saved.memory)
        self.held, self.why_held = saved.held, saved.why_held  # held: paused by a person
        self._root = TreeBuilder(mission, context).tree()
        self._has_things = bool(mission.things)
        if saved.things is not None:
            context.things = dict(saved.things)
        restore(self._root, saved.memory)

    def step(self, seconds: float, outcome: StepOutcome | None) -> Status:
        """Tick the tree once, `seconds` after the last tick."""
        self.context.begin(seconds if self.begun else 0.0, outcome)
        self.begun = True
        self._root.tick_once()
        return self._root.status

    def stop(self) -> None:
        """Stop all nodes."""
        self._root.stop(Status.INVALID)

    @property
    def saved(self) -> SavedJob:
        """The part that survives a restart."""
        return SavedJob(
            id=self.id, kind=self._saved.kind, label=self._saved.label, source=self._saved.source,
            mission=self._saved.mission, held=self.held, why_held=self.why_held,
            memory=progress_of(self._root, self.context.free_s),
            things=dict(self.context.things) if self._has_things else None,
        )  # fmt: skip

    def task(self, state: TaskState, reason: str = "", outcome: StepOutcome | None = None) -> Task:
        """Return the task as published; `outcome` has the errors of a goal that ended."""
        saved = self._saved
        measured = outcome if saved.kind == "goal" else None
        return Task(
            id=self.id, kind=saved.kind, label=saved.label[:64], source=saved.source[:64],
            state=state, reason=reason[:500],
            position_error=measured.position_error if measured else None,
            heading_error=measured.heading_error if measured else None,
        )  # fmt: skip


class Saved(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="gigabrain tasks"):
    """The content of the task file."""

    boot: int = 0  # start of the driver in which the tasks were begun
    count: int = 0  # of all tasks so far
    jobs: tuple[SavedJob, ...] = ()  # the active one first
    held: Held | None = None  # what the gripper holds
    map: Name = ""  # the one that they are for, see Zones
    maps_loaded: int | None = None  # None while that is not known


class TaskQueue:
    """Carries out one task after the other."""

    def __init__(
        self, read: Read, start: StartScript, saved: Saved, seek: Seek = seek_nothing
    ) -> None:
        self._read, self._scripts, self._numbers = read, RunningScripts(start), itertools.count(1)
        self._seek, self._hand = seek, Hand(saved.held)
        self._count, self._boot = saved.count, saved.boot
        self._jobs: list[Job] = []
        self._done: list[Task] = []
        self._outcome: StepOutcome | None = None
        for job in saved.jobs:
            try:
                mission = restored(job.mission, job.label)
            except ConfigError as error:
                self._done.insert(0, _unreadable(job, error))
                continue
            self._jobs.append(Job(job, mission, self._context()))
        self._from_disk = list(self._jobs)

    def restart(self, boot: int) -> None:
        """Record a start of the driver; tasks of an earlier start are paused for a person."""
        if self._boot != boot:
            for job in self._from_disk:
                job.held, job.why_held = True, AFTER_A_RESTART
        self._boot, self._from_disk = boot, []

    def add_goal(self, goal: Goal, how: How, source: str, place: str = "") -> str:
        """Add a goal, and return its task's name. Raises Refused if the queue is full."""
        label = f"{place} {describe_goal(goal)}".strip()[:64]
        return self._add("goal", goal_mission(goal), label, how, source)

    def add_find(self, wanted: Wanted, how: How, source: str) -> str:
        """Add a search, and return its task's name. Raises Refused if the queue is full."""
        return self._add("goal", find_mission(wanted), f"find {named(wanted)}"[:64], how, source)

    def add_mission(self, mission: Mission, label: str, how: How, source: str) -> str:
        """Add a mission, and return its name. Raises Refused if the queue is full."""
        return self._add("mission", mission, label, how, source)

    def cancel(self, name: str, source: str) -> str:
        """Cancel a task by name, the active one ("") or "all"; return a text. Raises Refused."""
        if name == "all":
            count = len(self._jobs)
            while self._jobs:
                self._end(self._jobs[-1], "cancelled", f"cancelled by {source}")
            return f"{count} tasks are cancelled" if count != 1 else "1 task is cancelled"
        job = self._job(name)
        self._end(job, "cancelled", f"cancelled by {source}")
        return f"{job.id} is cancelled"

    def pause(self, name: str, source: str) -> str:
        """Pause a task; return a text. Raises Refused."""
        job = self._job(name)
        job.held, job.why_held = True, f"paused by {source}"
        return f"{job.id} is paused"

    def resume(self, name: str) -> str:
        """Resume a paused task, or confirm that a task that hands over may let go.

        Return a text. Raises Refused.
        """
        job = self._job(name)
        if not job.held and job is self._jobs[0] and job.context.offers:
            job.context.may_let_go = True
            return f"{job.id} opens the gripper"
        if not job.held and job is not self._jobs[0]:
            raise Refused(f"{job.id} waits for {self._jobs[0].id}; it continues after that")
        if not job.held:
            raise Refused(f"{job.id} is not paused")
        job.held, job.why_held = False, ""
        return f"{job.id} is resumed"

    def step(self, seconds: float, outcome: StepOutcome | None) -> tuple[Command | None, Idle]:
        """Advance by `seconds` with the last command's outcome.

        Return the next command, and the reason to stand still if there is none.
        """
        self._outcome = outcome
        command_or_idle = self._advance(seconds, outcome)
        self._scripts.settle()
        return command_or_idle

    def _advance(self, seconds: float, outcome: StepOutcome | None) -> tuple[Command | None, Idle]:
        while self._jobs:
            job = self._jobs[0]
            if job.held:
                return None, Idle(f"{job.id} is paused", f"{job.id} is paused: {job.why_held}")
            status, doing = job.step(seconds, outcome), job.context.doing
            if status is Status.RUNNING:
                return job.context.command, Idle(doing, doing) if doing else NO_GOAL
            succeeded = status is Status.SUCCESS
            done = outcome.reason if outcome and outcome.state == "done" else ""
            reason = done if succeeded else job.context.problem
            self._end(job, "succeeded" if succeeded else "failed", reason, outcome)
            outcome, seconds = None, 0.0
        return None, NO_GOAL

    def is_unused(self, boot: int) -> bool:
        """Return whether there is no task, and was none since this start of the driver."""
        return not self._jobs and self._boot != boot

    @property
    def held(self) -> Held | None:
        """Return what the gripper holds; None if that is nothing or unknown."""
        return self._hand.held

    @property
    def saved(self) -> Saved:
        """The part that survives a restart."""
        jobs = tuple(job.saved for job in self._jobs)
        return Saved(boot=self._boot, count=self._count, jobs=jobs, held=self._hand.held)

    @property
    def status(self) -> TaskStatus:
        """All tasks, as published."""
        queue = tuple(_queued(job, self._jobs[0].id) for job in self._jobs[1:])
        done = tuple(self._done)
        if not self._jobs:
            return TaskStatus(done=done)
        job = self._jobs[0]
        if job.held:
            return TaskStatus(current=job.task("paused", job.why_held), queue=queue, done=done)
        context, outcome = job.context, self._outcome
        command = context.command
        if command is None or outcome is None or outcome.number != command.number:
            outcome = StepOutcome(progress=context.progress or 0.0, eta=context.left_s)
        return TaskStatus(
            current=job.task("active", outcome.reason or context.doing),
            doing=context.doing[:500],
            drives=isinstance(command, DriveCommand),
            progress=min(1.0, max(0.0, outcome.progress)),
            distance_remaining=outcome.distance,
            eta=outcome.eta,
            goal=outcome.goal,
            path=outcome.path,
            queue=queue,
            done=done,
        )

    def _add(self, kind: str, mission: Mission, label: str, how: How, source: str) -> str:
        if how != "replace" and len(self._jobs) > MAX_QUEUED:
            raise Refused(f"{MAX_QUEUED} tasks wait already; cancel some first")
        self._count += 1
        name = f"{kind}-{self._count}"
        saved = SavedJob(
            id=name, kind="goal" if kind == "goal" else "mission", label=label, source=source,
            mission=msgspec.json.encode(mission).decode(),
        )  # fmt: skip
        job = Job(saved, mission, self._context())
        while how == "replace" and self._jobs:
            self._end(self._jobs[-1], "cancelled", f"replaced by {name}")
        self._jobs.insert(len(self._jobs) if how == "queue" else 0, job)
        return name

    def _context(self) -> MissionContext:
        return MissionContext(self._read, self._scripts, self._numbers, self._seek, self._hand)

    def _job(self, name: str) -> Job:
        if not self._jobs:
            raise Refused("there is no task")
        if not name:
            return self._jobs[0]
        for job in self._jobs:
            if job.id == name:
                return job
        known = ", ".join(job.id for job in self._jobs)
        raise Refused(f"there is no task {name!r}; tasks: {known}")

    def _end(
        self, job: Job, state: TaskState, reason: str, outcome: StepOutcome | None = None
    ) -> None:
        self._jobs.remove(job)
        job.stop()
        self._done = [job.task(state, reason, outcome), *self._done][:MAX_DONE]


def _queued(job: Job, first: str) -> Task:
    if job.held:
        return job.task("paused", job.why_held)
    return job.task("paused", f"preempted by {first}") if job.begun else job.task("queued")


def _unreadable(job: SavedJob, error: ConfigError) -> Task:
    return Task(
        id=job.id[:64], kind=job.kind, label=job.label[:64], source=job.source[:64],
        state="failed", reason=f"the saved mission is invalid: {error}"[:500],
    )  # fmt: skip


class TaskFile:
    """The file that keeps tasks over a restart of decision; without a folder there is none.

    Each write replaces the whole file and syncs it.
    """

    def __init__(self, folder: str) -> None:
        self._path = Path(folder) / "tasks.json" if folder else None

    def read(self) -> tuple[Saved, str]:
        """Return the saved tasks, and a problem in one line. A damaged file is renamed."""
        if self._path is None:
            return Saved(), ""
        try:
            return msgspec.json.decode(read_bounded(self._path, MAX_FILE_BYTES), type=Saved), ""
        except FileNotFoundError:
            return Saved(), ""
        except OSError as error:
            return Saved(), f"{self._path} cannot be read: {error.strerror}; no tasks restored"
        except (ConfigError, *DECODE_ERRORS) as error:
            return Saved(), self._set_aside(self._path, error)

    def write(self, newest: Sequence[Saved]) -> str:
        """Write the last of `newest`; return the problem in one line, or an empty text."""
        if self._path is None:
            return ""
        data = msgspec.json.encode(newest[-1])
        if len(data) > MAX_FILE_BYTES:  # `read` would refuse it
            return f"not saved: {too_large(self._path, len(data), MAX_FILE_BYTES)}; {LOST}"
        try:
            make_folder(self._path.parent)
            replace_file(self._path, data)
        except OSError as error:
            return f"cannot write {self._path}: {error.strerror}; {LOST}"
        return ""

    def _set_aside(self, path: Path, error: Exception) -> str:
        bad = path.with_suffix(".bad")
        try:
            path.replace(bad)
        except OSError as problem:
            return f"{path} is damaged ({error}) and cannot be renamed: {problem.strerror}"
        return f"{path} is damaged ({error}); renamed to {bad}, no tasks restored"
