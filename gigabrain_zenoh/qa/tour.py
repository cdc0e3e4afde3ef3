"""A simulated body that roams a world with the behaviour `avoid`: one process, no bus, no clock.

What it measures comes as the messages of its driver would, beside the truth, for benchmarks.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.driver import STEPS, MujocoDriver
from gigabrain_drivers.sim.options import sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.readings import scan_of, state_of
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.behaviours import Situation
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.perception import node as perception

BOOT = 1


class Moment(NamedTuple):
    """What a robot measures in one tick, and where it really is."""

    state: RobotState
    scan: LaserScan | None
    truth: tuple[
        float, float, float
    ]  # x, y [m] and yaw [rad] in the world, when the scan was taken


class Tour:
    """One body on its way through one world. Raises ConfigError for one without a lidar."""

    def __init__(self, body: str, world: str, seed: int = 0) -> None:
        run = Run(folder=Path(), world=world, seed=seed)
        robot, driver = make_driver(body, run)
        if not isinstance(driver, MujocoDriver) or robot.lidar is None:
            raise ConfigError(f"{body} has no simulated body with a lidar")
        self.body: BodyDescription = robot.description()
        self._lidar = robot.lidar
        self.simulation = Simulation(
            sim_body(robot, driver.options, driver.run), load_world(world, seed), seed
        )
        config = DecisionConfig(linear_speed=self.body.max_linear_speed)
        self._avoid = behaviours.load("avoid")(config)
        self._scan_ticks = round(1e9 / robot.lidar.rate_hz / TICK_NS)

    def moments(self, ticks: int) -> Iterator[Moment]:
        """So many ticks of it."""
        for tick in range(1, ticks + 1):
            scan, simulation = None, self.simulation
            truth = simulation.truth.pose()
            for part in range(STEPS):
                simulation.advance()
                if part == 0 and tick % self._scan_ticks == 0:
                    truth = simulation.truth.pose()
                    seen = scan_of(self._lidar, simulation.scan())
                    scan = replace(seen, boot=BOOT, tick=tick, basis=tick)
            state = state_of(simulation, self.body.robot_type)
            state = replace(state, boot=BOOT, tick=tick, basis=tick)
            if scan:
                self._decide(state, scan)
            yield Moment(state, scan, (truth.x, truth.y, truth.yaw))

    def _decide(self, state: RobotState, scan: LaserScan) -> None:
        world = perception.step(PerceptionConfig(), self.body, scan)
        twist = self._avoid.step(Situation(world, state.pose)).twist
        if twist:
            self.simulation.drive(twist.linear_x, twist.linear_y, twist.angular_z)
