"""A gate on the bench: it is told what happens, one event after another."""

from collections.abc import Callable
from typing import Literal

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.body import JointDescription
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO, Limits

BOOT = 7
LIMITS = Limits(
    linear_speed=0.26,
    lateral_speed=0.2,
    angular_speed=1.8,
    linear_acceleration=1.0,  # 0.02 m/s a tick
    linear_deceleration=2.0,  # 0.04 m/s a tick
    angular_acceleration=3.0,  # 0.06 rad/s a tick
)
ZONE = Cause(code="zone_ahead", text="obstacle 0.10 m ahead of the body")
BLIND = Cause(code="scan_blind", text="the lidar is blind")
LOST = Cause(code="link_lost", text="the body does not answer")
CRASHED = Cause(code="collision", text="it has hit something", latching=True)
HOT = Cause(code="motor_hot", text="a motor is hot", latching=True)


def plain(causes: tuple[Cause, ...]) -> list[tuple[str, str]]:
    """Codes and sentences, without the advice."""
    return [(cause.code, cause.text) for cause in causes]


class Rig:
    """One gate and its present state. Times are counted back from now, in ticks."""

    def __init__(
        self,
        *,
        auto_resume: bool = False,
        basis_ns: int = 250_000_000,
        joints: tuple[JointDescription, ...] = (),
    ) -> None:
        self.config = gate.GateConfig(
            limits=LIMITS, joints=joints, basis_ns=basis_ns, auto_resume=auto_resume
        )
        self.state = gate.GateState(boot=BOOT)
        self.seq = 0
        self.outcome = gate.Outcome()

    def feed(self, event: gate.Event) -> gate.Outcome:
        self.state, self.outcome = gate.step(self.config, self.state, event)
        return self.outcome

    def tick(
        self,
        count: int = 1,
        measured: Velocity = ZERO,
        faults: tuple[Cause, ...] = (),
        wall_ns: int | None = None,
        late: bool = False,
    ) -> None:
        for _ in range(count):
            self.feed(gate.Tick(measured, wall_ns, faults, late))

    def send(
        self,
        linear_x: float = 0.0,
        linear_y: float = 0.0,
        angular_z: float = 0.0,
        *,
        source: str = "control",
        seq: int | None = None,
        boot: int = BOOT,
        echo: int = 0,
        basis: int | None = 0,
        wall_ns: int | None = None,
    ) -> gate.Outcome:
        self.seq = self.seq + 1 if seq is None else seq
        command = CmdVel(
            linear_x=linear_x,
            linear_y=linear_y,
            angular_z=angular_z,
            source=source,
            seq=self.seq,
            boot=boot,
            tick=self.state.tick - echo,
            basis=0 if basis is None else self.state.tick - basis,
        )
        return self.feed(gate.VelocityCommand(command, wall_ns))

    def safety(
        self,
        *causes: Cause,
        verdict: Literal["ok", "slow", "stop"] = "ok",
        caps: SpeedCaps = NO_CAPS,
        tick: int = 0,
        boot: int = BOOT,
    ) -> None:
        said = SafetyState(
            verdict=verdict, caps=caps, causes=causes, boot=boot, tick=self.state.tick - tick
        )
        self.feed(gate.Safety(said))

    def live(self, ticks: int, linear_x: float = 0.0, angular_z: float = 0.0) -> None:
        """All is well: in every tick safety says so and the brain commands."""
        for _ in range(ticks):
            self.tick()
            self.safety()
            self.send(linear_x, angular_z=angular_z)

    def until(self, mode: str, go_on: Callable[[], None]) -> int:
        """Call `go_on` until the gate is in `mode`, and return the number of calls."""
        for count in range(1, 1000):
            go_on()
            if self.state.mode == mode:
                return count
        raise AssertionError(f"never {mode}")

    @property
    def mode(self) -> str:
        return self.state.mode

    @property
    def codes(self) -> list[str]:
        return [cause.code for cause in self.state.causes]


def idle(*, auto_resume: bool = False, basis_ns: int = 250_000_000) -> Rig:
    """All is well and a person has released the gate."""
    rig = Rig(auto_resume=auto_resume, basis_ns=basis_ns)
    rig.live(24)
    rig.tick()
    rig.safety()
    rig.send()
    assert rig.feed(gate.Release(rig.state.estop_generation)).ok
    return rig


def enabled(source: str = "control", *, basis_ns: int = 250_000_000) -> Rig:
    """All is well and `source` holds the body. It is tick 25."""
    rig = idle(basis_ns=basis_ns)
    assert rig.feed(gate.Enable(source)).ok
    return rig


def calm(source: str = "control") -> Rig:
    """`source` holds the body, and the 100 ms in which nobody moves it are over with this tick."""
    rig = enabled(source)
    for _ in range(4):
        rig.tick()
        rig.safety()
        rig.send(source=source)
    rig.tick()
    rig.safety()
    return rig


def driving(linear_x: float = 0.2) -> Rig:
    """The brain drives at `linear_x` [m/s]."""
    rig = enabled()
    rig.live(15, linear_x)
    assert rig.state.output.linear_x == linear_x
    return rig
