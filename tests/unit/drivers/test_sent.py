"""A driver sends its body the gate's output, rounded to the units of the body's protocol."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.line.conversion import LineCommand
from gigabrain_drivers.bodies.line.protocol import COMMAND, Template
from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.kinematics.legs import WALKER
from gigabrain_drivers.kinematics.wheels import Twist, wheels_of
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.qa.faults.rows.commands import commanded_over, let_through, over
from gigabrain_zenoh.qa.judging import Failed
from gigabrain_zenoh.testing.samples import DRIVING, state

BODIES = ["alpha", "mock", "mycustombot", "turtlebot3_burger", "turtlebot3_waffle"]
COMMANDS = 5_000
ROUNDING = 1e-9
BURGER = catalog.load_robot("turtlebot3_burger")


def gate_outputs(body: str) -> Iterator[Velocity]:
    """Return the gate's outputs for hostile commands, one a tick."""
    return (now for _, now in let_through(catalog.load_robot(body), COMMANDS))


def axes(of: Velocity) -> tuple[float, float, float]:
    return of.linear_x, of.linear_y, of.angular_z


def driver_of(body: str) -> Driver:
    return catalog.make_driver(body, Run(folder=Path()))[1]


@pytest.mark.long
@pytest.mark.parametrize("body", BODIES)
def test_a_driver_does_not_reduce_the_gates_output(body: str) -> None:
    driver = driver_of(body)
    for now in gate_outputs(body):
        assert axes(driver.bounded(*axes(now))) == pytest.approx(axes(now), abs=ROUNDING)


@pytest.mark.long
@pytest.mark.parametrize("body", BODIES)
def test_the_gates_output_keeps_linear_and_angular_acceleration_limits(body: str) -> None:
    robot = catalog.load_robot(body)
    worst = max(over(robot, before, now, 1) for before, now in let_through(robot, COMMANDS))
    assert worst < 1e-6


@pytest.mark.long
async def test_a_simulated_base_is_sent_the_gates_output_unchanged() -> None:
    for body in ("turtlebot3_burger", "mycustombot", "alpha"):
        async with driver_of(body) as driver:
            for now in gate_outputs(body):
                sent = await driver.set_base_velocity(*axes(now))
                assert axes(sent) == pytest.approx(axes(now), abs=ROUNDING)


@pytest.mark.parametrize("body", ["turtlebot3_burger", "turtlebot3_waffle"])
def test_an_opencr_is_sent_the_gates_output_rounded_to_its_unit(body: str) -> None:
    base = wheels_of(catalog.load_robot(body))
    assert base
    for now in gate_outputs(body):
        wheels = base.to_wheels(Twist(*axes(now)))
        assert max(map(abs, wheels)) <= opencr.MAX_WHEEL_SPEED  # or its driver would slow it down
        sent = opencr.velocity(now.linear_x, now.angular_z)
        assert (sent.linear_x, sent.angular_z) == pytest.approx(
            (now.linear_x, now.angular_z), abs=0.005 + ROUNDING
        )


def test_a_line_base_is_sent_the_gates_output_rounded_to_its_last_digit() -> None:
    command = LineCommand(Template("V,{linear_x:.3f},{angular_z:.3f}\n", COMMAND), None)
    for now in gate_outputs("mycustombot"):
        assert axes(command.sent(now)) == pytest.approx(axes(now), abs=0.0005 + ROUNDING)


def test_a_quadruped_can_walk_at_every_velocity_of_the_gate() -> None:
    for now in gate_outputs("alpha"):
        assert WALKER.to_body(WALKER.to_gait(Twist(*axes(now)))) == pytest.approx(axes(now))


def states_with(*sent: Velocity) -> list[RobotState]:
    """Return a robot's states of successive ticks, each with a velocity sent to its body."""
    return [
        replace(state(tick), gate=DRIVING, sent=velocity)
        for tick, velocity in enumerate(sent, start=1)
    ]


def test_the_fault_suite_judges_changes_of_the_sent_velocity_in_turns_too() -> None:
    turning = Velocity(angular_z=2.6)
    within = Velocity(linear_x=0.02, angular_z=2.54)
    beyond = Velocity(linear_x=0.018, angular_z=2.366)  # what a clamp in the driver made of it
    fast = Velocity(linear_x=0.2)
    gap = replace(states_with(fast)[0], tick=90)
    assert commanded_over(BURGER, [*states_with(turning, within), gap]) == pytest.approx(
        0.0, abs=1e-6
    )
    assert commanded_over(BURGER, [*states_with(turning, beyond), gap]) == pytest.approx(290.0)
    shut = replace(states_with(beyond)[0], tick=2, gate=replace(DRIVING, mode="stopping"))
    assert commanded_over(BURGER, [*states_with(turning), shut, gap, replace(gap, tick=91)]) == 0.0


def test_the_fault_suite_refuses_to_judge_a_run_without_turns() -> None:
    with pytest.raises(Failed, match=r"0.20 m/s and 0.00 rad/s at most"):
        commanded_over(BURGER, states_with(Velocity(linear_x=0.2), Velocity(linear_x=0.2)))
