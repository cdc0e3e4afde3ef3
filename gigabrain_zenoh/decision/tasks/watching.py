"""What the robot says, for the conditions of missions; heard only once somebody wants it."""

from typing import Any

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.topics import STATE, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick


class Watched:
    """The newest of each topic, as it was before the present tick."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._heard: dict[str, PreviousTick[Any]] = {}
        self._state: RobotState | None = None

    def see(self, state: RobotState) -> None:
        """The present state, which says what tick it is."""
        self._state = state

    def read(self, topic: Topic[Any]) -> Message | None:
        """The newest of a topic while it counts; nothing at first, for it is to be asked for."""
        state = self._state
        if state is None or topic.key == STATE.key:
            return state
        if topic.key not in self._heard:
            earlier: PreviousTick[Any] = PreviousTick()
            self._heard[topic.key] = earlier
            self._bus.subscribe(topic, lambda _key, message: earlier.receive(message))
        found: Message | None = self._heard[topic.key].at(
            state.boot, state.tick, topic.stale_after_ns
        )
        return found
