"""Goals of an action as tasks: a cancel request ends one, and a newer goal the one before."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from gigabrain_zenoh.ros2.actions import Goal, GoalState, Outcome


class GoalTasks:
    """Carries out one goal at a time. The part of an action's handler that all have in common."""

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
        """Return the outcome of a goal that ends those before it."""
        if goal.cancel_requested:
            return Outcome(GoalState.CANCELED)
        before = list(self._works.values())
        work = self._works[goal.id] = asyncio.ensure_future(carry_out())
        for one in before:  # after the new one is begun, whose task takes the place of its own
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
        """Return whether the task that runs this is itself cancelled."""
        task = asyncio.current_task()
        return task is not None and task.cancelling() > 0
