"""One task while it is being carried out, and what of it survives a restart."""

from typing import Annotated, Literal

from msgspec import Meta, Struct
from py_trees.common import Status

from gigabrain_schemas.tasks import Task, TaskState
from gigabrain_zenoh.decision.tasks.growing import Grower, remembered, restore
from gigabrain_zenoh.decision.tasks.mission import Mission
from gigabrain_zenoh.decision.tasks.moment import Moment
from gigabrain_zenoh.decision.tasks.orders import Order, Outcome

Index = Annotated[float, Meta(ge=0, le=1e9)]


class SavedJob(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A task as the file holds it."""

    id: str
    kind: Literal["goal", "mission"]
    label: str
    source: str
    mission: str  # as JSON, which is YAML too
    held: bool = False
    memory: dict[str, Index] = {}


class Job:
    """A mission with its nodes. A goal is a mission of one step."""

    def __init__(self, saved: SavedJob, mission: Mission, moment: Moment) -> None:
        self._saved, self._moment = saved, moment
        self.id, self.held = saved.id, saved.held  # held: paused by a person
        self.mission, self.begun = mission, bool(saved.memory)
        self.why_held = ""
        self._root = Grower(mission, moment).tree()
        restore(self._root, saved.memory)

    def step(self, seconds: float, outcome: Outcome | None) -> Status:
        """Tick the tree once, `seconds` after the last tick."""
        self._moment.begin(seconds if self.begun else 0.0, outcome)
        self.begun = True
        self._root.tick_once()
        return self._root.status

    def stop(self) -> None:
        """Nothing of it goes on."""
        self._root.stop(Status.INVALID)

    @property
    def order(self) -> Order | None:
        """What it wants of whoever drives."""
        return self._moment.order

    @property
    def moment(self) -> Moment:
        """What its nodes say."""
        return self._moment

    @property
    def saved(self) -> SavedJob:
        """What survives a restart."""
        return SavedJob(
            id=self.id, kind=self._saved.kind, label=self._saved.label, source=self._saved.source,
            mission=self._saved.mission, held=self.held,
            memory=remembered(self._root, self._moment.free_s),
        )  # fmt: skip

    def told(self, state: TaskState, reason: str = "", outcome: Outcome | None = None) -> Task:
        """As others see it; of a goal that has ended, with how far from it the robot is."""
        saved = self._saved
        measured = outcome if saved.kind == "goal" else None
        return Task(
            id=self.id, kind=saved.kind, label=saved.label[:64], source=saved.source[:64],
            state=state, reason=reason[:500],
            position_error=measured.position_error if measured else None,
            heading_error=measured.heading_error if measured else None,
        )  # fmt: skip
