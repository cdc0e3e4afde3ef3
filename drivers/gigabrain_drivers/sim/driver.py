"""A body in MuJoCo. Physics and sensors run in their own thread, which posts to the loop."""

import asyncio
import contextlib
import math
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.sim import STEP_NS, STEP_S, Pace
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.checkpoint import PERIOD_NS, Checkpoint, checkpoint_files
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import TICK_NS, Message, Pose, Velocity
from gigabrain_schemas.body import Battery, Joint, Lidar, RobotState
from gigabrain_schemas.sensors import Imu, ImuData, LaserScan
from gigabrain_schemas.sim import SimReply, SimRequest
from gigabrain_schemas.topics import IMU, SCAN, Topic
from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused

if TYPE_CHECKING:
    from gigabrain_drivers.sim.physics import Simulation

T = TypeVar("T")
STEPS_PER_TICK = TICK_NS // STEP_NS  # physics steps per tick of the robot's clock
COMMAND_TIMEOUT_NS = 150_000_000  # simulated time after which the body stops, like a firmware
CHECKPOINT_TICKS = PERIOD_NS // TICK_NS
SPEED_RANGE = (0.1, 100.0)


def state_message(simulation: "Simulation", robot_type: str) -> RobotState:
    """Return the body's state as measured by its sensors."""
    arm = simulation.arm
    odometry, charge, imu = simulation.odometry(), simulation.battery(), simulation.imu()
    return RobotState(
        robot_type=robot_type,
        pose=Pose(x=odometry.x, y=odometry.y, yaw=math.remainder(odometry.yaw, math.tau)),
        velocity=Velocity(**simulation.velocity()._asdict()),
        joints=tuple(Joint(**motor._asdict()) for motor in simulation.motors()),
        battery=Battery(**charge._asdict()),
        imu=ImuData(**imu._asdict()),
        bumpers=(simulation.bumper(),),
        joints_sent=arm.targets if arm and not arm.limp else (),
        limp=bool(arm and arm.limp),
    )


def scan_message(lidar: Lidar, ranges: NDArray[np.float32]) -> LaserScan:
    """Return one turn of `lidar` with these `ranges` (beams,) [m]."""
    return LaserScan(
        angle_min=0.0,
        angle_increment=math.tau / lidar.beams,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        ranges=ranges_bytes(ranges),
    )


class Reading(NamedTuple):
    """The results of one step of 10 ms, passed from the physics thread to the loop."""

    imu: Imu
    scan: LaserScan | None = None  # after a turn of the lidar, between two states
    state: RobotState | None = None  # at the last step of a tick
    news: Sequence[tuple[Topic[Any], Message]] = ()  # messages on the world, for viewers
    checkpoint: Checkpoint | None = None  # to be saved


class MujocoDriver(Driver):
    """Follows the wall clock at speed 1. At others, each tick waits for the brain's answer."""

    Options = MujocoOptions

    def __init__(self, robot: RobotFile, options: MujocoOptions, run: Run) -> None:
        # imported here, as MuJoCo takes 0.2 s and the class is also used to read options
        from gigabrain_drivers.sim.live_world import LiveWorld

        super().__init__(robot, options, run)
        if not SPEED_RANGE[0] <= run.speed <= SPEED_RANGE[1]:
            raise ConfigError(
                f"speed must be {SPEED_RANGE[0]:g} to {SPEED_RANGE[1]:g}, got {run.speed:g}"
            )
        self.lockstep = run.speed != 1.0
        self._checkpoints = checkpoint_files(run)
        self._simulation = self._make_simulation()
        self._world = LiveWorld(self._simulation, run.world, robot.cameras)
        period_ns = 1e9 / robot.lidar.rate_hz if robot.lidar else math.inf
        self._scan_ticks = period_ns / TICK_NS
        self._next_scan = self._scan_ticks
        self._ticks = 0  # since the start of this driver, as in the robot's clock
        self._last_ticks = self._remaining_ticks(run.seconds) if run.seconds else None
        self._commanded_ns = 0
        self._physics_s = 0.0  # CPU time of physics and lidar
        self._permits = threading.Semaphore(0)
        self._halt = threading.Event()
        self._thread: threading.Thread | None = None
        self._bridge: Bridge | None = None
        self._readings: asyncio.Queue[Reading | Exception | None] = asyncio.Queue()
        self._report = self._simulation.report(robot, run)  # of the newest tick
        self._state: RobotState | None = None
        self.sensors = dict.fromkeys(("imu", "scan") if robot.lidar else ("imu",))

    def _remaining_ticks(self, seconds: float) -> int:
        """Return the ticks that remain of a run of `seconds`.

        A resumed run is longer by a checkpoint's period: others count from the newest state that
        they received, which may be older than the checkpoint.
        """
        done_ns = self._simulation.time_ns
        ticks = round((seconds * 1e9 - done_ns) / TICK_NS)
        return max(0, ticks) + CHECKPOINT_TICKS * (done_ns > 0)

    def _make_simulation(self) -> "Simulation":
        from gigabrain_drivers.sim.physics import resumed  # imports MuJoCo, as above

        body = sim_body(self.robot, self.options, self.run)
        world, seed = load_world(self.run.world, self.run.seed), self.run.seed
        return resumed(body, world, seed, self._checkpoints)

    async def open(self) -> None:
        """Take the first readings. Time starts with the iteration of `ticks`."""
        self._state = self._read_state()
        self.sensors["imu"] = self._imu()
        if self.robot.lidar:
            self.sensors["scan"] = self._scan()
        for topic, message in self._world.scene():
            self.emit(topic, message)

    async def close(self) -> None:
        """End the physics thread."""
        self._halt.set()
        self._permits.release()
        if self._thread:
            await asyncio.to_thread(self._thread.join)
        if self._bridge:
            self._bridge.close()
        self._thread = self._bridge = self._state = None

    async def stop(self) -> None:
        """Come to rest."""
        self._simulation.command(0.0, 0.0)

    async def park(self) -> None:
        """Stop. The physics ends with this process, so nothing can fall."""
        await self.stop()

    async def limp(self) -> None:
        """Stop, and switch off the servos of an arm."""
        await self.stop()
        if self._simulation.arm:
            self._simulation.arm.let_go()

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """Yield 1 every 20 ms of simulated time, until the end of the run."""
        self._bridge = Bridge()
        self._thread = threading.Thread(target=self._run_physics, name="physics", daemon=True)
        self._thread.start()
        self._permits.release()
        while True:
            reading = await self._readings.get()
            if reading is None:
                self.finished = True
                return
            if isinstance(reading, Exception):
                if self._checkpoints:
                    await self._checkpoints.discard()  # it would fail again
                raise reading
            self._publish_reading(reading)
            if self._checkpoints and reading.checkpoint:
                saving = self._checkpoints.save(reading.checkpoint)
                if self.lockstep:
                    await saving
            if reading.state:
                yield 1
                self._permits.release()

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive or walk. Bodies on two wheels ignore the sideways part."""
        if self._state is None:
            raise BodyLost("the simulation is not open")
        self._commanded_ns = self._simulation.time_ns
        wanted = self.bounded(linear_x, linear_y, angular_z)
        sent = self._simulation.drive(wanted.linear_x, wanted.linear_y, wanted.angular_z)
        return Velocity(linear_x=sent.linear_x, linear_y=sent.linear_y, angular_z=sent.angular_z)

    async def set_joint_positions(self, positions: Mapping[str, float]) -> Mapping[str, float]:
        """Send the arm's servos to positions [rad] or [m]; return them as sent."""
        if self._simulation.arm is None:
            return await super().set_joint_positions(positions)
        within = self.bounded_joints(positions)
        self._simulation.arm.aim(within)
        return within

    async def read_state(self) -> RobotState:
        """Return the state at the end of the newest tick."""
        if self._state is None:
            raise BodyLost("the simulation is not open")
        return self._state

    async def change_world(self, request: SimRequest) -> SimReply:
        """Change the world between two steps. Raises Refused."""
        if self.finished:
            raise Refused("the simulation has ended")
        return await self._world.change(request)

    def report(self) -> Mapping[str, float | int | str | None]:
        """Return the ground truth of the run so far."""
        return self._report | {"physics_cpu_s": round(self._physics_s, 3)}

    def _publish_reading(self, reading: Reading) -> None:
        self._state = reading.state or self._state
        self.publish("imu", IMU, reading.imu)
        if reading.scan:
            self.publish("scan", SCAN, reading.scan)
        for topic, message in reading.news:
            self.emit(topic, message)

    def _run_physics(self) -> None:
        """Run the physics thread. Its errors are raised by `ticks`."""
        try:
            self._simulate()
        except Exception as error:  # noqa: BLE001 - raised by `ticks`, to end the process
            self._post(error)

    def _simulate(self) -> None:
        """Step until the end of the run, or until closed."""
        pace = Pace(STEP_S / self.run.speed)
        while not self._halt.is_set():
            if self.lockstep:
                self._permits.acquire()
            if self._ticks == self._last_ticks:
                self._post(None)
                return
            self._ticks += 1
            scans = self._ticks >= self._next_scan
            for step in range(STEPS_PER_TICK):
                # between states, only a scan needs the thread; a wake-up costs as much as a step
                pace.wait(1 if scans else STEPS_PER_TICK * (step == 0))
                if self._halt.is_set():
                    return
                self._post(self._step(last=step == STEPS_PER_TICK - 1))

    def _step(self, *, last: bool) -> Reading:
        if self._simulation.time_ns - self._commanded_ns >= COMMAND_TIMEOUT_NS:
            self._simulation.command(0.0, 0.0)
        self._timed(self._simulation.advance)
        if self._simulation.fallen:
            raise BodyLost(f"fell over after {self._simulation.time_ns / 1e9:.2f} s")
        news = self._world.step()
        if last:
            self._report = self._simulation.report(self.robot, self.run)
            saves = self._checkpoints is not None and self._ticks % CHECKPOINT_TICKS == 0
            checkpoint = self._simulation.checkpoint() if saves else None
            return Reading(self._imu(), None, self._read_state(), news, checkpoint)
        # like a real lidar, not synchronous with the states; between these, the cores are idle
        due = self._ticks >= self._next_scan
        if due:
            self._next_scan += self._scan_ticks
        return Reading(self._imu(), scan=self._scan() if due else None, news=news)

    def _timed(self, work: Callable[[], T]) -> T:
        """Run `work`, and add its CPU time to the report."""
        began = time.thread_time()
        result = work()
        self._physics_s += time.thread_time() - began
        return result

    def _post(self, reading: Reading | Exception | None) -> None:
        bridge = self._bridge
        if bridge:
            with contextlib.suppress(RuntimeError):  # the loop is gone
                bridge.post(self._readings.put_nowait, reading)

    def _read_state(self) -> RobotState:
        return state_message(self._simulation, self.robot.robot_type)

    def _imu(self) -> Imu:
        return Imu(**self._simulation.imu()._asdict())

    def _scan(self) -> LaserScan:
        lidar = self.robot.lidar
        assert lidar is not None
        return scan_message(lidar, self._timed(self._simulation.scan))
