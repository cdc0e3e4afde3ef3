"""`gigabrain why`: checks the chain from router to body, and finds the link that stops the robot.

`ChainWatcher` collects the facts; `judge` is pure, and returns the verdict.
"""

import asyncio
import itertools
from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

from msgspec import Struct

from gigabrain_schemas.base import Cause, Message, Velocity
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, JointCommand, WorldModel
from gigabrain_schemas.requests import Description
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import (
    CMD_VEL,
    INTENT,
    JOINT_CMD,
    SCAN,
    STATE,
    WORLD,
    Topic,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.decision.behaviours import WaitReason
from gigabrain_zenoh.diagnostics.discovery import discover
from gigabrain_zenoh.diagnostics.robot_view import RobotView
from gigabrain_zenoh.diagnostics.topic_stats import HOPS, ChainMonitor, monitor_chain
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO, at_rest
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.perception import FIND_IT

Link = Literal[
    "router", "driver", "link", "scan", "world", "intent", "control", "safety", "gate", "body"
]
LINKS: tuple[Link, ...] = get_args(Link)
FIRST_CODE = 10  # exit code for a broken router; each further link has the next code
WINDOW_S = 1.5
SILENT_NS = 500_000_000  # wall time, also in a slow simulation

START_ROUTER = (
    "start the robot with `gigabrain up` or `gigabrain demo`, or name its router with --connect"
)
READ_SAFETY_LOG = "read its log with `gigabrain log --process safety`"
GOES_ON = "remove the cause; decision then continues by itself"
BY_HAND = "move it with `gigabrain teleop` or `gigabrain arm jog`"
CHECK_LIDAR = "check the lidar's power and cable"


class ChainFacts(Struct, frozen=True, kw_only=True):
    """State of the chain. Messages are None if they did not arrive or are stale."""

    router: str = ""  # reason why it cannot be reached; empty if it answers
    described: Mapping[str, Description] = {}  # processes that reply, by name
    state: RobotState | None = None
    body: Body | None = None
    scan_age_ms: float | None = None  # by the robot's clock
    world: WorldModel | None = None
    intent: Intent | None = None
    command: CmdVel | None = None  # from the robot's own control
    joint_command: JointCommand | None = None  # from the robot's own control
    fastest: Velocity = ZERO  # largest of the commander's commands, per axis
    strangers: tuple[str, ...] = ()  # other senders of commands
    safety: SafetyState | None = None
    tasks: TaskStatus | None = None  # None if decision has no tasks
    problems: tuple[Cause, ...] = ()  # in the health of processes
    hz: Mapping[str, float] = {}  # measured, by key
    after_ms: Mapping[str, float] = {}  # median time since the previous hop, by key


class LinkStatus(Struct, frozen=True, kw_only=True):
    """Status of one link of the chain."""

    link: Link
    ok: bool
    text: str
    remedy: str = ""
    waits: bool = False  # works, but the robot stands: as intended if `ok`


class Verdict(Struct, frozen=True, kw_only=True):
    """Status of every link that can be checked, and the conclusion."""

    findings: tuple[LinkStatus, ...]
    notes: tuple[str, ...] = ()

    @property
    def broken(self) -> LinkStatus | None:
        """Return the first broken link; links that only wait come last."""
        broken = [status for status in self.findings if not status.ok]
        return min(broken, key=lambda status: status.waits, default=None)

    @property
    def waits(self) -> LinkStatus | None:
        """Return the first link that waits as intended, if none is broken."""
        waiting = (status for status in self.findings if status.waits)
        return None if self.broken else next(waiting, None)

    @property
    def moves(self) -> bool:
        """Return whether the body moves."""
        body = self.findings[-1]
        return body.link == "body" and body.ok and not body.waits

    @property
    def exit_code(self) -> int:
        """Return 0 if no link is broken, else 10 (router) to 19 (body)."""
        return FIRST_CODE + LINKS.index(self.broken.link) if self.broken else 0


def judge(facts: ChainFacts) -> Verdict:
    """Return the verdict on `facts`. After a broken router or driver no link can be checked."""
    if facts.router:
        return Verdict(findings=(_broken("router", facts.router, START_ROUTER),))
    findings = [_ok("router", "answers")]
    for check in CHECKS:
        found = check(facts)
        findings.append(found)
        if found.link == "driver" and not found.ok:
            break
    return Verdict(findings=tuple(findings), notes=_notes(facts))


def _ok(link: Link, text: str) -> LinkStatus:
    return LinkStatus(link=link, ok=True, text=text)


def _waits(link: Link, text: str, remedy: str = "") -> LinkStatus:
    return LinkStatus(link=link, ok=True, text=text, remedy=remedy, waits=True)


def _broken(link: Link, text: str, remedy: str) -> LinkStatus:
    return LinkStatus(link=link, ok=False, text=text, remedy=remedy)


def _silent(facts: ChainFacts, link: Link, process: str, what: str) -> LinkStatus:
    """Return the status of a process that sends nothing."""
    read_log = f"read its log with `gigabrain log --process {process}`"
    if process in facts.described:
        return _broken(link, f"{process} runs, but sends no {what}", read_log)
    start = f"start it (`gigabrain up` does), or end it if it hangs; {read_log}"
    return _broken(link, f"{process} does not answer, and sends no {what}", start)


def _driver(facts: ChainFacts) -> LinkStatus:
    state = facts.state
    if state is None:
        return _silent(facts, "driver", "driver", "state")
    return _ok("driver", f"{state.robot_type}, state {facts.hz.get(STATE.key, 0):g} Hz")


def _link(facts: ChainFacts) -> LinkStatus:
    state = facts.state
    assert state
    lost = any(cause.code == "link_lost" for cause in state.gate.causes)
    if lost or not state.link.connected:
        text = f"no answer from the body for {state.link.age_ms / 1e3:.1f} s"
        return _broken("link", text, "check the body's power, its cable or its network")
    return _ok("link", f"the body answered {state.link.age_ms:.0f} ms ago")


def _scan(facts: ChainFacts) -> LinkStatus:
    body, age_ms = facts.body, facts.scan_age_ms
    if body and body.description.lidar is None:
        return _ok("scan", "the body has no lidar")
    if age_ms is None:
        return _broken("scan", "no scan has arrived", CHECK_LIDAR)
    if body and age_ms > scan_limit_ns(body.description) / 1e6:
        return _broken("scan", f"the newest scan is {age_ms / 1e3:.1f} s old", CHECK_LIDAR)
    if facts.world and not facts.world.scan_ok:
        remedy = "clean and uncover the lidar, or move the robot to where it sees walls"
        return _broken("scan", f"not plausible: {facts.world.scan_problem}", remedy)
    return _ok("scan", f"{age_ms:.0f} ms old, {facts.hz.get(SCAN.key, 0):g} Hz")


def _world(facts: ChainFacts) -> LinkStatus:
    world = facts.world
    if _fixed(facts) and facts.body and facts.body.description.lidar is None:
        return _ok("world", "not needed: the body has no lidar, and no base to drive")
    if world is None:
        return _silent(facts, "world", "perception", "world")
    ahead = "free ahead"
    if world.obstacle_ahead:
        near = world.distance_ahead
        ahead = "obstacle ahead" if near is None else f"obstacle {near:.2f} m ahead"
    return _ok("world", f"{ahead}{_after(facts, WORLD.key, 'the scan')}")


def _fixed(facts: ChainFacts) -> bool:
    return facts.body is not None and not facts.body.description.has_base


def _other_commander(facts: ChainFacts) -> str:
    """Return the commander that drives instead of the brain; empty if the brain drives."""
    gate = facts.state.gate if facts.state else None
    other = gate is not None and gate.mode == "enabled" and gate.commander != BRAIN
    return gate.commander if gate and other else ""


def _intent(facts: ChainFacts) -> LinkStatus:
    intent, other = facts.intent, _other_commander(facts)
    if other:
        return _ok("intent", f"not used: {other} drives")
    if intent is None and facts.tasks:
        return _waits("intent", "decision is starting up", "wait until it is ready")
    if intent is None:
        return _silent(facts, "intent", "decision", "intent")
    if _fixed(facts):
        wants = intent.joints or intent.joint_trajectory
        return _ok("intent", intent.reason) if wants else _waits("intent", intent.reason, BY_HAND)
    if not _wants_to_move(facts):
        return _idle(facts.tasks) or LinkStatus(
            link="intent",
            ok=False,
            waits=True,
            text=f"decision does not drive: {intent.reason}",
            remedy=FIND_IT if WaitReason.NOT_LOCALIZED in intent.reason else GOES_ON,
        )
    is_car = facts.body is not None and facts.body.description.turning_radius > 0.0
    if is_car and intent.twist and at_rest(Velocity(linear_x=intent.twist.linear_x)):
        text = f"{intent.reason}, but the body cannot turn on the spot"
        return _broken("intent", text, "use a behaviour that plans its turns, such as `navigate`")
    return _ok("intent", f"{intent.reason}{_after(facts, INTENT.key, 'the world')}")


def _wants_to_move(facts: ChainFacts) -> bool:
    twist = facts.intent.twist if facts.intent else None
    return twist is not None and not at_rest(twist)


def _idle(tasks: TaskStatus | None) -> LinkStatus | None:
    """Return the status if there is no goal to drive to now; else None."""
    if tasks is None:
        return None  # a behaviour without tasks drives without a goal
    task = tasks.current
    if task is None:
        return _waits("intent", "waiting for a goal", "send a goal, as in `gigabrain goto 1 2`")
    if task.state == "paused":
        remedy = f"resume it with `gigabrain task resume {task.id}`"
        return _waits("intent", f"{task.id} is paused: {task.reason}", remedy)
    if tasks.drives:
        return None
    return _waits("intent", f"{task.id}: {tasks.doing}", "it continues by itself after that step")


def _control(facts: ChainFacts) -> LinkStatus:
    command, intent, other = facts.command, facts.intent, _other_commander(facts)
    if other:
        return _ok("control", f"not used: {other} drives")
    if _fixed(facts) and facts.joint_command:
        by = "an operator moves joints" if facts.joint_command.operator else "it commands joints"
        return _ok("control", by)
    if command is None:
        return _silent(facts, "control", "control", "command")
    gate = facts.state.gate if facts.state else None
    zero_sent = gate is not None and gate.mode == "enabled" and at_rest(facts.fastest)
    if zero_sent and command.operator:
        text = "an operator holds the robot still"
        remedy = "let the brain drive with `gigabrain enable`"
        if _wants_to_move(facts):
            return _broken("control", f"{text}, but decision sends motion", remedy)
        return _waits("control", text, remedy)
    free = facts.safety is not None and facts.safety.verdict != "stop"
    caps = facts.safety.caps if facts.safety else NO_CAPS
    wanted = intent.twist if intent and intent.twist else ZERO
    if zero_sent and free and not at_rest(wanted) and not _capped_to_rest(wanted, caps):
        remedy = "read its log with `gigabrain log --process control`"
        return _broken("control", "control sends zero, but decision sends motion", remedy)
    operator = "an operator drives: " if command.operator else ""
    return _ok(
        "control",
        f"{operator}{command.linear_x:+.2f} m/s {command.angular_z:+.2f} rad/s"
        f"{_after(facts, CMD_VEL.key, 'the intent')}",
    )


def _safety(facts: ChainFacts) -> LinkStatus:
    safety = facts.safety
    if safety is None:
        return _silent(facts, "safety", "safety", "verdict")
    text, remedy = _in_words(safety.causes)
    if safety.verdict == "stop":
        text = f"safety stops the robot: {text or 'no reason given'}"
        return _broken("safety", text, remedy or READ_SAFETY_LOG)
    wanted = facts.intent.twist if facts.intent else None
    if wanted and not _other_commander(facts) and _capped_to_rest(wanted, safety.caps):
        text = f"safety blocks the commanded direction: {text}"
        return _broken("safety", text, remedy or READ_SAFETY_LOG)
    return _ok("safety", f"{safety.verdict}{': ' if text else ''}{text}")


def _gate(facts: ChainFacts) -> LinkStatus:
    assert facts.state
    gate = facts.state.gate
    text, remedy = _in_words(gate.causes)
    if gate.mode == "latched":
        act = "`gigabrain release`, then `gigabrain enable`"
        return _broken("gate", f"latched: {text}", f"{remedy}: {act}" if remedy else act)
    if gate.mode != "enabled":
        act = "enable it with `gigabrain enable`"
        text = f"{gate.mode}: {text or 'not enabled yet'}"
        return _broken("gate", text, f"{remedy}; {act}" if remedy else act)
    if at_rest(facts.fastest) and gate.commander != BRAIN:
        remedy = "have it send commands, or take the robot back with `gigabrain enable --take`"
        return _broken("gate", f"{gate.commander} drives, but sends no motion", remedy)
    return _ok("gate", f"open for {gate.commander}")


def _body(facts: ChainFacts) -> LinkStatus:
    assert facts.state
    now, commanded = facts.state.velocity, facts.fastest
    if not facts.state.link.connected:
        return _broken("body", "its speed is unknown", "repair its link first")
    speed = f"{now.linear_x:+.2f} m/s {now.angular_z:+.2f} rad/s"
    if at_rest(now) and not at_rest(commanded):
        wanted = f"{commanded.linear_x:+.2f} m/s {commanded.angular_z:+.2f} rad/s"
        remedy = "check whether something blocks it, then its motors and their power"
        return _broken("body", f"no motion, but the command is {wanted}", remedy)
    if at_rest(now):
        return _waits("body", "it stands, as commanded", "send it a command or a goal")
    return _ok("body", f"it moves: {speed}")


CHECKS: tuple[Callable[[ChainFacts], LinkStatus], ...] = (
    _driver, _link, _scan, _world, _intent, _control, _safety, _gate, _body,
)  # fmt: skip


def _after(facts: ChainFacts, key: str, before: str) -> str:
    value = facts.after_ms.get(key)
    return "" if value is None else f", {value:.1f} ms after {before}"


def _in_words(causes: tuple[Cause, ...]) -> tuple[str, str]:
    """Return the joined texts and the joined remedies of causes."""
    text = "; ".join(cause.text for cause in causes)
    return text, "; ".join(dict.fromkeys(cause.remedy for cause in causes if cause.remedy))


def _notes(facts: ChainFacts) -> tuple[str, ...]:
    notes = []
    if facts.strangers:
        names = ", ".join(facts.strangers)
        notes.append(f"the gate ignores further commands, from: {names}")
    warnings = facts.safety.warnings if facts.safety else ()
    notes += [f"warning: {cause.text} ({cause.remedy})" for cause in (*warnings, *facts.problems)]
    return tuple(notes)


def _capped_to_rest(wanted: Velocity, caps: SpeedCaps) -> bool:
    """Return whether the caps of safety reduce a wanted motion to zero."""
    axes = (
        (wanted.linear_x, caps.forward, caps.backward),
        (wanted.linear_y, caps.left, caps.right),
        (wanted.angular_z, _lower(caps.turn_left, caps), _lower(caps.turn_right, caps)),
    )
    capped = []
    for value, positive, negative in axes:
        cap = positive if value > 0 else negative
        capped.append(value if cap is None else max(-cap, min(cap, value)))
    x, y, turn = capped
    return not at_rest(wanted) and at_rest(Velocity(linear_x=x, linear_y=y, angular_z=turn))


def _lower(side: float | None, caps: SpeedCaps) -> float | None:
    return min((cap for cap in (side, caps.rotation) if cap is not None), default=None)


class ChainWatcher(RobotView):
    """Subscribes to the whole chain, and collects its facts."""

    def __init__(self, bus: Bus) -> None:
        self._commands: dict[str, list[tuple[int, CmdVel]]] = {}  # with arrival [ns], by sender
        self._joint_commands = bus.latest(JOINT_CMD)
        super().__init__(bus)
        self._monitor = monitor_chain(bus)
        bus.subscribe(CMD_VEL, self._add_command)

    def on_rare(self, topic: Topic[Any], message: Message) -> None:
        """Subscribe to the control topic of a body that has its own."""
        if isinstance(message, Body):
            control_topic = command_topic(message.description)
            if control_topic.key not in self.bus.listens:
                self.bus.subscribe(control_topic, self._add_command)

    def _add_command(self, _key: str, command: CmdVel) -> None:
        commands = self._commands.setdefault(command.source, [])
        commands.append((self.bus.clock.now_ns(), command))

    async def collect(self, seconds: float = WINDOW_S) -> ChainFacts:
        """Return the facts after `seconds`."""
        bus = self.bus
        start_ns, counts = bus.clock.now_ns(), bus.received.copy()
        described, _ = await asyncio.gather(discover(bus), bus.clock.sleep_ns(round(seconds * 1e9)))
        state = self.state.fresh()
        elapsed_s = (bus.clock.now_ns() - start_ns) / 1e9
        commander = state.gate.commander if state else ""
        scan_ns, joints = self.scan.age_ns(), self._joint_commands.fresh()
        return ChainFacts(
            described=described,
            state=state,
            body=self.body,
            scan_age_ms=None if scan_ns is None else scan_ns / 1e6,
            world=self.world.fresh(),
            intent=self.intent.fresh(),
            command=self._newest(BRAIN),
            joint_command=joints if joints and joints.source == BRAIN else None,
            fastest=_fastest([command for _, command in self._commands.get(commander, [])]),
            strangers=tuple(sorted(set(self._commands) - {BRAIN, commander})),
            safety=self.safety.fresh(),
            tasks=self.task.fresh(),
            problems=tuple(cause for health in self.health.values() for cause in health.problems),
            hz={
                key: round((bus.received[key] - counts[key]) / 2 / elapsed_s, 1)
                for key in (STATE.key, SCAN.key)  # counted twice: the monitor receives them too
            },
            after_ms=_latencies(self._monitor),
        )

    def _newest(self, source: str) -> CmdVel | None:
        """Return the newest command of `source`; None if `source` is silent now."""
        commands = self._commands.get(source)
        if not commands or self.bus.clock.now_ns() - commands[-1][0] > SILENT_NS:
            return None
        return commands[-1][1]


def _latencies(monitor: ChainMonitor) -> dict[str, float]:
    if not monitor.complete:
        return {}
    return {after.key: monitor.between(before, after) for before, after in itertools.pairwise(HOPS)}


def _fastest(commands: list[CmdVel]) -> Velocity:
    return Velocity(
        linear_x=max((c.linear_x for c in commands), key=abs, default=0.0),
        linear_y=max((c.linear_y for c in commands), key=abs, default=0.0),
        angular_z=max((c.angular_z for c in commands), key=abs, default=0.0),
    )
