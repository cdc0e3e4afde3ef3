"""Clipping of a faulty body's state to the bounds of its message."""

import math

from msgspec.structs import replace

from gigabrain_drivers.driver.clipping import clipped
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Battery, Joint, RobotState
from gigabrain_schemas.sensors import ImuData
from gigabrain_zenoh.codec import Codec, encode
from gigabrain_zenoh.testing.samples import state

SOUND = replace(
    state(7),
    velocity=Velocity(linear_x=0.2, angular_z=-1.0),
    joints=(Joint(name="wheel_left", position=3.0),),
    battery=Battery(voltage=12.0, percentage=80.0),
)


def test_a_sound_state_is_left_as_it_is() -> None:
    assert clipped(SOUND) is SOUND


def test_a_faulty_state_can_be_carried_and_still_shows_the_fault() -> None:
    imu = ImuData(
        orientation=(0.0, 0.0, 0.0, 1.0),
        angular_velocity=(0.0, 1e30, 0.0),
        linear_acceleration=(0.0, 0.0, 9.81),
    )
    faulty = replace(
        SOUND,
        velocity=Velocity(linear_x=1e6, angular_z=-math.inf),
        joints=(Joint(name="wheel_left", position=3.0, velocity=-2e9, temperature=5e3),),
        battery=Battery(voltage=-1.0, percentage=250.0),
        imu=imu,
    )
    told = clipped(faulty)
    assert told.velocity == Velocity(linear_x=100.0, angular_z=-100.0)
    assert told.joints == (
        Joint(name="wheel_left", position=3.0, velocity=-10_000.0, temperature=1000.0),
    )
    assert told.battery == Battery(voltage=0.0, percentage=100.0)
    assert Codec(RobotState, 10_000).decode(encode(told)) == told
