"""Tests the positions that `gigabrain arm` sends and shows."""

import math
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import BodyDescription, Joint, RobotState
from gigabrain_schemas.examples import example
from gigabrain_zenoh.cli.arm import jog, lines
from gigabrain_zenoh.errors import BodyLost

ARM = load_robot("so101").description()
TURNED = tuple(Joint(name=joint.name, position=math.radians(40)) for joint in ARM.joints)
STATE = replace(
    example(RobotState), joints=TURNED, joints_sent=(math.radians(10),) * len(ARM.joints)
)


class Arm:
    """A robot that records where it is sent."""

    def __init__(self, state: RobotState) -> None:
        self.state, self.sent = state, dict[str, float]()

    @asynccontextmanager
    async def robot(self, _source: str) -> AsyncIterator["Arm"]:
        yield self

    async def read_body(self) -> BodyDescription:
        return ARM

    async def read_state(self) -> RobotState:
        return self.state

    async def set_joint_positions(
        self, positions: Mapping[str, float], **_: float
    ) -> Mapping[str, float]:
        self.sent = {name: math.degrees(place) for name, place in positions.items()}
        return positions


@pytest.mark.parametrize(
    ("state", "place"),
    [(STATE, 15.0), (replace(STATE, limp=True), 45.0), (replace(STATE, joints_sent=()), 45.0)],
    ids=["held", "limp and moved by hand", "never sent anywhere"],
)
def test_a_joint_is_jogged_from_where_it_is_held_or_is(state: RobotState, place: float) -> None:
    arm: Any = Arm(state)
    jog("shoulder_pan", 5.0, at=arm)
    assert arm.sent == {"shoulder_pan": pytest.approx(place)}


def test_a_joint_that_is_not_measured_is_not_jogged() -> None:
    arm: Any = Arm(replace(STATE, joints=(), joints_sent=()))
    with pytest.raises(BodyLost, match="not all of its joints are measured; see `arm state`"):
        jog("shoulder_pan", 5.0, at=arm)


def test_limp_joints_are_shown_without_where_they_were_sent_before() -> None:
    assert "+10.0°" in lines(ARM, STATE)[2]
    assert "+10.0°" not in lines(ARM, replace(STATE, limp=True))[2]
