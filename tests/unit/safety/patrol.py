"""Safety over time: a state per tick, a scan every 5 ticks, and a body that follows commands."""

import numpy as np
from msgspec.structs import asdict, replace
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import (
    Battery,
    BodyDescription,
    GateStatus,
    Joint,
    LinkHealth,
    RobotState,
    Thresholds,
)
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.sensors import ImuData
from gigabrain_zenoh.safety.health import Host
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step
from gigabrain_zenoh.testing.samples import DRIVING, WAFFLE, open_space, scan, state

BODY = replace(WAFFLE, thresholds=Thresholds(reaction_time=0.32))
LEVEL = (0.0, 0.0, 0.0, 1.0)


def imu(orientation: tuple[float, float, float, float] = LEVEL, push: float = 0.0) -> ImuData:
    """Return a sample at rest, with a horizontal acceleration `push` [m/s2]."""
    return ImuData(
        orientation=orientation,
        angular_velocity=(0.0, 0.0, 0.0),
        linear_acceleration=(push, 0.0, 9.81),
    )


class Patrol:
    """A body with safety, which starts with 10 ticks at rest."""

    def __init__(
        self, body: BodyDescription = BODY, values: NDArray[np.floating] | None = None
    ) -> None:
        self.body, self.memory = body, SafetyMemory()
        self.tick, self.pose = 0, Pose(x=0.0, y=0.0, yaw=0.0)
        self.verdict = SafetyState(verdict="stop")
        self.state = state(0)
        self.go(10, values=values)

    def go(
        self,
        ticks: int = 1,
        *,
        commanded: Velocity | None = None,
        moves: Velocity | None = None,
        values: NDArray[np.floating] | None = None,
        gate: GateStatus = DRIVING,
        battery: Battery | None = None,
        joints: tuple[Joint, ...] = (),
        imu: ImuData | None = None,
        bumpers: tuple[bool, ...] = (),
        echo_ages: tuple[int, ...] = (),
        shock: float = 0.0,
        host: Host | None = None,
        frozen: bool = False,
        connected: bool = True,
        late_ms: float | None = None,
        age_ms: float = 0.0,
        scan_late_ms: float = 0.0,
    ) -> list[str]:
        """Run some ticks; return the codes of the causes after the last one."""
        twist = commanded or Velocity()
        for _ in range(ticks):
            self.tick += 1
            if not frozen:
                self.state = self._state(moves or twist, battery, joints, imu, bumpers)
            link = LinkHealth(connected=connected, age_ms=age_ms, late_ms=late_ms)
            self.state = replace(
                self.state, tick=self.tick, basis=self.tick, gate=gate, link=link, sent=twist
            )
            command = CmdVel(
                **asdict(twist), source="control", boot=self.state.boot, tick=self.tick - 1
            )
            basis = self.tick - self.tick % 5
            newest = scan(open_space() if values is None else values, basis)
            inputs = SafetyInputs(
                state=self.state,
                scan=replace(newest, late_ms=scan_late_ms) if basis else None,
                scan_age_ns=0,
                command=command,
                echo_ages=echo_ages,
                shock=shock,
                host=host or Host(),
            )
            self.memory, self.verdict = step(self.body, self.memory, inputs)
        return self.codes

    def _state(
        self,
        moves: Velocity,
        battery: Battery | None,
        joints: tuple[Joint, ...],
        imu: ImuData | None,
        bumpers: tuple[bool, ...],
    ) -> RobotState:
        pose = self.pose
        self.pose = replace(
            pose,
            x=pose.x + 0.02 * moves.linear_x,
            y=pose.y + 0.02 * moves.linear_y,
            yaw=pose.yaw + 0.02 * moves.angular_z,
        )
        return replace(
            state(1),
            pose=self.pose,
            velocity=moves,
            battery=battery,
            joints=joints,
            imu=imu,
            bumpers=bumpers,
        )

    @property
    def codes(self) -> list[str]:
        """Codes of the present causes."""
        return [cause.code for cause in self.verdict.causes]

    @property
    def warnings(self) -> list[str]:
        """Codes of the present warnings."""
        return [warning.code for warning in self.verdict.warnings]

    def ticks_until(self, code: str, limit: int, **moment: object) -> int:
        """Return the number of ticks until `code` is among causes and warnings."""
        for tick in range(1, limit + 1):
            self.go(**moment)  # type: ignore[arg-type]
            if code in self.codes + self.warnings:
                return tick
        raise AssertionError(f"no {code} within {limit} ticks: {self.codes} {self.warnings}")
