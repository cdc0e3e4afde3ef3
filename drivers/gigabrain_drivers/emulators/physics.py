"""The body in MuJoCo that an emulator is the electronics of."""

from msgspec.structs import replace

from gigabrain_drivers import catalog
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.robot import Run
from gigabrain_drivers.sim.options import MujocoOptions, sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import ConfigError


def emulated_body(name: str, run: Run) -> EmulatedBody:
    """The robot called `name`, by the `sim` part of its file. Raises ConfigError."""
    robot, _, options, folder = catalog.load_link(name, replace(run, link="sim"))
    if not isinstance(options, MujocoOptions):
        raise ConfigError(f"{robot.robot_type} has no MuJoCo model, so it cannot be emulated")
    run = replace(run, folder=folder)
    world = load_world(run.world, run.seed)
    return EmulatedBody(robot, Simulation(sim_body(robot, options, run), world, run.seed), run)
