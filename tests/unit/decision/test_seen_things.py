"""Matching of a mission's things with those that cameras see, and postures to look from."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.objects import SeenSolid, Solids
from gigabrain_zenoh.decision.seen_things import LOOK_TICKS, Lookout, PutDown, SeenThings, located
from gigabrain_zenoh.decision.tasks.arm_steps import Solid
from gigabrain_zenoh.testing.samples import BOOT, state

ARM = load_robot("so101").description()
CAN = SeenSolid(id=1, shape="cylinder", size=(0.033, 0.115), position=(0.3, 0, 0.057), label="can")
CUBE = SeenSolid(id=2, shape="box", size=(0.031, 0.03, 0.029), position=(0.2, 0.1, 0.015), yaw=0.3)
BALL = SeenSolid(id=3, shape="sphere", size=(0.02,), position=(0.4, 0.0, 0.02))


def test_a_thing_with_a_class_is_the_nearest_one_seen() -> None:
    known, _ = located({"it": Solid(label="can")}, (CUBE, CAN))
    assert known["it"] == Solid(cylinder=(0.033, 0.115), at=(0.3, 0, 0.057))
    assert known["seen 2"] == Solid(box=CUBE.size, at=CUBE.position, yaw=0.3)  # type: ignore[arg-type]


def test_a_thing_with_a_size_keeps_it_and_gets_the_seen_place() -> None:
    cube = Solid(box=(0.03, 0.03, 0.03))
    known, _ = located({"cube": cube}, (CUBE, CAN, BALL))
    assert known["cube"] == Solid(box=(0.03, 0.03, 0.03), at=(0.2, 0.1, 0.015), yaw=0.3)
    assert known.keys() == {"cube", "seen 1", "seen 3"}
    assert known["seen 3"] == Solid(sphere=0.02, at=BALL.position)


def test_heights_are_in_the_frame_of_an_arm_that_stands_on_something() -> None:
    given = Solid(sphere=0.02, at=(0.0, 0.3, 0.1))
    things = {"cube": Solid(box=(0.03, 0.03, 0.03)), "it": Solid(label="can"), "ball": given}
    known, _ = located(things, (CUBE, CAN, BALL), floor=-0.2)
    heights = {name: one.at[2] for name, one in known.items() if one.at}
    expected = {"cube": -0.185, "it": -0.143, "ball": 0.1, "seen 3": -0.18}
    assert heights == pytest.approx(expected)


def test_a_long_box_is_turned_to_match_its_longer_side() -> None:
    seen = SeenSolid(id=4, shape="box", size=(0.03, 0.061, 0.03), position=(0.2, 0, 0.015), yaw=0.1)
    known, _ = located({"bar": Solid(box=(0.06, 0.03, 0.03))}, (seen,))
    assert known["bar"].yaw == pytest.approx(0.1 + math.pi / 2)


@pytest.mark.parametrize(
    "wanted",
    [
        Solid(label="ball"),
        Solid(box=(0.06, 0.06, 0.06)),
        Solid(cylinder=(0.01, 0.1)),
        Solid(sphere=0.1),
    ],
)
def test_a_thing_that_is_not_seen_has_no_place(wanted: Solid) -> None:
    assert "it" not in located({"it": wanted}, (CUBE, CAN))[0]


def test_two_equal_things_match_two_seen_ones() -> None:
    other = SeenSolid(id=5, shape="box", size=(0.03, 0.03, 0.03), position=(0.25, 0, 0.015))
    cube = Solid(box=(0.03, 0.03, 0.03))
    known, _ = located({"one": cube, "other": cube}, (CUBE, other))
    assert known["one"].at == CUBE.position
    assert known["other"].at == other.position


def test_a_seen_thing_at_the_place_of_a_given_one_is_the_same() -> None:
    given = Solid(box=(0.03, 0.03, 0.03), at=(0.21, 0.1, 0.015))
    assert located({"cube": given}, (CUBE,)) == ({"cube": given}, {})


def test_a_thing_seen_far_away_is_not_an_obstacle() -> None:
    far = SeenSolid(id=6, shape="sphere", size=(0.1,), position=(3.0, 0.0, 0.1))
    assert located({}, (far,)) == ({}, {})


def test_a_held_thing_is_no_longer_where_it_was_seen() -> None:
    _, numbers = located({"it": Solid(label="can")}, (CUBE, CAN))
    assert numbers == {"it": CAN.id}
    known, _ = located({}, (CUBE, CAN), held=numbers["it"])
    assert known.keys() == {"seen 2"}


class SeenBus:
    """A bus that publishes seen things."""

    def __init__(self) -> None:
        self.subscribed: Callable[[Solids], None] | None = None
        self.bus: Any = SimpleNamespace(latest=self._latest)

    def _latest(self, _topic: object, on_new: Callable[[Solids], None]) -> None:
        self.subscribed = on_new


def watching(body: BodyDescription) -> tuple[SeenBus, SeenThings]:
    received = SeenBus()
    seen = SeenThings(received.bus)
    seen.observe(body, state(1))
    return received, seen


def test_seen_things_are_moved_to_the_current_frame_of_the_body() -> None:
    received, seen = watching(load_robot("lekiwi").description())
    assert received.subscribed
    received.subscribed(Solids(solids=(CAN,), boot=BOOT, tick=1, basis=1))
    assert seen.at(state(1)) == ()  # received after that state
    there = state(2, pose=(0.1, 0.0, math.pi / 2))
    seen.observe(None, there)
    (one,) = seen.at(there)
    assert one.position == pytest.approx((0.0, -0.2, 0.057))
    assert one.yaw == pytest.approx(-math.pi / 2)
    assert one.age == pytest.approx(CAN.age + 0.02)


PUT = PutDown(name="can", solid=Solid(cylinder=(0.033, 0.12), at=(0.3, 0.0, 0.06)), state=state(2))
TURNED = state(3, pose=(0.1, 0.0, math.pi / 2))


@pytest.mark.parametrize(
    ("now", "seen", "place"),
    [
        (state(2), (), (0.3, 0.0, 0.06)),
        (TURNED, (CUBE,), (0.0, -0.2, 0.06)),
        (state(2), (CUBE,), (0.3, 0.0, 0.06)),
        (state(2), (CAN,), None),  # it is seen there
        (state(1000), (), None),  # it may be gone
        (state(3, pose=(1.5, 0.0, 0.0)), (), None),  # the body drove off
        (replace(state(3), boot=BOOT + 1), (), None),
        (state(1), (), None),  # the driver restarted
    ],
)
def test_a_thing_put_down_is_an_obstacle_until_it_is_seen_or_left(
    now: RobotState, seen: tuple[SeenSolid, ...], place: tuple[float, float, float] | None
) -> None:
    found = PUT.at(now, seen)
    assert (found and found.at) == (place and pytest.approx(place))


def test_things_seen_in_another_start_of_the_driver_are_ignored() -> None:
    received, seen = watching(ARM)
    assert received.subscribed
    received.subscribed(Solids(solids=(CAN,), boot=BOOT + 1, tick=1, basis=1))
    assert seen.at(state(2)) == ()


def test_seen_things_are_not_subscribed_without_a_camera() -> None:
    received, seen = watching(load_robot("piper").description())
    assert received.subscribed is None
    assert seen.at(state(2)) == ()


def test_the_arm_waits_then_goes_home_then_to_both_sides_and_then_gives_up() -> None:
    lookout, tick, pans = Lookout(), 10, list[float]()
    while True:
        assert lookout.waits(tick)
        assert lookout.waits(tick + LOOK_TICKS - 1)
        assert not lookout.waits(tick + LOOK_TICKS)
        posture = lookout.aside(ARM)
        if posture is None:
            break
        assert "gripper" not in posture
        pans.append(posture["shoulder_pan"])
        tick += 500
    assert pans == pytest.approx([0.0, -1.344, 1.344], abs=1e-3)
    lookout.reset()
    assert lookout.aside(ARM)
