"""Collects the newest feedback of an AgileX Piper, and names its faults."""

from collections import deque
from collections.abc import Sequence

from gigabrain_drivers.bodies.piper import protocol as piper
from gigabrain_drivers.bodies.piper.protocol import JOINTS, ArmStatus, Drive, Gripper, Motor
from gigabrain_drivers.links.can_link import CanFrame
from gigabrain_drivers.links.recent import Recent
from gigabrain_schemas.body import Joint, JointDescription

JUMP_FACTOR = 1.5  # largest motion between two reports, relative to the maximal speed,
JUMP_SLACK = (0.05, 0.02)  # plus [rad] of a joint, [m] of a finger
JUMPS, WINDOW = 10, 100  # with this many jumps in a window of reports, there are two arms
GRIPPER_SPEED_NS = 40_000_000  # window of the gripper's mean speed
FRAME_BYTES = 8


class Feedback:
    """Collects the arm's frames, and rejects positions that no joint can have reached."""

    def __init__(self, joints: Sequence[JointDescription]) -> None:
        """`joints` are those of the robot's file: six of the arm, and optionally a gripper."""
        self._arm, self._hand = joints[:JOINTS], joints[JOINTS:]
        self.errors = 0  # rejected reports
        self.clear()

    def clear(self) -> None:
        """Forget everything: it may be another arm, or a restart."""
        self._stamps = dict[int, int]()  # of the newest frame of each identifier [ns]
        self._angles = [0.0] * JOINTS
        self._motors = [Motor(0.0, 0.0)] * JOINTS
        self._drives = [Drive(0.0, 0.0, 0.0, 0, 0.0)] * JOINTS
        self._temperatures = [Recent[float]() for _ in range(JOINTS)]
        self._gripper, self._gripper_speed = Gripper(0.0, 0.0, 0), 0.0
        self._gripper_before = (0.0, 0)  # [m], [ns]
        self._jumps = deque[bool](maxlen=WINDOW)
        self.status = ArmStatus()

    @property
    def complete(self) -> bool:
        """True after reports of all parts."""
        needed = set(piper.RECEIVED) - (set() if self._hand else {piper.GRIPPER})
        return needed <= self._stamps.keys()

    def stamp_ns(self) -> int | None:
        """Return the arrival of the oldest current position [ns]; None until all are known."""
        names = [*range(piper.POSITIONS, piper.POSITIONS + 3)]
        names += [piper.GRIPPER] if self._hand else []
        stamps = [self._stamps.get(id_) for id_ in names]
        known = [stamp for stamp in stamps if stamp is not None]
        return min(known) if len(known) == len(stamps) else None

    @property
    def positions(self) -> tuple[float, ...]:
        """The measured positions of all joints [rad]; for the gripper, of one finger [m]."""
        return (*self._angles, *(self._gripper.width / 2 for _ in self._hand))

    @property
    def motors_on(self) -> tuple[bool, ...]:
        """Return whether each motor holds: six of the arm, then the gripper's."""
        bits = [drive.status for drive in self._drives]
        bits += [self._gripper.status] if self._hand else []
        return tuple(bool(status & piper.ENABLED) for status in bits)

    def joints(self, now_ns: int) -> tuple[Joint, ...]:
        """Return all measured joints; the gripper's effort is its motor's torque [N m]."""
        arm = [
            Joint(
                name=joint.name,
                position=angle,
                velocity=motor.speed,
                effort=motor.current * ratio,
                temperature=temperature.get(now_ns),
                current=motor.current,
            )
            for joint, angle, motor, temperature, ratio in zip(
                self._arm, self._angles, self._motors, self._temperatures,
                piper.TORQUE_PER_AMPERE, strict=True,
            )
        ]  # fmt: skip
        hand = [
            Joint(
                name=joint.name,
                position=self._gripper.width / 2,
                velocity=self._gripper_speed / 2,
                effort=self._gripper.torque,
            )
            for joint in self._hand
        ]
        return (*arm, *hand)

    def take(self, frame: CanFrame, now_ns: int) -> None:
        """Handle a frame; ignore those that are not the arm's."""
        id_, data = frame
        if id_ not in piper.RECEIVED:
            return
        if len(data) != FRAME_BYTES:
            self.errors += 1
        elif id_ == piper.STATUS:
            self.status = piper.decode_status(data)
            self._stamps[id_] = now_ns
        elif id_ == piper.GRIPPER:
            self._take_gripper(piper.decode_gripper(data), now_ns)
        elif id_ >= piper.POSITIONS:
            self._take_angles(id_, piper.decode_pair(data), now_ns)
        elif id_ >= piper.DRIVES:
            drive = piper.decode_drive(data)
            self._drives[id_ - piper.DRIVES] = drive
            self._temperatures[id_ - piper.DRIVES].put(drive.motor_celsius, now_ns)
            self._stamps[id_] = now_ns
        else:
            self._motors[id_ - piper.MOTORS] = piper.decode_motor(data)
            self._stamps[id_] = now_ns

    def problem(self) -> str:
        """Return the fault that the arm reports, or an empty text."""
        if sum(self._jumps) >= JUMPS:
            return "its positions contradict each other: two arms on one bus?"
        status = self.status
        if text := piper.CONTROL_TEXTS.get(status.control):
            return text
        silent = [at + 1 for at in range(JOINTS) if status.faults >> at & 1]
        if silent:
            return f"joint {silent[0]} does not answer its controller: check its cable"
        for at, drive in enumerate(self._drives):
            if text := piper.fault_text(f"joint {at + 1}", drive.status, piper.FAULT_TEXTS):
                return text
        if status.state not in piper.HARMLESS:
            return piper.STATUS_TEXTS.get(status.state, f"it reports the fault {status.state}")
        if self._hand:
            return piper.fault_text("the gripper", self._gripper.status, piper.GRIPPER_FAULTS)
        return ""

    def _take_angles(self, id_: int, angles: tuple[float, float], now_ns: int) -> None:
        first, before_ns = 2 * (id_ - piper.POSITIONS), self._stamps.get(id_)
        for at, angle in enumerate(angles, first):
            way = angle - self._angles[at]
            if self._impossible(way, self._arm[at], before_ns, now_ns, JUMP_SLACK[0]):
                return
        self._angles[first : first + 2] = angles
        self._stamps[id_] = now_ns

    def _take_gripper(self, gripper: Gripper, now_ns: int) -> None:
        if not self._hand:
            return
        way, before_ns = gripper.width - self._gripper.width, self._stamps.get(piper.GRIPPER)
        if self._impossible(way / 2, self._hand[0], before_ns, now_ns, JUMP_SLACK[1]):
            return
        self._gripper, self._stamps[piper.GRIPPER] = gripper, now_ns
        width, since_ns = self._gripper_before
        if now_ns - since_ns >= GRIPPER_SPEED_NS:
            if since_ns and before_ns:
                self._gripper_speed = (gripper.width - width) / (now_ns - since_ns) * 1e9
            self._gripper_before = (gripper.width, now_ns)

    def _impossible(
        self, way: float, joint: JointDescription, before_ns: int | None, now_ns: int, slack: float
    ) -> bool:
        """Return whether a joint cannot have moved so far since its last report; count jumps."""
        if before_ns is None:
            return False
        most = JUMP_FACTOR * joint.max_speed * (now_ns - before_ns) / 1e9 + slack
        wrong = abs(way) > most
        self.errors += wrong
        self._jumps.append(wrong)
        return wrong
