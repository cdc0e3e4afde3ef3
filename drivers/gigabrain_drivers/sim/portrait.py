"""A picture of a robot by its name."""

from pathlib import Path

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.options import sim_body
from gigabrain_drivers.sim.picture import render
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import Unsupported


def portray(body: str, world: str, seed: int, png: Path) -> None:
    """Draw a robot in its world. Raises ConfigError, and Unsupported without a MuJoCo model."""
    robot, driver = make_driver(body, Run(folder=Path(), world=world, seed=seed))
    if not isinstance(driver, MujocoDriver):
        raise Unsupported(f"{body} has no MuJoCo model to draw")
    render(sim_body(robot, driver.options, driver.run), load_world(world, seed), seed, png)
