"""A body in memory, in the middle of an empty room, for tests and benchmarks."""

import math
from collections.abc import AsyncIterator

import numpy as np

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.lidars.base import ScanSource, open_lidar
from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import TICK_NS, TICK_S, Pose, Velocity
from gigabrain_schemas.body import Battery, RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.geometry.limits import ZERO

ROOM_RADIUS_M = 3.0


class MockOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The mock's part of a robot's file."""

    gain: float = 1.0  # true speed / commanded speed


class MockBody(Driver):
    """Moves at the commanded speed at once. The room moves with it."""

    Options = MockOptions

    def __init__(self, robot: RobotFile, options: MockOptions, run: Run) -> None:
        super().__init__(robot, options, run)
        self.lockstep = run.speed != 1.0
        self._gain = options.gain
        self._open = False
        self._velocity = ZERO
        self._pose = Pose(x=0.0, y=0.0, yaw=0.0)
        self._noise = np.random.default_rng(run.seed)
        self._ticks = self._next_scan_tick = 0
        self.sensors = {"scan": None}
        self._lidar: ScanSource | None = None  # the real lidar, if the link names one

    async def open(self) -> None:
        """Connect to the real lidar, if any; otherwise make the first simulated scan."""
        self._open = True
        self._lidar = open_lidar(self, Clock())
        if self._lidar is None:
            self.sensors["scan"] = self._scan()

    async def close(self) -> None:
        """Stop, and close the real lidar, if any."""
        self._open, self._velocity = False, ZERO
        lidar, self._lidar = self._lidar, None
        if lidar:
            await lidar.close()

    async def stop(self) -> None:
        """Come to rest at once."""
        self._velocity = ZERO

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """Tick by the host's clock, or in lock-step as fast as the brain answers."""
        if self.lockstep:
            while True:
                self._publish_scan()
                self._advance()
                yield 1
        async for passed in super().ticks(clock):
            for _ in range(passed):
                self._advance()
            yield passed
            await clock.sleep_ns(TICK_NS // 2)  # scans are published between the body's states
            self._publish_scan()

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Set the velocity at once; return the commanded velocity, without `gain`."""
        if not self._open:
            raise BodyLost("the mock is not open")
        target = self.bounded(linear_x, linear_y, angular_z)
        self._velocity = Velocity(
            linear_x=target.linear_x * self._gain,
            linear_y=target.linear_y * self._gain,
            angular_z=target.angular_z * self._gain,
        )
        return target

    async def read_state(self) -> RobotState:
        """Return the state with the integrated pose."""
        if not self._open:
            raise BodyLost("the mock is not open")
        return RobotState(
            robot_type=self.robot.robot_type,
            pose=self._pose,
            velocity=self._velocity,
            battery=Battery(voltage=12.0, percentage=100.0),
        )

    def _advance(self) -> None:
        v, pose = self._velocity, self._pose
        yaw = pose.yaw + v.angular_z * TICK_S / 2
        self._pose = Pose(
            x=pose.x + (v.linear_x * math.cos(yaw) - v.linear_y * math.sin(yaw)) * TICK_S,
            y=pose.y + (v.linear_x * math.sin(yaw) + v.linear_y * math.cos(yaw)) * TICK_S,
            yaw=math.remainder(pose.yaw + v.angular_z * TICK_S, 2 * math.pi),
        )
        self._ticks += 1

    def _publish_scan(self) -> None:
        """Publish a scan if a turn of the simulated lidar ends."""
        lidar = None if self._lidar else self.robot.lidar
        if lidar and self._ticks >= self._next_scan_tick:
            period_ticks = max(1, round(1 / (lidar.rate_hz * TICK_S)))
            self._next_scan_tick = (self._ticks // period_ticks + 1) * period_ticks
            if scan := self._scan():
                self.publish("scan", SCAN, scan)

    def _scan(self) -> LaserScan | None:
        """Return a scan of a round room, with 1 cm of noise; None without a lidar."""
        lidar = self.robot.lidar
        if lidar is None:
            return None
        ranges = ROOM_RADIUS_M + self._noise.normal(0.0, 0.01, lidar.beams)
        return LaserScan(
            angle_min=0.0,
            angle_increment=2 * math.pi / lidar.beams,
            range_min=lidar.range_min,
            range_max=lidar.range_max,
            ranges=ranges_bytes(ranges),
        )
