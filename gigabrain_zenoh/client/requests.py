"""Requests to a robot: its gate, e-stop, parameters, simulated world and audit log."""

import asyncio
import math
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

from msgspec.structs import asdict

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.brain import JointSpeeds, Twist
from gigabrain_schemas.logs import AuditRecord, AuditRequest
from gigabrain_schemas.requests import (
    EnableRequest,
    EstopRequest,
    GateReply,
    LimpRequest,
    Param,
    ParamRequest,
    ReleaseRequest,
)
from gigabrain_schemas.sim import SimReply, SimRequest
from gigabrain_schemas.topics import (
    AUDIT_LOG,
    ENABLE,
    ESTOP,
    JOINT_TELEOP,
    LIMP,
    PARAM,
    RELEASE,
    SIM_CHANGE,
    TELEOP,
    Service,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import (
    BodyLost,
    BusError,
    ConfigError,
    NotConfirmed,
    Refused,
    StillStopping,
)
from gigabrain_zenoh.runtime.audit import in_order
from gigabrain_zenoh.security.identity_files import may_not_ask

Q = TypeVar("Q", bound=Message)

ANSWER_S = 1.0  # timeout of a reply
WORLD_ANSWER_S = 3.0  # timeout; simulated time may stand still for 2 s first

FIRST_S, REPEAT_S = 0.15, 0.05  # pause before the first repeated e-stop request, and the next
GIVE_UP_S = 2.0  # without a confirmation of an e-stop
MAX_SOURCE_CHARS, MAX_TEXT_BYTES = 64, 500  # of an e-stop request
LAST_WAIT_S = 0.05  # for replies that arrived while this process was blocked
BY_HAND = "press the hardware e-stop or cut the robot's power"

Asks = set[asyncio.Task[list[GateReply]]]


def still_open(bus: Bus) -> Bus:
    """Return the bus. Raises BusError if it is closed, as after the block of a connection."""
    if bus.closed:
        raise closed("async with")
    return bus


def closed(block: str) -> BusError:
    """Return the error for a robot that is used after its block, `with` or `async with`."""
    return BusError(
        f"the connection is closed; use `{block} gigabrain_zenoh.connect() as robot:` again, and "
        "the robot inside it"
    )


async def ask_gate(
    bus: Bus, service: Service[Q, GateReply], request: Q, keys: str = ""
) -> GateReply:
    """Return the granted request's reply.

    Raises Refused with the gate's reason, StillStopping while the gate brakes, and BodyLost without
    a reply, perhaps because `keys` lack the right.
    """
    replies = await bus.ask(service, request, timeout_s=ANSWER_S)
    if not replies:
        doubt = may_not_ask(keys) or "; is it running?"
        raise BodyLost(f"no driver answers {service.key}{doubt}")
    reply = replies[0]
    if not reply.ok:
        kind = StillStopping if reply.gate.mode == "stopping" else Refused
        raise kind(f"{reply.robot_type}: {reply.text}")
    return reply


async def enable(bus: Bus, source: str, *, take: bool = False, keys: str = "") -> GateReply:
    """Ask the gate to obey `source`, such as the brain. Raises Refused and BodyLost."""
    request = EnableRequest(source=source, take=take, by=bus.process)
    return await ask_gate(bus, ENABLE, request, keys)


async def release(bus: Bus, estop_generation: int, keys: str = "") -> GateReply:
    """Release the gate from the e-stop of that number. Raises Refused and BodyLost."""
    request = ReleaseRequest(estop_generation=estop_generation, source=bus.process)
    return await ask_gate(bus, RELEASE, request, keys)


async def let_go(bus: Bus, limp: bool, keys: str = "") -> GateReply:
    """Let go of all joints, which may fall, or hold them again. Raises Refused and BodyLost."""
    return await ask_gate(bus, LIMP, LimpRequest(limp=limp, source=bus.process), keys)


def jog(bus: Bus, speeds: Mapping[str, float]) -> None:
    """Publish an operator's velocities of joints [rad/s or m/s].

    Raises ConfigError for a velocity that is not finite.
    """
    check_finite(speeds)
    names, values = tuple(speeds), tuple(speeds.values())
    bus.publish(JOINT_TELEOP, JointSpeeds(name=names, velocity=values, source=bus.session))


async def params(bus: Bus, process: str) -> tuple[Param, ...]:
    """Return the parameters of a process; none if it does not reply. Raises Refused."""
    replies = await bus.ask(PARAM, ParamRequest(), timeout_s=ANSWER_S, name=process)
    return replies[0].params if replies else ()


class ParamTable:
    """Parameters of all processes. Those of a process that does not reply stay as they were."""

    def __init__(self, bus: Bus, processes: Callable[[], Iterable[str]]) -> None:
        self._bus, self._processes = bus, processes
        self._known: dict[str, tuple[Param, ...]] = {}

    async def read(self) -> Mapping[str, tuple[Param, ...]]:
        """Ask all processes; return their parameters by process."""
        names = sorted(self._processes())
        answers = await asyncio.gather(*map(self._read_one, names))
        self._known = {
            name: found or self._known.get(name, ())
            for name, found in zip(names, answers, strict=True)
        }
        return self._known

    async def _read_one(self, name: str) -> tuple[Param, ...]:
        try:
            return await params(self._bus, name)
        except Refused:  # the process is busy
            return ()


async def set_param(bus: Bus, process: str, name: str, value: str) -> str:
    """Change a parameter; return a sentence for people. Raises Refused and BodyLost."""
    request = ParamRequest(name=name, value=value, source=bus.process)
    replies = await bus.ask(PARAM, request, timeout_s=ANSWER_S, name=process)
    if not replies:
        raise BodyLost(f"no answer from {process}; is it running?")
    if not replies[0].ok:
        raise Refused(f"{process}: {replies[0].text}")
    return f"{process}: {replies[0].text}"


def steer(bus: Bus, wanted: Velocity) -> None:
    """Publish an operator's velocity for the robot's own control.

    Raises ConfigError for a number that is not finite.
    """
    check_finite(asdict(wanted))
    bus.publish(TELEOP, Twist(**asdict(wanted), source=bus.session))


def check_finite(numbers: Mapping[str, float]) -> None:
    """Raise ConfigError for the first number that is NaN or infinite."""
    for name, number in numbers.items():
        if not math.isfinite(number):
            raise ConfigError(f"{name}: expected a finite number, got {number}")


def check_speed(speed: float | None) -> None:
    """Raise ConfigError for an upper limit that is not above 0; None is no limit."""
    if speed is not None and not speed > 0:
        raise ConfigError(f"speed: expected more than 0, got {speed:g}")


async def change_world(bus: Bus, request: SimRequest, keys: str = "") -> SimReply:
    """Change a simulated world, or list its added objects. Raises Refused and BodyLost."""
    replies = await bus.ask(SIM_CHANGE, request, timeout_s=WORLD_ANSWER_S)
    if not replies:
        doubt = may_not_ask(keys) or "; a simulation starts with `gigabrain demo`"
        raise BodyLost(f"no process has a simulated world here{doubt}")
    if not replies[0].ok:
        raise Refused(replies[0].text)
    return replies[0]


async def audit_log(bus: Bus, newest: int) -> tuple[AuditRecord, ...]:
    """Return the newest entries of all audit logs, oldest first. Raises BodyLost without any."""
    pages = await bus.ask(AUDIT_LOG, AuditRequest(newest=newest), timeout_s=ANSWER_S)
    if not pages:
        raise BodyLost("no process answers with an audit log; is the driver running?")
    return in_order([page.records for page in pages])[-newest:]


async def press_estop(bus: Bus, reason: str = "", *, within_s: float = GIVE_UP_S) -> GateReply:
    """Press the e-stop until a body confirms that it is latched. Raises NotConfirmed.

    A `reason` that is too long is cut, as an invalid request would not stop the body.
    """
    loop = asyncio.get_running_loop()
    source = _shortened(bus.process or "anonymous")[:MAX_SOURCE_CHARS]
    request = EstopRequest(source=source, reason=_shortened(reason))
    end_s, pause_s, refused = loop.time() + within_s, FIRST_S, ""
    asks: Asks = set()
    try:
        while (left_s := end_s - loop.time()) > 0:
            asks.add(asyncio.create_task(bus.ask(ESTOP, request, timeout_s=left_s)))
            reply, refusal = await _wait_for_latched(asks, min(pause_s, left_s))
            if reply:
                return reply
            refused, pause_s = refusal or refused, REPEAT_S
        reply, refusal = await _wait_for_latched(asks, LAST_WAIT_S)
        if reply:
            return reply
        refused = refusal or refused
    finally:
        for ask in asks:
            ask.cancel()
        await asyncio.gather(*asks, return_exceptions=True)
    problem = refused or "no driver answers"
    raise NotConfirmed(f"NOT CONFIRMED: {problem}; {BY_HAND}")


def _shortened(value: object) -> str:
    """Return `value` as valid text of at most MAX_TEXT_BYTES."""
    return str(value).encode(errors="replace")[:MAX_TEXT_BYTES].decode(errors="ignore")


async def _wait_for_latched(asks: Asks, within_s: float) -> tuple[GateReply | None, str]:
    """Return the first confirmation within the time, or None and the newest refusal."""
    loop = asyncio.get_running_loop()
    end_s, refused = loop.time() + within_s, ""
    while asks and (left_s := end_s - loop.time()) > 0:
        done, _ = await asyncio.wait(asks, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
        asks -= done
        for ask in done:
            try:
                latched = [reply for reply in ask.result() if reply.gate.mode == "latched"]
            except Refused as error:
                refused = str(error)
                continue
            if latched:
                return latched[0], ""
    await asyncio.sleep(max(0.0, end_s - loop.time()))
    return None, refused
