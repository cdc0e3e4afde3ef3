"""What decision serves when its robot is sent to places.

Goals are taken from the start; what it takes to drive there is got ready meanwhile.
"""

import asyncio
from typing import TYPE_CHECKING

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.behaviours import Behaviour, Situation
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.compiling import compiled
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.settings import DecisionConfig
from gigabrain_zenoh.tasks.mission import roaming
from gigabrain_zenoh.tasks.orders import Outcome
from gigabrain_zenoh.tasks.service import TaskService

if TYPE_CHECKING:
    from gigabrain_zenoh.steering import Steering

DRIVE_KERNELS = "gigabrain_zenoh.steering:warm_up"  # calls all that is compiled for it once
GETTING_READY = "it is getting ready"
TOLD_NS = 200_000_000  # from one word about that to the next
PATIENCE_NS, LOOK_NS = 700_000_000, 50_000_000  # for the first word of the place, when asked


class Navigating:
    """The senses of the behaviour `navigate`: its orders, and by what it carries them out."""

    def __init__(self, config: DecisionConfig, bus: Bus) -> None:
        self._bus, self._config = bus, config
        self._service = TaskService(bus, self, folder=config.state_dir, scripts=config.scripts)
        self._ready: Steering | None = None
        self._outcome: Outcome | None = None
        self._begun = False

    async def warm_up(self) -> None:
        """Import and compile all that a driving robot calls. Raises ConfigError."""
        telling = asyncio.ensure_future(self._tell())
        try:
            await compiled(DRIVE_KERNELS)
        finally:
            telling.cancel()
        from gigabrain_zenoh.steering import Steering  # and numba: only who drives by it pays

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
        """Take note of each state."""
        self._steering.see(state)

    def situation(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> Situation:
        """Where the robot is, what it is to do, and which way."""
        if self._config.begin == "roam" and not self._begun:
            self._service.begin(roaming(), "roaming", state.boot)
        self._begun = True
        tick = world.basis if world else state.tick
        order = self._service.step(state, self._outcome, tick)
        self._outcome = None
        waits = "" if order else self._service.waits
        return self._steering.situation(state, world, verdict, order, waits)

    def heed(self, behaviour: Behaviour) -> None:
        """What became of the order goes to the tasks."""
        self._outcome = self._steering.heed(behaviour)

    @property
    def hung(self) -> bool:
        """Whether a part of it never ends, while the rest goes on."""
        return self._ready is not None and self._ready.hung

    async def close(self) -> None:
        """Once all is written down."""
        await self._service.close()
        if self._ready:
            self._ready.close()

    async def can_drive(self) -> None:
        """Raises Refused where nobody says where the robot is, with what to change."""
        for _ in range(PATIENCE_NS // LOOK_NS):
            if self._waits or self._steering.placed:
                return
            await self._bus.clock.sleep_ns(LOOK_NS)
        raise Refused(self._steering.lost)

    async def can_reach(self, goal: Goal) -> str:
        """How it would get there, or what that waits for, in words. Raises Refused, and why."""
        await self.can_drive()
        waits = self._waits
        return f"accepted; {waits}" if waits else await self._steering.way_to(goal)

    @property
    def _waits(self) -> str:
        return self._ready.waits if self._ready else GETTING_READY
