"""Commander for velocities from ROS: a pure state machine before the gate.

The first non-zero command asks for the body. Each command is sent to the gate at once, and repeated
with each state of the robot for at most one period of its sender. After that it sends nothing, then
zero, and 0.5 s after the last command it gives the body back. If it loses the body, by a stop or to
another commander, it asks again only after the sender has sent zero or has paused.
"""

import math
import statistics
from typing import Any, NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_zenoh.geometry.limits import ZERO, Limits, clamp
from gigabrain_zenoh.ros2.transport import Received

MS = 1_000_000
TIMEOUT_NS = 200 * MS  # longest period of a sender
BRAKE_NS = 60 * MS  # silence after the period, before zero is sent; the gate tolerates 100 ms
RELEASE_NS = 500 * MS  # after the last command
AWAKE_NS = 100 * MS  # longest silence between two events; a longer one is a freeze of this process
AHEAD_NS = 100 * MS  # a stamp may be this far ahead of our clock
ASK_NS = 500 * MS  # between two requests for the body
INTERVALS = 9  # of a sender, for the median
WINDOW_NS = 10_000_000_000  # shortest time for which a sender's shortest delay counts
BACK_NS = 20 * MS  # a sender's two threads may reorder messages by this time
MAX_SENDERS = 8
FRAMES = ("", "base_link", "base_footprint")  # allowed frames of a command
NO_ROBOT = "no state from the robot; check that its driver runs"
NO_BASE = "the robot has no base to drive; move its joints by /joint_trajectory"
HELD = "the network had held it back, or its sender's clock was set back"
PAUSE = "send zero, or pause for 0.5 s, before it may drive again"


class Config(Struct, frozen=True, kw_only=True):
    """Settings of the commander."""

    name: str  # of this commander, at the gate
    take: bool = False
    timeout_ns: int = TIMEOUT_NS


class Wanted(NamedTuple):
    """A velocity command from ROS."""

    linear: tuple[float, float, float]  # [m/s]
    angular: tuple[float, float, float]  # [rad/s]
    sender: bytes = b""
    frame: str = ""
    stamp_ns: int = 0  # of a TwistStamped, in ROS time; 0 for none
    sent_ns: int | None = None  # Unix time of the sender's clock; None or 0: unknown
    number: int | None = None  # counts the sender's messages; None: only their order is known


class Lateness(Struct, frozen=True):
    """Delay of messages beyond the shortest one of the last ten to twenty seconds.

    The clocks may differ, because all delays contain the same offset. Messages that a network
    delivers after a freeze are late, even if the sender's clock was set meanwhile. If the times
    of ordered messages go back, the sender's clock was set.
    """

    now_ns: int = 0  # of the newest message; 0 for one without a time
    least_ns: int | None = None  # shortest delay in this window, including the offset
    before_ns: int | None = None  # the same in the previous window
    began_ns: int = 0  # start of this window
    sent_ns: int = 0  # of its first message, by the sender's clock
    newest: tuple[int, int, int] = (0, 0, 0)  # times of sending and arrival, and its `clock_ns`

    @property
    def shortest_ns(self) -> int | None:
        """The shortest delay, including the offset; None before the first message with a time."""
        known = [ns for ns in (self.least_ns, self.before_ns) if ns is not None]
        return min(known, default=None)

    def then(
        self, sent_ns: int | None, arrived_ns: int, clock_ns: int, period_ns: int = 0, *,
        ordered: bool = True,
    ) -> "Lateness":  # fmt: skip
        """Return the state after a message; `sent_ns` and `arrived_ns` may be of different clocks.

        `clock_ns` is monotonic and ends the windows. `period_ns` is the sender's. A message that is
        not `ordered` was sent before the last one.
        """
        if not sent_ns:  # Cyclone DDS gives 0 for a message without a time
            return replace(self, now_ns=0)
        delay_ns, newest, fresh = arrived_ns - sent_ns, (sent_ns, arrived_ns, clock_ns), self
        age_ns = clock_ns - self.began_ns
        # in a freeze of the network only our clock advances between two messages
        paused_ns = min(age_ns, abs(sent_ns - self.sent_ns))
        if self.least_ns is None or paused_ns > 2 * WINDOW_NS:
            fresh = Lateness(0, None, None, clock_ns, sent_ns)
        elif ordered and sent_ns < self.newest[0] - BACK_NS:
            late_ns, gap_ns = self._at_most(arrived_ns, clock_ns)
            least_ns = delay_ns - late_ns - max(0, gap_ns - period_ns)
            return Lateness(late_ns + gap_ns, least_ns, None, clock_ns, sent_ns, newest)
        elif age_ns > WINDOW_NS:
            fresh = Lateness(0, None, self.least_ns, clock_ns, sent_ns)
        least_ns = delay_ns if fresh.least_ns is None else min(fresh.least_ns, delay_ns)
        after = replace(fresh, least_ns=least_ns, newest=newest)
        return replace(after, now_ns=delay_ns - (after.shortest_ns or 0))

    def _at_most(self, arrived_ns: int, clock_ns: int) -> tuple[int, int]:
        """Return the last message's delay and the time since; both bound the next delay."""
        sent_ns, last_ns, last_clock_ns = self.newest
        gap_ns = max(arrived_ns - last_ns, clock_ns - last_clock_ns)
        return last_ns - sent_ns - (self.shortest_ns or 0), gap_ns


class Now(NamedTuple):
    """The present time."""

    ns: int  # monotonic
    ros_ns: int  # ROS time: Unix time, or that of the simulation
    unix_ns: int  # of this host
    boot_ns: int  # since this host's start, including suspends; not affected by setting the clock


class Sender(Struct, frozen=True):
    """One publisher of commands."""

    id: bytes
    last_ns: int
    intervals: tuple[int, ...] = ()  # [ns], newest last
    lateness: Lateness = Lateness()
    number: int | None = None  # of its last message


class Silence(Struct, frozen=True):
    """Time without a command, while this process was awake to receive one."""

    length_ns: int = RELEASE_NS
    until_ns: int = 0

    @property
    def is_pause(self) -> bool:
        """True after a pause of the sender, which may then ask for a lost body again."""
        return self.length_ns >= RELEASE_NS

    def then(self, now_ns: int) -> "Silence":
        """Return the silence at a later time; freezes of this process do not count."""
        return Silence(self.length_ns + min(now_ns - self.until_ns, AWAKE_NS), now_ns)

    @staticmethod
    def broken(now_ns: int) -> "Silence":
        """Return the silence after a command at this time."""
        return Silence(0, now_ns)


class Memory(Struct, frozen=True, kw_only=True):
    """State of the commander."""

    gate: GateStatus | None = None  # newest of a fresh state
    boot: int = 0
    granted: tuple[int, int] = (0, 0)  # boot, and the gate's count of enables, of the last grant
    holds: bool = False  # has the body since the last grant
    asking: bool = False
    asked_ns: int = -ASK_NS
    blocked: str = ""  # why the sender must pause first
    velocity: Velocity = ZERO
    silence: Silence = Silence()  # since any command, even a refused one
    last_ns: int = -RELEASE_NS  # estimated sending time of the newest accepted command
    period_ns: int = TIMEOUT_NS  # of its sender
    senders: tuple[Sender, ...] = ()  # newest last
    refusal: str = ""  # why commands are refused now; empty if they are accepted


class Ask(NamedTuple):
    """Ask the gate for the body."""

    take: bool


class Send(NamedTuple):
    """Send a velocity to the gate."""

    velocity: Velocity


class Refuse(NamedTuple):
    """Count a refused command."""

    code: str


Action = Ask | Send | Refuse
Step = tuple[Memory, tuple[Action, ...]]


def arrive(config: Config, limits: Limits, memory: Memory, wanted: Wanted, now: Now) -> Step:
    """Process a command of ROS."""
    paused = memory.silence.then(now.ns).is_pause
    memory = replace(memory, silence=Silence.broken(now.ns))
    code, text = _fault(config, limits, wanted, now)
    if code == "not_finite":  # its sender is faulty: brake
        memory = replace(memory, velocity=ZERO, refusal=text)
        return memory, (Refuse(code), *((Send(ZERO),) if memory.holds else ()))
    if code:
        return replace(memory, refusal=text), (Refuse(code),)
    sender = _next(config, memory, wanted, now)
    late_ns = now.ros_ns - wanted.stamp_ns if wanted.stamp_ns else sender.lateness.now_ns
    memory = replace(memory, senders=_kept(memory.senders, sender))
    if late_ns > config.timeout_ns:
        text = f"a command came {late_ns / 1e6:.0f} ms late: {HELD}"
        return replace(memory, refusal=text), (Refuse("late"),)
    velocity = clamp(Velocity(linear_x=wanted.linear[0], linear_y=wanted.linear[1],
                              angular_z=wanted.angular[2]), limits)  # fmt: skip
    memory = replace(
        memory,
        velocity=velocity,
        last_ns=now.ns - max(0, late_ns),
        period_ns=_period_ns(config, sender),
        blocked="" if paused or velocity == ZERO else memory.blocked,
    )
    sideways = bool(wanted.linear[1]) and not limits.lateral_speed
    memory, actions = _obey(config, memory, now)
    return memory, (*actions, *((Refuse("sideways"),) if sideways else ()))


def observe(config: Config, memory: Memory, state: RobotState, now: Now) -> Step:
    """Process a state of the robot: repeat the command, brake, or give the body back."""
    silence = memory.silence.then(now.ns)
    memory = replace(memory, gate=state.gate, boot=state.boot, silence=silence)
    if state.gate.mode == "latched" and not _is_old(memory):
        memory = replace(memory, blocked=f"the robot was latched; {PAUSE}")
    since_ns = now.ns - memory.last_ns
    if memory.holds and not _mine(config, memory):
        return _lost(config, memory), ()
    if memory.silence.is_pause:
        blocked = memory.blocked if state.gate.mode == "latched" else ""
        memory = replace(memory, refusal="", blocked=blocked)
    if since_ns >= RELEASE_NS:
        return replace(memory, holds=False, velocity=ZERO), ()
    if not memory.holds:
        return memory, ()
    if since_ns <= memory.period_ns:
        return memory, (Send(memory.velocity),)
    return memory, ((Send(ZERO),) if since_ns > memory.period_ns + BRAKE_NS else ())


def answer(config: Config, memory: Memory, gate: GateStatus | None, text: str, now: Now) -> Step:
    """Process the gate's answer: `gate` if it grants the body, else None with `text`."""
    memory = replace(memory, asking=False)
    if gate is None:
        return replace(memory, refusal=text), ()
    live = now.ns - memory.last_ns < RELEASE_NS
    memory = replace(memory, granted=(memory.boot, gate.enables), holds=live, refusal="")
    fresh = now.ns - memory.last_ns <= memory.period_ns
    return memory, ((Send(memory.velocity if fresh else ZERO),) if live else ())


def forget(memory: Memory, why: str) -> Memory:
    """Stop commanding at once, as for an e-stop; the sender must pause first."""
    return replace(memory, holds=False, velocity=ZERO, blocked=f"{why}; {PAUSE}")


def silent(memory: Memory, now: Now) -> Step:
    """Process a command of ROS while the robot is silent, which ends a lease."""
    blocked = f"the robot was silent; {PAUSE}" if memory.holds else memory.blocked
    memory = replace(
        memory, gate=None, holds=False, velocity=ZERO, silence=Silence.broken(now.ns),
        blocked=blocked, refusal=NO_ROBOT,
    )  # fmt: skip
    return memory, (Refuse("no_robot"),)


def offsets_s(memory: Memory, now: Now) -> list[float]:
    """Return how far the clock of each present sender is behind ours, at most [s]."""
    least = (
        one.lateness.shortest_ns for one in memory.senders if now.ns - one.last_ns < RELEASE_NS
    )
    return [(ns + now.unix_ns - now.boot_ns) / 1e9 for ns in least if ns is not None]


def _obey(config: Config, memory: Memory, now: Now) -> Step:
    """Send the newest command, or ask for the body first."""
    gate = memory.gate
    if gate is None:
        return silent(memory, now)
    if memory.holds:
        return replace(memory, refusal=""), (Send(memory.velocity),)
    if memory.velocity == ZERO:
        return memory, ()
    if _mine(config, memory) and not memory.blocked:  # given back, and not taken since
        return replace(memory, holds=True, refusal=""), (Send(memory.velocity),)
    if text := _obstacle(config, memory, gate):
        return replace(memory, refusal=text), (Refuse("commander"),)
    if memory.asking or now.ns - memory.asked_ns < ASK_NS:
        return memory, ()
    return replace(memory, asking=True, asked_ns=now.ns), (Ask(config.take),)


def _obstacle(config: Config, memory: Memory, gate: GateStatus) -> str:
    """Return why it should not ask for the body now; empty if it may ask."""
    return memory.blocked or obstacle(gate, config.name, take=config.take)


def obstacle(gate: GateStatus, name: str, *, take: bool) -> str:
    """Return why the gate would refuse the body to the commander `name`; empty if it may grant."""
    if gate.commander not in ("", name) and not take:
        return f"{gate.commander} drives; end that first, or set `ros2: {{take: true}}`"
    if gate.mode == "latched":
        causes = "; ".join(cause.text for cause in gate.causes)
        return f"latched: {causes}; call the service release first"
    return ""


def _lost(config: Config, memory: Memory) -> Memory:
    """Record that a stop or another commander has ended the lease."""
    assert memory.gate
    why = lost(memory.gate, config.name)
    return replace(memory, holds=False, velocity=ZERO, blocked=f"{why}; {PAUSE}",
                   refusal=f"{why}; {PAUSE}")  # fmt: skip


def lost(gate: GateStatus, name: str) -> str:
    """Return why the lease of the commander `name` ended."""
    if gate.commander not in ("", name):
        return f"{gate.commander} has taken the body"
    causes = "; ".join(cause.text for cause in gate.causes)
    return f"the gate has stopped: {causes or gate.mode}"


def _mine(config: Config, memory: Memory) -> bool:
    gate = memory.gate
    mine = gate is not None and gate.mode == "enabled" and gate.commander == config.name
    return mine or _is_old(memory)


def _is_old(memory: Memory) -> bool:
    """Return whether the newest state is older than the last grant."""
    boot, enables = memory.granted
    return memory.gate is not None and memory.boot == boot and memory.gate.enables < enables


def _fault(config: Config, limits: Limits, wanted: Wanted, now: Now) -> tuple[str, str]:
    """Return code and text of a command's fault; empty if it has none."""
    if not all(math.isfinite(value) for value in (*wanted.linear, *wanted.angular)):
        return "not_finite", "a command holds NaN or infinity; repair the program that sends it"
    if not limits.linear_speed and any((*wanted.linear, *wanted.angular)):
        return "no_base", NO_BASE
    if wanted.frame.rpartition("/")[2] not in FRAMES:
        return "frame", f"a command is in frame {wanted.frame[:60]!r}; expected base_link"
    if wanted.stamp_ns:
        age_ns = now.ros_ns - wanted.stamp_ns
        if age_ns > config.timeout_ns:
            return "stale", f"a command's stamp is {age_ns / 1e9:.2f} s old; compare the clocks"
        if age_ns < -AHEAD_NS:
            text = f"a command's stamp is {-age_ns / 1e9:.2f} s ahead; compare the clocks"
            return "future", text
    return "", ""


def _next(config: Config, memory: Memory, wanted: Wanted, now: Now) -> Sender:
    """Return its sender's data, updated by this command."""
    known = next((one for one in memory.senders if one.id == wanted.sender), None)
    known = known or Sender(wanted.sender, now.ns - RELEASE_NS)
    last, number, period_ns = known.number, wanted.number, _period_ns(config, known)
    ordered = bool(wanted.sender) and (last is None or number is None or number >= last)
    sent_ns, before = wanted.sent_ns, known.lateness
    lateness = before.then(sent_ns, now.boot_ns, now.ns, period_ns, ordered=ordered)
    passed_ns = now.ns - known.last_ns
    intervals = (*known.intervals, passed_ns)[-INTERVALS:] if passed_ns < RELEASE_NS else ()
    return Sender(wanted.sender, now.ns, intervals, lateness, number)


def _kept(senders: tuple[Sender, ...], newest: Sender) -> tuple[Sender, ...]:
    others = tuple(one for one in senders if one.id != newest.id)
    return (*others, newest)[-MAX_SENDERS:]


def _period_ns(config: Config, sender: Sender) -> int:
    """Return how long a command counts: the median interval, or the timeout without one."""
    if not sender.intervals:
        return config.timeout_ns
    return min(config.timeout_ns, round(statistics.median(sender.intervals)))


def wanted_of(twist: Any, received: Received) -> Wanted:
    """Return a geometry_msgs/Twist as a command."""
    return Wanted(
        (twist.linear.x, twist.linear.y, twist.linear.z),
        (twist.angular.x, twist.angular.y, twist.angular.z),
        received.gid,
        sent_ns=received.source_ns,
        number=received.number,
    )
