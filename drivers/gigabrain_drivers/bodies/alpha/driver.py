"""Driver of alpha, a quadruped on TCP that receives a gait fifty times a second.

The driver sends only commands that it receives. When they end, the firmware stops the body 100 ms
later (docs/reference/firmware_alpha.md).
"""

import logging

from msgspec.structs import replace

from gigabrain_drivers.bodies.alpha import protocol as alpha
from gigabrain_drivers.bodies.alpha.protocol import AlphaDecoder, AlphaFrame, State
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.kinematics.legs import (
    JOINT_NAMES,
    WALKER,
    LegGeometry,
    LegOdometry,
    by_joint,
)
from gigabrain_drivers.kinematics.wheels import Twist
from gigabrain_drivers.lidars.base import ScanSource, open_lidar
from gigabrain_drivers.links.device_clock import DeviceClock, EchoClock
from gigabrain_drivers.links.frames import Spelling, Wording
from gigabrain_drivers.links.link import Liveness
from gigabrain_drivers.links.tcp_link import AddressLink
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Battery, Joint, LinkHealth, RobotState
from gigabrain_schemas.sensors import Imu, ImuData
from gigabrain_schemas.topics import IMU
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

NO_VALID_FRAME = "no valid frames arrive: is this the right port?"
STATE_TIMEOUT_NS = 100_000_000  # the body counts as lost after this time without a state
FLUSH_NS = 10_000_000  # pause for the last command, before the connection closes
CLOCK_WRAP_MS = 1 << 32  # the firmware's clock wraps here
USUAL_ROUND_TRIP_MS = 30.0  # from a command to the state that echoes it


class AlphaOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The quadruped's part of a robot's file."""

    port: str = f"192.168.123.10:{alpha.PORT}"  # HOST:PORT, or a file with it


class AlphaDriver(Driver):
    """Sends nothing before the body reports. Its first command is a stop, also after a loss."""

    Options = AlphaOptions

    def __init__(self, robot: RobotFile, options: AlphaOptions, run: Run) -> None:
        super().__init__(robot, options, run)
        self._clock = Clock()
        self.link = AddressLink(options.port, self._clock)
        self.link.wording = Wording(
            Spelling(alpha.AlphaDecoder().feed, alpha.describe),
            Spelling(alpha.AlphaDecoder().feed, alpha.describe),
        )
        self.link.on_bytes, self.link.on_open = self._received, self._opened
        self.link.on_lost = self._lost
        self._decoder, self._odometry = AlphaDecoder(), LegOdometry(LegGeometry())
        self._sequence = 0  # of the newest command
        self._invalid_frames = 0  # complete frames with invalid content
        self._last: tuple[int, int] | None = None  # sequence and milliseconds of the newest state
        self._state: State | None = None
        self._liveness = Liveness(self.link, self._clock, STATE_TIMEOUT_NS, NO_VALID_FRAME, log)
        self._stamps, self._echoes = DeviceClock(CLOCK_WRAP_MS), EchoClock(USUAL_ROUND_TRIP_MS)
        self._unreported_loss = False  # True after a loss, until `read_state` reports it
        self._open = self._parked = False
        self._fall = Fault(log)
        self.sensors = dict.fromkeys(("imu", "scan") if options.scan else ("imu",))
        self._lidar: ScanSource | None = None

    async def open(self) -> None:
        """Start to connect to the body and its lidar, which may appear later."""
        self._open = True
        self.link.open()
        self._lidar = open_lidar(self, self._clock)

    async def close(self) -> None:
        """Stop the body, and close the connection."""
        if self._open:
            await self.stop()
            if self.link.connected:
                await self._clock.sleep_ns(FLUSH_NS)
        self._open = False
        await self.link.close()
        if self._lidar:
            await self._lidar.close()

    async def stop(self) -> None:
        """Come to rest and stand; a lying body stays down."""
        if self._liveness.received:
            encode = alpha.encode_park if self._parked else alpha.encode_stop
            self.link.write(encode(self._next_sequence()))

    async def park(self) -> None:
        """Lie down. Only a command to walk makes it stand up."""
        if not self._liveness.received:
            raise BodyLost(f"{self.link}: {self.link.problem or 'the body is silent'}")
        self._parked = True
        self.link.write(alpha.encode_park(self._next_sequence()))

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Walk. All speeds are zero if one is not a number, or while the body is lost."""
        if not self._open:
            raise BodyLost("the connection is not open")
        if not self._liveness.received:  # the firmware may still be starting
            return ZERO
        target = self.bounded(linear_x, linear_y, angular_z)
        if self._unreported_loss or self._fallen:
            target = ZERO
        if self._parked and target == ZERO:
            self.link.write(alpha.encode_park(self._next_sequence()))
            return ZERO
        self._parked = False
        gait = WALKER.to_gait(Twist(target.linear_x, target.linear_y, target.angular_z))
        seen_ms = self._last[1] if self._last else 0
        if not self.link.write(alpha.encode_walk(alpha.Walk(seen_ms, gait), self._next_sequence())):
            return ZERO
        return Velocity(**WALKER.to_body(gait)._asdict())

    async def read_state(self) -> RobotState:
        """Return the body's newest report; `link.connected` is False if it is too old."""
        velocity = self._odometry.velocity if self._liveness.received else Twist(0.0, 0.0, 0.0)
        state = RobotState(
            robot_type=self.robot.robot_type,
            pose=self._odometry.pose,
            velocity=Velocity(**velocity._asdict()),
            link=self._health(),
        )
        return _with_report(state, self._state) if self._state else state

    @property
    def _fallen(self) -> bool:
        return self._state is not None and bool(self._state.flags & alpha.FALLEN)

    def _next_sequence(self) -> int:
        self._sequence = (self._sequence + 1) % alpha.SEQUENCES
        self._echoes.sent(self._sequence, self._clock.now_ns())
        return self._sequence

    def _opened(self) -> None:
        """Reset all state for a new connection."""
        self._decoder.clear()
        self._liveness.reset()
        self._odometry.rest()
        self._last = None

    def _lost(self, why: str) -> None:
        self._unreported_loss = self._unreported_loss or self._liveness.received
        self._liveness.reset()

    def _received(self, data: bytes) -> None:
        for frame in self._decoder.feed(data):
            state = alpha.decode_state(frame) if frame.type == alpha.STATE else None
            if state is None:
                self._invalid_frames += 1
            else:
                self._handle_state(frame, state)
        self.link.errors = self._decoder.errors + self._invalid_frames

    def _handle_state(self, frame: AlphaFrame, state: State) -> None:
        """Handle one report. The firmware's clock gives the time since the last one."""
        last, self._last = self._last, (frame.sequence, state.milliseconds)
        if last and not alpha.is_newer(frame.sequence, last[0]):
            self._last = last
            return
        first, self._state = not self._liveness.received, state
        self._liveness.mark_received()
        now_ns = self._clock.now_ns()
        self._stamps.arrived(state.milliseconds, now_ns)
        self._echoes.echoed(state.echo, now_ns)
        if last:
            passed = (state.milliseconds - last[1]) % CLOCK_WRAP_MS
            self._odometry.update(state.senses, passed / 1000)
        if first:  # a lying body stays down until a command to walk
            self._parked = bool(state.flags & alpha.PARKED)
            encode = alpha.encode_park if self._parked else alpha.encode_stop
            self.link.write(encode(self._next_sequence()))
        senses = state.senses
        imu = Imu(
            orientation=senses.orientation,
            angular_velocity=senses.angular_velocity,
            linear_acceleration=senses.linear_acceleration,
        )
        self.publish("imu", IMU, imu)
        if self._fallen:
            self._fall.begin("the body has fallen over; it stands up when its firmware restarts")
        else:
            self._fall.end("the body stands again")

    def _health(self) -> LinkHealth:
        """Return the connection's health; `connected` means that reports arrive.

        A loss is reported at least once, even if the body is back at once.
        """
        alive = self._liveness.alive()
        reported, self._unreported_loss = not self._unreported_loss, False
        late_ms = max(self._stamps.late_ms, self._echoes.late_ms)
        return replace(self.link.health, connected=alive and reported, late_ms=late_ms)


def _with_report(state: RobotState, now: State) -> RobotState:
    """Return `state` with the values of the body's report."""
    senses = now.senses
    positions, rates = by_joint(senses.joints), by_joint(senses.rates)
    joints = zip(JOINT_NAMES, positions, rates, now.torques, now.temperatures, strict=True)
    return replace(
        state,
        joints=tuple(
            Joint(name=name, position=position, velocity=rate, effort=torque, temperature=celsius)
            for name, position, rate, torque, celsius in joints
        ),
        battery=Battery(voltage=now.voltage, percentage=now.percentage, current=now.current),
        imu=ImuData(
            orientation=senses.orientation,
            angular_velocity=senses.angular_velocity,
            linear_acceleration=senses.linear_acceleration,
        ),
    )
