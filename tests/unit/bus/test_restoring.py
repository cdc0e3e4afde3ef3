"""A message that receivers keep is published again once another sender has replaced it."""

import pytest

from gigabrain_schemas.body import ArmModel
from gigabrain_schemas.topics import ARM_MODEL
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.restoring import RestoringPublisher
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock

OWN = ArmModel(mjcf="its own")


@pytest.mark.parametrize(
    ("other", "again"),
    [
        (ArmModel(mjcf="<"), 1),
        (ArmModel(mjcf="its own", boot=9), 1),  # receivers ignore a model of another boot
        (ArmModel(mjcf="its own", tick=9), 0),
    ],
)
async def test_a_foreign_message_is_replaced_once(other: ArmModel, again: int) -> None:
    network, clock, told = LocalNetwork(), FakeClock(), list[str]()
    restoring = RestoringPublisher(Bus(network.transport(), clock, "driver"))
    restoring.publish(ARM_MODEL, OWN)
    await clock.advance(1)
    Bus(network.transport(), clock).subscribe(ARM_MODEL, lambda _, one: told.append(one.mjcf))
    stranger = network.transport()
    stranger.publish(ARM_MODEL, ARM_MODEL.key, codec.encode(other), codec.encoding_of(ArmModel))
    for _ in range(3):
        await clock.advance(1)
        restoring.restore()
    await clock.advance(1)
    assert told == [other.mjcf, *[OWN.mjcf] * again]
