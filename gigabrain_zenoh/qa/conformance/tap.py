"""A driver that is listened to: what it is told, what it returns, and when its bytes leave."""

from collections.abc import AsyncIterator, Mapping
from typing import Any, NamedTuple

from gigabrain_drivers.driver.base import Driver
from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import Joint, RobotState
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.clock import Clock


class Call(NamedTuple):
    """One command, as the gate let it through and as the driver sent it."""

    asked: Velocity
    sent: Velocity


class Tap(Driver):
    """Between the driver's process and `inner`, which it does not change."""

    def __init__(self, inner: Driver) -> None:
        super().__init__(inner.robot, inner.options, inner.run)
        self.inner, self.lockstep = inner, inner.lockstep
        self.calls: list[Call] = []
        self.speaking = False  # whether a command is on its way through the driver now
        inner.emit = self._hand_on

    async def open(self) -> None:
        """Of the inner one, as all that follows."""
        await self.inner.open()

    async def close(self) -> None:
        """Let go of the body."""
        await self.inner.close()

    async def stop(self) -> None:
        """Bring the body to rest."""
        await self.inner.stop()

    async def hold(self) -> None:
        """Keep the present position."""
        await self.inner.hold()

    async def park(self) -> None:
        """Take up the inner one's posture for being left alone."""
        await self.inner.park()

    async def limp(self) -> None:
        """Let go of the inner one's joints."""
        await self.inner.limp()

    async def read_state(self) -> RobotState:
        """What the body measures."""
        return await self.inner.read_state()

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """The inner one's."""
        async for passed in self.inner.ticks(clock):
            yield passed

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive, and remember it."""
        self.speaking = True
        try:
            sent = await self.inner.set_base_velocity(linear_x, linear_y, angular_z)
        finally:
            self.speaking = False
        asked = Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z)
        self.calls.append(Call(asked, sent))
        return sent

    async def set_joint_position(self, joint_name: str, position: float) -> float:
        """Move one joint."""
        return await self.inner.set_joint_position(joint_name, position)

    async def get_joint_states(self) -> tuple[Joint, ...]:
        """All joints as measured."""
        return await self.inner.get_joint_states()

    async def get_sensor_data(self, sensor_name: str) -> Message | None:
        """The newest reading of a sensor."""
        return await self.inner.get_sensor_data(sensor_name)

    def report(self) -> Mapping[str, float | int | str | None]:
        """The inner one's figures."""
        return self.inner.report()

    def _hand_on(self, topic: Topic[Any], message: Message) -> None:
        self.emit(topic, message)
