"""A leader arm: a person moves it by hand, another arm follows.

It never moves by itself: the motors are switched off, and nothing else is written to its servos.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Self

from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.arming import Arming
from gigabrain_drivers.bodies.feetech.bus import ANSWER_TIMEOUT_NS, ATTEMPTS, HostBus
from gigabrain_drivers.bodies.feetech.calibration import calibration_path, load_calibration
from gigabrain_drivers.bodies.feetech.driver import FeetechOptions, refuse_incomplete, until_open
from gigabrain_drivers.bodies.feetech.joint import ServoJoint
from gigabrain_drivers.bodies.feetech.protocol import FIRST, LENGTH
from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import expanded

LEADER = "so101"


class LeaderJoint(ServoJoint):
    """A joint that a hand moves, faster than a motor."""

    pushed_factor, pushed_acceleration = 8.0, 1000.0  # [rad/s2]
    lost_after_ns = 500_000_000  # long is safe: the other arm waits meanwhile

    @property
    def leads_to(self) -> float:
        """Return the target of the follower's joint [rad]; a trigger is scaled to the gripper's."""
        its, joint = self.calibration, self.description
        if joint.part != "gripper" or self.newest is None:
            return self.position
        share = (self.newest.position - its.lower) / (its.upper - its.lower)
        share = share if its.direction > 0 else 1.0 - share
        return joint.lower + max(0.0, min(1.0, share)) * (joint.upper - joint.lower)


class LeaderArm:
    """A second SO-101. Its motors are off inside its `async with` block."""

    def __init__(
        self,
        port: str,
        calibration: str = "",
        *,
        clock: Clock | None = None,
        link: Link | None = None,
    ) -> None:
        """Check its calibration; `link` replaces the port. Raises ConfigError.

        `calibration` is a file, here or beside the robot's. Default: the one that
        `gigabrain driver calibrate so101 --leader` writes.
        """
        robot, options, path = leader_file(port, calibration)
        self._clock = clock or Clock()
        self._link = link or SerialLink(options.port, feetech.BAUD, self._clock)
        self._bus = HostBus(self._link, self._clock)
        calibrate = f"{robot.robot_type} --leader --port {port}"
        self._arming = Arming(self._bus, self._clock, calibrate, options.voltage)
        if not path.exists():
            raise ConfigError(
                f"{path}: no such file: the leader is not calibrated; "
                f"run gigabrain driver calibrate {calibrate}"
            )
        its = load_calibration(path, robot.robot_type, robot.joints, options.servos)
        self._joints = [
            LeaderJoint(
                joint, its.joints[joint.name], stall_torque=1.0, torque_limit=1.0, grip_torque=1.0
            )
            for joint in robot.joints
        ]
        self.let_go = False  # motors were on, and were switched off

    async def __aenter__(self) -> Self:
        """Find all servos, and switch their motors off. Raises ConfigError."""
        try:
            await self._open()
        except BaseException:
            await self._link.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._link.close()

    async def _open(self) -> None:
        await until_open(self._link)
        found = {str(joint): await self._bus.find(joint.id) for joint in self._joints}
        refuse_incomplete(str(self._link), found)
        for joint in self._joints:
            await self._arming.recognise(joint)
        for joint in self._joints:
            now = await self._arming.block(joint.id)
            if now and now.torque:
                self.let_go = True
                await self._bus.write(joint.id, feetech.TORQUE, 0)
                now = await self._arming.block(joint.id)
            if now is None or now.torque:
                raise ConfigError(
                    f"{self._link}: {joint} answers only at times: check its cable and power"
                )
            joint.begin(now, self._clock.now_ns())

    async def read(self) -> Mapping[str, float]:
        """Return its posture [rad] by joint. Raises ConfigError if it is lost."""
        for _ in range(ATTEMPTS):
            await self._ask()
            now_ns = self._clock.now_ns()
            lost = filter(None, (joint.lost(now_ns) for joint in self._joints))
            problem = self._link.problem or next(lost, "")
            if not problem:
                return {joint.description.name: joint.leads_to for joint in self._joints}
        raise ConfigError(f"the leader at {self._link}: {problem}")

    async def _ask(self) -> None:
        servos, asked_ns = [joint.id for joint in self._joints], self._clock.now_ns()
        question = feetech.sync_read(servos, FIRST, LENGTH)
        answers = await self._bus.ask(question, servos, LENGTH, len(servos) * ANSWER_TIMEOUT_NS)
        for joint in self._joints:
            if answer := answers.get(joint.id):
                joint.take(feetech.decode_readings(answer[1:]), asked_ns)


def leader_file(port: str, calibration: str = "") -> tuple[RobotFile, FeetechOptions, Path]:
    """Return a leader's robot file, its options for `port`, and its calibration's path.

    Raises ConfigError.
    """
    robot, _, options, folder = load_link(LEADER, Run(folder=Path(), link="real"))
    assert isinstance(options, FeetechOptions)
    try:
        options = replace(options, port=port)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if not calibration:
        return robot, options, calibration_path(f"{robot.robot_type}-leader", "", folder)
    here = expanded(calibration)
    beside = folder / here
    return robot, options, beside if beside.exists() and not here.exists() else here
