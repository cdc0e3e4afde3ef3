"""Goals of an action as tasks: a cancel request or a newer goal ends one."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from gigabrain_zenoh.ros2.actions import Goal, GoalState, Outcome


class GoalTasks:
    """Carries out one goal at a time. The common part of all actions' handlers."""

    def __init__(self) -> None:
        self._works: dict[bytes, asyncio.Task[Outcome]] = {}  # by goal

    @property
    def busy(self) -> bool:
        """Return whether a goal is being carried out."""
        return bool(self._works)

    def cancel(self, goal: Goal) -> bool:
        """Cancel a goal, whose task then ends."""
        work = self._works.get(goal.id)
        if work:
            work.cancel()
        return True

    async def carried_out(
        self, goal: Goal, carry_out: Callable[[], Coroutine[Any, Any, Outcome]]
    ) -> Outcome:
        """Carry out a goal, which ends earlier ones; return its outcome."""
        if goal.cancel_requested:
            return Outcome(GoalState.CANCELED)
        before = list(self._works.values())
        work = self._works[goal.id] = asyncio.ensure_future(carry_out())
        for one in before:  # after the start of the new one, whose task replaces the robot's task
            one.cancel()
        try:
            return await work
        except asyncio.CancelledError:
            if not work.cancelled() or self._closing():
                work.cancel()
                raise
            return Outcome(GoalState.CANCELED if goal.cancel_requested else GoalState.ABORTED)
        finally:
            del self._works[goal.id]

    @staticmethod
    def _closing() -> bool:
        """Return whether the calling task is being cancelled."""
        task = asyncio.current_task()
        return task is not None and task.cancelling() > 0
