"""A simulated body that somebody drives blindly, held back by safety and the gate alone.

One process and no bus, so that a run costs milliseconds and repeats exactly. What safety says
reaches the gate late, as it does over a network.
"""

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.driver import STEPS, MujocoDriver
from gigabrain_drivers.sim.geometry import Cylinder, Pose
from gigabrain_drivers.sim.options import sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.readings import scan_of, state_of
from gigabrain_drivers.sim.world import World
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.safety.step import Inputs, Memory, step

BOOT, COMMANDER = 1, "blind"
LATE_TICKS = 2  # from a verdict's making to the gate
HEIGHT = 0.6  # [m], of posts

Ranges = NDArray[np.float32]
Sight = Callable[[Ranges], Ranges]  # what the lidar makes of true ranges (beams,) [m]
Post = tuple[float, float, float]  # x, y and radius [m]


def room(half_x: float, half_y: float, posts: tuple[Post, ...] = ()) -> World:
    """A walled rectangle with upright posts; the body starts in its middle."""
    shapes = tuple(Cylinder(x, y, radius, HEIGHT) for x, y, radius in posts)
    name = "track"
    return World(
        name=name, description="", half_x=half_x, half_y=half_y, shapes=shapes, start=Pose(0, 0, 0)
    )


class Track:
    """One body in one room. Raises ConfigError for a body that is not simulated."""

    def __init__(
        self, body: str, half_x: float, half_y: float, posts: tuple[Post, ...] = (), seed: int = 0
    ) -> None:
        run = Run(folder=Path())
        robot, driver = make_driver(body, run)
        if not isinstance(driver, MujocoDriver) or robot.lidar is None:
            raise ConfigError(f"{body} has no simulated body with a lidar")
        self.body, self.lidar = robot.description(), robot.lidar
        model = sim_body(robot, driver.options, driver.run)
        self.simulation = Simulation(model, room(half_x, half_y, posts), seed)
        self._config = gate.GateConfig(limits=limits_of(robot))
        self.gate = gate.GateState(boot=BOOT)
        self.said = SafetyState(verdict="stop")
        self.sees: Sight = np.copy
        self._memory, self._scan = (
            Memory(),
            LaserScan(
                angle_min=0.0, angle_increment=1.0, range_min=0.0, range_max=1.0, ranges=bytes(4)
            ),
        )
        self._late: deque[SafetyState] = deque()
        self._asked = CmdVel(linear_x=0.0, source=COMMANDER)
        self._scan_ticks = round(1e9 / robot.lidar.rate_hz / TICK_NS)
        self.open()

    def open(self) -> None:
        """Let somebody in who does not look where he drives."""
        self.go(50)
        for event in (gate.Release(0), gate.Enable(COMMANDER)):
            self.gate, outcome = gate.step(self._config, self.gate, event)
            if not outcome.ok:
                raise ConfigError(outcome.text)

    def go(self, ticks: int = 1, linear_x: float = 0.0, angular_z: float = 0.0) -> None:
        """So many ticks with these wishes [m/s], [rad/s]."""
        for _ in range(ticks):
            self._tick(CmdVel(linear_x=linear_x, angular_z=angular_z, source=COMMANDER))

    def _tick(self, wish: CmdVel) -> None:
        simulation, now = self.simulation, self.gate.tick
        for part in range(STEPS):
            simulation.advance()
            if part == 0 and now and now % self._scan_ticks == 0:
                seen = self.sees(simulation.scan())
                self._scan = replace(scan_of(self.lidar, seen), boot=BOOT, tick=now, basis=now)
        self._feed(gate.Tick(Velocity(**simulation.velocity()._asdict())))
        self._judge()
        header = {"boot": BOOT, "tick": self.gate.tick, "seq": self.gate.tick}
        self._asked = replace(wish, **header)
        self._feed(gate.Command(self._asked))
        to = self.gate.output
        simulation.drive(to.linear_x, to.linear_y, to.angular_z)

    def _judge(self) -> None:
        """Safety looks, and what it said a while ago reaches the gate."""
        tick = self.gate.tick
        state = replace(
            state_of(self.simulation, self.body.robot_type),
            boot=BOOT, tick=tick, basis=tick, gate=gate.status(self.gate),
        )  # fmt: skip
        seen = self._scan if self._scan.basis else None
        inputs = Inputs(
            state=state,
            scan=seen,
            scan_age_ns=(tick - seen.basis) * TICK_NS if seen else None,
            command=self._asked,
            echo_ages=(0,),
        )
        self._memory, self.said = step(self.body, self._memory, inputs)
        self._late.append(replace(self.said, boot=BOOT, tick=tick))
        if len(self._late) > LATE_TICKS:
            self._feed(gate.Safety(self._late.popleft()))

    def _feed(self, event: gate.Event) -> None:
        self.gate, _ = gate.step(self._config, self.gate, event)

    @property
    def told(self) -> Velocity:
        """What the gate lets through now."""
        return self.gate.output

    @property
    def radius(self) -> float:
        """How far the outline reaches from the body's origin [m]."""
        return max(math.hypot(x, y) for x, y in self.body.footprint)
