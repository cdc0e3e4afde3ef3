"""Simulated bodies in one process, without bus and clock: they drive blindly, or explore a world.

A run takes milliseconds and repeats exactly.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import sim_body
from gigabrain_drivers.sim.driver import STEPS_PER_TICK, MujocoDriver, scan_message, state_message
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Cylinder, Pose, World
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.behaviours.avoid import Avoid, AvoidConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step

BOOT, COMMANDER = 1, "blind"
VERDICT_DELAY_TICKS = 2  # from safety to the gate, like over a network
POST_HEIGHT_M = 0.6
BLANK_SCAN = LaserScan(
    angle_min=0.0, angle_increment=1.0, range_min=0.0, range_max=1.0, ranges=bytes(4)
)

Ranges = NDArray[np.float32]
Sight = Callable[[Ranges], Ranges]  # from true to measured ranges (beams,) [m]
Post = tuple[float, float, float]  # x, y and radius [m]


class _SimulatedBody:
    """A body's description and its simulation. Raises ConfigError for one without a lidar."""

    def __init__(self, body: str, world: World, run: Run, seed: int) -> None:
        robot, driver = make_driver(body, run)
        if not isinstance(driver, MujocoDriver) or robot.lidar is None:
            raise ConfigError(f"{body} has no simulated body with a lidar")
        self.body, self.lidar = robot.description(), robot.lidar
        self.simulation = Simulation(sim_body(robot, driver.options, driver.run), world, seed)
        self.scan_ticks = round(1e9 / robot.lidar.rate_hz / TICK_NS)

    def state(self, tick: int) -> RobotState:
        state = state_message(self.simulation, self.body.robot_type)
        return replace(state, boot=BOOT, tick=tick, basis=tick)

    def scan(self, tick: int, sees: Sight = np.copy) -> LaserScan:
        scan = scan_message(self.lidar, sees(self.simulation.scan()))
        return replace(scan, boot=BOOT, tick=tick, basis=tick)


class SafetyTrack(_SimulatedBody):
    """A body that drives blindly among posts; only safety and the gate stop it."""

    def __init__(
        self, body: str, half_x: float, half_y: float, posts: tuple[Post, ...] = (), seed: int = 0
    ) -> None:
        shapes = tuple(Cylinder(x, y, radius, POST_HEIGHT_M) for x, y, radius in posts)
        room = World(
            name="track", description="", half_x=half_x, half_y=half_y, shapes=shapes,
            start=Pose(0, 0, 0),
        )  # fmt: skip
        super().__init__(body, room, Run(folder=Path()), seed)
        self._config = gate.GateConfig(limits=limits_of(self.body))
        self.gate = gate.GateState(boot=BOOT)
        self.verdict = SafetyState(verdict="stop")
        self.sees: Sight = np.copy
        self._memory, self._scan = SafetyMemory(), BLANK_SCAN
        self._delayed: deque[SafetyState] = deque()
        self._asked = CmdVel(linear_x=0.0, source=COMMANDER)
        self.run(50)
        for event in (gate.Release(0), gate.Enable(COMMANDER)):
            self.gate, outcome = gate.step(self._config, self.gate, event)
            if not outcome.ok:
                raise ConfigError(outcome.text)

    def run(self, ticks: int = 1, linear_x: float = 0.0, angular_z: float = 0.0) -> None:
        """Command these speeds [m/s], [rad/s] for `ticks`."""
        for _ in range(ticks):
            self._tick(CmdVel(linear_x=linear_x, angular_z=angular_z, source=COMMANDER))

    def _tick(self, wish: CmdVel) -> None:
        simulation, now = self.simulation, self.gate.tick
        for part in range(STEPS_PER_TICK):
            simulation.advance()
            if part == 0 and now and now % self.scan_ticks == 0:
                self._scan = self.scan(now, self.sees)
        self._feed(gate.Tick(Velocity(**simulation.velocity()._asdict())))
        self._judge()
        header = {"boot": BOOT, "tick": self.gate.tick, "seq": self.gate.tick}
        self._asked = replace(wish, **header)
        self._feed(gate.VelocityCommand(self._asked))
        output = self.gate.output
        simulation.drive(output.linear_x, output.linear_y, output.angular_z)

    def _judge(self) -> None:
        """Run safety's step, and pass the verdict of two ticks ago to the gate."""
        tick = self.gate.tick
        scan = self._scan if self._scan.basis else None
        inputs = SafetyInputs(
            state=replace(self.state(tick), gate=gate.status(self.gate)),
            scan=scan,
            scan_age_ns=(tick - scan.basis) * TICK_NS if scan else None,
            command=self._asked,
            echo_ages=(0,),
        )
        self._memory, self.verdict = step(self.body, self._memory, inputs)
        self._delayed.append(replace(self.verdict, boot=BOOT, tick=tick))
        if len(self._delayed) > VERDICT_DELAY_TICKS:
            self._feed(gate.Safety(self._delayed.popleft()))

    def _feed(self, event: gate.Event) -> None:
        self.gate, _ = gate.step(self._config, self.gate, event)

    @property
    def output(self) -> Velocity:
        """The gate's present output."""
        return self.gate.output

    @property
    def radius(self) -> float:
        """Largest distance of the outline from the body's origin [m]."""
        return max(math.hypot(x, y) for x, y in self.body.footprint)


class ExploreTick(NamedTuple):
    """Measurements of one tick, and the body's true pose."""

    state: RobotState
    scan: LaserScan | None
    truth: tuple[float, float, float]  # x, y [m], yaw [rad] in the world, at the scan's time


class ExploreRun(_SimulatedBody):
    """A body that explores a world with the behaviour `avoid`."""

    def __init__(self, body: str, world: str, seed: int = 0) -> None:
        run = Run(folder=Path(), world=world, seed=seed)
        super().__init__(body, load_world(world, seed), run, seed)
        self._avoid = Avoid(AvoidConfig(max_linear_speed=self.body.max_linear_speed))

    def ticks(self, count: int) -> Iterator[ExploreTick]:
        """Yield `count` ticks."""
        for tick in range(1, count + 1):
            scan, simulation = None, self.simulation
            truth = simulation.truth.pose()
            for part in range(STEPS_PER_TICK):
                simulation.advance()
                if part == 0 and tick % self.scan_ticks == 0:
                    truth = simulation.truth.pose()
                    scan = self.scan(tick)
            state = self.state(tick)
            if scan:
                self._decide(state, scan)
            yield ExploreTick(state, scan, (truth.x, truth.y, truth.yaw))

    def _decide(self, state: RobotState, scan: LaserScan) -> None:
        world = perception.step(PerceptionConfig(), self.body, scan)
        twist = self._avoid.step(behaviours.Inputs(world=world, pose=state.pose))[0].twist
        if twist:
            self.simulation.drive(twist.linear_x, twist.linear_y, twist.angular_z)
