"""What the gate knows, what can happen to it, and what it answers."""

import msgspec

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.body import GateMode, GateStatus
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.gate import causes as why
from gigabrain_zenoh.geometry.limits import ZERO, Limits

BRAIN = "control"  # the commander of the normal chain


class GateConfig(msgspec.Struct, frozen=True, kw_only=True):
    """What the gate must know of the body and of the deployment."""

    limits: Limits
    basis_ns: int = 250_000_000  # oldest sensor data that may move the body
    auto_resume: bool = False


class GateState(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that the gate remembers."""

    boot: int
    tick: int = 0
    issued_ns: tuple[int, ...] = ()  # wall time of the newest ticks, oldest first
    mode: GateMode = "latched"
    causes: tuple[Cause, ...] = (why.BOOT,)
    faults: tuple[Cause, ...] = ()  # what the driver itself knew to be wrong at the last tick
    estop_generation: int = 0
    by_hand: bool = False  # released from a latch: only a person enables it, not auto resume
    commander: str = ""
    enables: int = 0
    enabled_tick: int = -1000  # when the present commander was let in
    command: CmdVel | None = None  # last good one of the commander
    command_tick: int = 0  # when it came
    next_seq: int = 0  # the lowest that the commander may use
    heard: CmdVel | None = None  # last good one of the brain, whoever commands
    heard_tick: int = -1000
    safety: SafetyState | None = None
    stopped_tick: int = 0  # when stopping began
    still_ticks: int = 0
    healthy_ticks: int = 0
    nan_ticks: tuple[int, ...] = ()
    late: bool = False  # whether this tick is one that was missed and is made up for
    before: Velocity = ZERO  # what the body was told in the last tick
    output: Velocity = ZERO  # what the body is to be told now


class Tick(msgspec.Struct, frozen=True):
    """20 ms of the body's time have passed."""

    measured: Velocity
    wall_ns: int | None = None
    faults: tuple[Cause, ...] = ()  # what the driver itself knows to be wrong
    late: bool = False  # it was missed and is made up for, right behind another one


class Command(msgspec.Struct, frozen=True):
    """Somebody wants the body to move."""

    command: CmdVel
    wall_ns: int | None = None


class NotFinite(msgspec.Struct, frozen=True):
    """Somebody sent NaN or infinity for a speed."""

    source: str
    boot: int


class Safety(msgspec.Struct, frozen=True):
    """The safety process has spoken."""

    state: SafetyState


class Estop(msgspec.Struct, frozen=True):
    """Somebody pressed the e-stop."""

    source: str


class Release(msgspec.Struct, frozen=True):
    """A person lets go of the latch."""

    estop_generation: int


class Enable(msgspec.Struct, frozen=True):
    """Somebody asks for the body."""

    source: str
    take: bool = False
    by: str = ""  # who asks for it, where that is somebody else


Event = Tick | Command | NotFinite | Safety | Estop | Release | Enable


class Outcome(msgspec.Struct, frozen=True):
    """What came of an event."""

    refused: str = ""  # why a command was not obeyed; a code
    ok: bool = True  # whether a request was granted
    text: str = ""  # the answer to a request, for people


def status(state: GateState) -> GateStatus:
    """The gate as `robot/state` shows it."""
    return GateStatus(
        mode=state.mode,
        causes=state.causes,
        estop_generation=state.estop_generation,
        commander=state.commander,
        enables=state.enables,
    )
