"""Inputs and services that decision needs for the behaviour `navigate`.

Goals are accepted from the start, while the planning kernels still compile.
"""

import asyncio
from typing import TYPE_CHECKING

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.behaviours import Behaviour, Situation
from gigabrain_zenoh.decision.tasks.mission import roaming
from gigabrain_zenoh.decision.tasks.orders import Outcome
from gigabrain_zenoh.decision.tasks.service import TaskService
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.kernels.compiling import compiled

if TYPE_CHECKING:
    from gigabrain_zenoh.decision.steering import Steering

DRIVE_KERNELS = "gigabrain_zenoh.decision.steering:warm_up"  # calls each kernel once, to compile it
GETTING_READY = "it is getting ready"
TOLD_NS = 200_000_000  # interval between status updates while getting ready
PATIENCE_NS, LOOK_NS = 700_000_000, 50_000_000  # wait for a first pose; poll interval


class Navigating:
    """Provider of orders and situations for the behaviour `navigate`."""

    def __init__(self, config: DecisionConfig, bus: Bus) -> None:
        self._bus, self._config = bus, config
        self._service = TaskService(bus, self, folder=config.state_dir, scripts=config.scripts)
        self._ready: Steering | None = None
        self._outcome: Outcome | None = None
        self._begun = False

    async def warm_up(self) -> None:
        """Import and compile everything that driving needs. Raises ConfigError."""
        telling = asyncio.ensure_future(self._tell())
        try:
            await compiled(DRIVE_KERNELS)
        finally:
            telling.cancel()
        from gigabrain_zenoh.decision.steering import Steering  # imports numba: for `navigate` only

        self._ready = Steering(self._config, self._bus)

    async def _tell(self) -> None:
        while True:
            self._service.tell(f"waiting: {GETTING_READY}")
            await self._bus.clock.sleep_ns(TOLD_NS)

    @property
    def _steering(self) -> "Steering":
        assert self._ready
        return self._ready

    def see(self, state: RobotState) -> None:
        """Record a robot state; to be called with every state."""
        self._steering.see(state)

    def situation(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> Situation:
        """Return the robot's pose, its current order and its route."""
        if self._config.begin == "roam" and not self._begun:
            self._service.begin(roaming(), "roaming", state.boot)
        self._begun = True
        tick = world.basis if world else state.tick
        order = self._service.step(state, self._outcome, tick)
        self._outcome = None
        waits = "" if order else self._service.waits
        return self._steering.situation(state, world, verdict, order, waits)

    def heed(self, behaviour: Behaviour) -> None:
        """Record the order's outcome, which the task service receives at the next step."""
        self._outcome = self._steering.heed(behaviour)

    @property
    def hung(self) -> bool:
        """Return whether a plan in the worker thread is so overdue that it will never finish."""
        return self._ready is not None and self._ready.hung

    async def close(self) -> None:
        """Close the task service after its last write, then stop the worker thread."""
        await self._service.close()
        if self._ready:
            self._ready.close()

    async def can_drive(self) -> None:
        """Wait briefly for a pose in the map; raise Refused, with a remedy, if there is none."""
        for _ in range(PATIENCE_NS // LOOK_NS):
            if self._waits or self._steering.placed:
                return
            await self._bus.clock.sleep_ns(LOOK_NS)
        raise Refused(self._steering.lost)

    async def can_reach(self, goal: Goal) -> str:
        """Return in words how the robot would reach `goal`, or what that waits for.

        Raises Refused, with the reason, where the goal cannot be reached.
        """
        await self.can_drive()
        waits = self._waits
        return f"accepted; {waits}" if waits else await self._steering.way_to(goal)

    @property
    def _waits(self) -> str:
        return self._ready.waits if self._ready else GETTING_READY
