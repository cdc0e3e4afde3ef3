"""The body in MuJoCo that an emulator is the electronics of."""

import dataclasses

from msgspec.structs import replace

from gigabrain_drivers.bodies.line.options import LineOptions
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.sim.body import SimBattery
from gigabrain_drivers.sim.options import MujocoOptions, sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import ConfigError


def emulated_body(name: str, run: Run) -> EmulatedBody:
    """Return the robot called `name` in MuJoCo, by the `sim` part of its file.

    Its battery has the voltages that its real link expects. Raises ConfigError.
    """
    robot, _, options, folder = catalog.load_link(name, replace(run, link="sim"))
    if not isinstance(options, MujocoOptions):
        raise ConfigError(
            f"{robot.robot_type} has no MuJoCo model, so it cannot be emulated: "
            "use its own simulation (--link sim), or give it `sim: {driver: mujoco}` and a model"
        )
    run = replace(run, folder=folder)
    body, world = sim_body(robot, options, run), load_world(run.world, run.seed)
    _, _, real, _ = catalog.load_link(name, replace(run, link="emulated"))
    if isinstance(real, LineOptions):
        body = dataclasses.replace(body, battery=_charged(body.battery, real))
    return EmulatedBody(robot, Simulation(body, world, run.seed), run)


def _charged(battery: SimBattery, line: LineOptions) -> SimBattery:
    """Return the battery between the voltages that the line's driver takes for empty and full."""
    empty, full = line.battery_empty, line.battery_full
    if empty is None or full is None:
        return battery
    nominal = (empty + full) / 2
    return dataclasses.replace(
        battery, empty_voltage=empty, nominal_voltage=nominal, full_voltage=full
    )
