"""A body in MuJoCo in real time, and the base class of its devices."""

import abc
import asyncio
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from msgspec import Struct

from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.emulators.hand import Hand
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_drivers.kinematics.legs import WALKER, Gait
from gigabrain_drivers.kinematics.wheels import Twist, wheels_of
from gigabrain_drivers.sim import STEP_S, Pace
from gigabrain_drivers.sim.arm_truth import ArmTruth
from gigabrain_drivers.sim.body import SimLidar
from gigabrain_drivers.sim.checkpoint import PERIOD_NS, CheckpointFiles
from gigabrain_drivers.sim.locomotion import Charge, Motor, OdometryReading
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.sensors import ImuSample, Lidar
from gigabrain_drivers.sim.world import Stream, generator
from gigabrain_zenoh.errors import BodyLost

log = logging.getLogger(__name__)

MAX_SNAPSHOTS = 25  # of 10 ms

MAX_SAMPLES_S = 0.5  # samples are kept for this long when no device reads them


class Snapshot(NamedTuple):
    """Measurements of the body's parts at the end of a step of 10 ms."""

    time_ns: int  # of the electronics' own clock
    odometry: OdometryReading
    wheels: tuple[Motor, ...]  # left, right; or all joints of legs; then those of an arm
    imu: ImuSample
    battery: Charge
    bumper: bool
    contacts: tuple[bool, ...] = ()  # which feet bear weight
    fallen: bool = False


class Broken(NamedTuple):
    """Faults of the body itself, not of its electronics."""

    runaway: float = 0.0  # [m/s], of the wheels, regardless of commands
    stuck_wheel: bool = False  # the first wheel does not turn
    frozen_values: bool = False  # measurements no longer change


class EmulatedBody:
    """A body in MuJoCo, in its own thread, 10 ms a step. Call all methods on the loop.

    `command` sets the motors' targets. The devices stop the body when commands end.
    """

    def __init__(
        self,
        robot: RobotFile,
        simulation: Simulation,
        run: Run,
        checkpoints: CheckpointFiles | None = None,
    ) -> None:
        self.robot, self.run = robot, run
        self._start_ns = simulation.time_ns
        self._checkpoints = checkpoints
        self._loop: asyncio.AbstractEventLoop | None = None  # after the start of time
        self.lost = ""  # why the physics ended; empty while it runs
        self.on_step: list[Callable[[Snapshot], None]] = []  # called in the physics thread
        self._simulation = simulation
        self._halt = threading.Event()
        self._thread: threading.Thread | None = None
        self._pace: Pace | None = None  # after the start of time
        self._commanded = (0.0, 0.0, 0.0)
        self._gait: Gait | None = None  # replaces the velocity
        self._aims: Mapping[str, float] | None = {}  # of its arm's servos; None: switched off
        self._efforts: Mapping[str, float] = {}  # [N m] or [N], maxima of the servos
        self.hand = Hand(robot.joints)  # of a person who moves the arm while its servos are off
        self._cpu_s = 0.0
        self._moved_ns = 0  # time of the last command to move
        self._faulted_ns = 0  # time of the last change of its faults
        self._broken = Broken()
        arm = simulation.arm
        self._arm_truth = ArmTruth(simulation.model, simulation.data, arm) if arm else None
        self.snapshot = self._measure_all()
        self._account = self._simulation.report(robot, run)  # as of the newest step
        self._untaken: deque[Snapshot] = deque(maxlen=MAX_SNAPSHOTS)

    def start(self) -> None:
        """Start the physics."""
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._work, name="physics", daemon=True)
        self._thread.start()

    async def close(self) -> None:
        """End the physics. May be called several times."""
        self._halt.set()
        thread, self._thread = self._thread, None
        if thread:
            await asyncio.to_thread(thread.join)
        if self.lost and self._checkpoints:
            await self._checkpoints.discard()  # it would fail again

    def command(self, linear_x: float, linear_y: float, angular_z: float) -> None:
        """Set the velocity that the motors aim for, from the next step on."""
        self._commanded, self._gait = (linear_x, linear_y, angular_z), None

    def walk(self, gait: Gait) -> None:
        """Set the gait that a quadruped aims for from the next step on."""
        self._gait = gait

    def aim(
        self, positions: Mapping[str, float], efforts: Mapping[str, float] | None = None
    ) -> None:
        """Set the goals of its arm's servos [rad] or [m], from the next step on.

        `efforts` [N m] or [N] limits them; by default they use all their torque.
        """
        self._aims = {**(self._aims or {}), **positions}
        self._efforts = efforts or {}

    def let_go(self) -> None:
        """Switch off its arm's servos from the next step on, until the next `aim`."""
        self._aims = None

    @property
    def joints(self) -> tuple[Motor, ...]:
        """The joints of its arm as measured, in the order of the robot's file."""
        return self.snapshot.wheels[-len(self.robot.joints) :] if self.robot.joints else ()

    @property
    def wheels(self) -> tuple[Motor, ...]:
        """The wheels, or joints of legs, as measured."""
        return self.snapshot.wheels[: len(self.snapshot.wheels) - len(self.robot.joints)]

    @property
    def commanded(self) -> tuple[float, float, float]:
        """The velocity that the motors aim for; for a gait, the velocity of its steps."""
        gait = self._gait
        if gait is None:
            return self._commanded
        linear_x, linear_y, angular_z = WALKER.to_body(gait)
        return linear_x, linear_y, angular_z

    def take_snapshots(self) -> list[Snapshot]:
        """Return the snapshots since the last call, oldest first, of at most 0.25 s.

        So a device that reports every step omits none while the loop is delayed.
        """
        return [self._untaken.popleft() for _ in range(len(self._untaken))]

    def set_broken(self, broken: "Broken") -> None:
        """Set faults of its motors and sensors, from the next step on; `Broken()` for none."""
        self._broken, self._faulted_ns = broken, self._simulation.time_ns

    @property
    def resumed(self) -> bool:
        """True if its run began in an earlier process: its electronics have lost their power."""
        return self._start_ns > 0

    @property
    def clock_ns(self) -> int:
        """Time since power-on of the electronics; includes simulated time that the host dropped."""
        dropped_s = self._pace.dropped_s if self._pace else 0.0
        return self._simulation.time_ns - self._start_ns + round(dropped_s * 1e9)

    @property
    def simulation(self) -> Simulation:
        """The physics. Use it in `on_step` only."""
        return self._simulation

    def report(self) -> Mapping[str, float | int | str | None]:
        """The truth of the run so far."""
        arm = self._arm_truth.report() if self._arm_truth else {}
        return (
            self._account
            | arm
            | {
                "motors_moved_s": round(self._moved_ns / 1e9, 2),
                "faulted_s": round(self._faulted_ns / 1e9, 2),
                "physics_cpu_s": round(self._cpu_s, 3),
            }
        )

    def _work(self) -> None:
        began = time.thread_time()
        self._pace = pace = Pace(STEP_S)
        while not self._halt.is_set():
            pace.wait()
            try:
                self._step()
            except BodyLost as error:
                self.lost = str(error)
                return
            except Exception as error:  # any error of the physics ends the process
                log.exception("the physics has ended")
                self.lost = f"{type(error).__name__}: {error}"
                return
            self._cpu_s = time.thread_time() - began

    def _step(self) -> None:
        commanded, broken = self.commanded, self._broken
        if any(commanded):
            self._moved_ns = self._simulation.time_ns
        if broken.runaway or broken.stuck_wheel:
            self._simulation.drive(*self._faulty_velocity(commanded))
        elif self._gait:
            self._simulation.walk(self._gait)
        else:
            self._simulation.drive(*commanded)
        self._drive_arm()
        self._simulation.advance()
        snapshot = self._measure_all()
        self._account = self._simulation.report(self.robot, self.run)
        if self._arm_truth:
            self._arm_truth.update(self._simulation.time_ns)
        if not broken.frozen_values:
            self.snapshot = snapshot
            self._untaken.append(snapshot)
        for callback in self.on_step:
            callback(snapshot)
        if self._checkpoints and self._loop and self._simulation.time_ns % PERIOD_NS == 0:
            checkpoint = self._simulation.checkpoint()
            self._loop.call_soon_threadsafe(self._checkpoints.save, checkpoint)

    def _drive_arm(self) -> None:
        arm, aims = self._simulation.arm, self._aims
        if arm is None:
            return
        places = {joint.name: joint.position for joint in self.joints}
        if by_hand := self.hand.step(places, limp=aims is None):
            arm.limit(dict.fromkeys(by_hand, math.inf))
            arm.aim(by_hand)
        elif aims is None:
            arm.let_go()
        elif aims:
            arm.limit(self._efforts)
            arm.aim(aims)

    def _faulty_velocity(self, commanded: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the velocity that broken motors give for a command."""
        base = wheels_of(self.robot)
        if self._broken.runaway or base is None:
            return self._broken.runaway, 0.0, 0.0
        _, *others = base.to_wheels(Twist(*commanded))
        return base.to_body((0.0, *others))

    def _measure_all(self) -> Snapshot:
        simulation = self._simulation
        return Snapshot(
            time_ns=self.clock_ns,
            odometry=simulation.odometry(),
            wheels=simulation.motors(),
            imu=simulation.imu(),
            battery=simulation.battery(),
            bumper=simulation.bumper(),
            contacts=simulation.contacts(),
            fallen=simulation.fallen,
        )


class Wire(Protocol):
    """The host's end of a device's line."""

    def write(self, data: bytes) -> bool:
        """Send to the host. Return False when it is not connected."""


class Port(Wire, Protocol):
    """The device's end of a link. It exists only while it is plugged in."""

    on_bytes: Callable[[bytes], None]  # set by the owner

    def plug(self) -> None:
        """Create it. Does nothing if it exists."""

    def unplug(self) -> None:
        """Remove it, even while it is in use. Does nothing if it is gone."""


class Device(abc.ABC):
    """The electronics on one link: answers bytes, moves the body, reports measurements.

    Call all methods on the loop. It has no clock: `step` gets the time.
    """

    Options: ClassVar[type[Struct]]  # options of its driver or scan source
    baud: ClassVar[int | None] = None  # of its line; None: as fast as the host
    period_s: ClassVar[float] = 0.01  # between two steps
    watchdog_ns = 150_000_000  # from the last command to the stop of its motors
    goes_on: ClassVar[bool] = False  # it has no watchdog: its motors never stop by themselves
    promised_in = "the rule for firmware"  # the source of `watchdog_ns`

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        self.body, self.options, self.wire = body, options, wire
        self.sag_volts = 0.0  # brown-out: drop of the supply [V]
        self.silent_servo = 0  # id of a servo that neither receives nor answers
        self.halted = False  # frozen or unplugged: for devices with a second processor

    @classmethod
    def port(cls, options: Any) -> Port:
        """Return its port: by default the pty in its driver's options."""
        return Pty(Path(options.port), cls.baud)

    @abc.abstractmethod
    def feed(self, data: bytes) -> None:
        """Handle bytes from the host, in pieces of any size."""

    @abc.abstractmethod
    def step(self, now_ns: int) -> None:
        """Run the firmware's loop once per `period_s`: telemetry and watchdog."""

    @abc.abstractmethod
    def reset(self) -> None:
        """Power on: state as at the start, motors at rest, then the banner if it has one."""


class Sample(NamedTuple):
    """One measurement."""

    angle: float  # [deg], clockwise from ahead, 0 to 360
    distance: float  # [mm]; 0: nothing in range


class Sweep:
    """A turning lidar. Each step of 10 ms, it casts rays over the angle turned in that step.

    It works in the physics thread. The robot's motion distorts its scans, as with a real lidar.
    """

    def __init__(self, body: EmulatedBody, range_min: float, range_max: float) -> None:
        config = SimLidar(range_min=range_min, range_max=range_max)
        self._data = body.simulation.data
        noise = generator(body.run.seed, Stream.LIDAR)
        self._lidar = Lidar(config, body.simulation.model, f"{ROBOT}lidar", noise)
        self._samples = deque[Sample]()
        self._rate_hz = self.turn_hz = self._angle = self._due = 0.0
        body.on_step.append(self._measure)

    def start(self, rate_hz: float, turn_hz: float) -> None:
        """Start measuring `rate_hz` samples a second, at `turn_hz` turns a second."""
        self._samples = deque(maxlen=math.ceil(rate_hz * MAX_SAMPLES_S))
        self.turn_hz, self._rate_hz = turn_hz, rate_hz

    def stop(self) -> None:
        """Measure nothing."""
        self._rate_hz = 0.0
        self._samples.clear()

    def next_samples(self, count: int) -> list[Sample]:
        """Return the next `count` samples, or an empty list if there are fewer."""
        samples = self._samples
        return [samples.popleft() for _ in range(count)] if len(samples) >= count else []

    def _measure(self, _: Snapshot) -> None:
        rate_hz, turn_hz, samples = self._rate_hz, self.turn_hz, self._samples
        if not rate_hz or not turn_hz:
            return
        self._due += rate_hz * STEP_S
        count = int(self._due)
        self._due -= count
        step = 360 * turn_hz / rate_hz
        angles = (self._angle + step * np.arange(count)) % 360
        self._angle = (self._angle + step * count) % 360
        turned = np.radians(angles)
        directions = np.stack([np.cos(turned), -np.sin(turned), np.zeros(count)], axis=1)
        ranges = self._lidar.cast(self._data, directions)
        distances = np.where(np.isfinite(ranges), ranges * 1000, 0.0)
        samples.extend(map(Sample, angles.tolist(), distances.tolist()))
