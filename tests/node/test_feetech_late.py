"""The emulated servos of an arm in MuJoCo hold it although their loop is late."""

import random
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.driver import FeetechOptions
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.driver.catalog import load_link, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.sim import STEP_S
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.worlds import load_world

RAISED = (0.0, 0.6, -0.6, -0.3, 0.0, 0.3)  # [rad], stretched forwards


class NullWire:
    """A serial line without a reader."""

    def write(self, data: bytes) -> bool:
        return True


@pytest.mark.parametrize("max_delay_steps", [0, 5, 15])
def test_a_raised_arm_is_held_still_by_late_servos(max_delay_steps: int) -> None:
    robot, _, options, folder = load_link("so101", Run(folder=Path()))
    assert isinstance(options, MujocoOptions)
    assert robot.emulated
    simulation = Simulation(sim_body(robot, options, Run(folder=folder)), load_world("arena", 0), 0)
    run = Run(folder=robot_path("so101").parent, link="emulated")
    body = EmulatedBody(robot, simulation, run)
    settings = FeetechOptions(
        driver="feetech", port="none", servos=robot.emulated["servos"], calibration="emulated.yaml"
    )
    arm, rng = FeetechArm(body, settings, NullWire()), random.Random(0)
    arm.reset()
    for servo, goal in zip(arm.servos.values(), RAISED, strict=True):
        servo[feetech.GOAL_VELOCITY], servo[feetech.ACCELERATION] = 2000, 254
        ahead = (goal - servo.angle(servo[feetech.POSITION])) / feetech.RADIANS_PER_TICK
        servo[feetech.GOAL] = servo[feetech.POSITION] + round(ahead)
    due, places = 0, []
    for step in range(600):
        body._step()
        if step >= due:
            arm.step(round(step * STEP_S * 1e9))
            due = step + 1 + rng.randint(0, max_delay_steps)
        places.append([motor.position for motor in body.joints])
    assert places[-1] == pytest.approx(RAISED, abs=0.07)  # they sag: no integral gain
    assert np.ptp(places[300:], axis=0).max() < 0.01
