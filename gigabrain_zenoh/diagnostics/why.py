"""Why does it not move? Follows one command from link to link. Pure."""

from collections.abc import Callable
from typing import Literal, get_args

from msgspec import Struct

from gigabrain_schemas.base import Cause
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import CMD_VEL, INTENT, SCAN, STATE, WORLD
from gigabrain_zenoh.diagnostics.standing import leaves_nothing, stands
from gigabrain_zenoh.diagnostics.why_facts import Facts
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO
from gigabrain_zenoh.geometry.stopping import scan_limit_ns

Link = Literal[
    "router", "driver", "link", "scan", "world", "intent", "control", "safety", "gate", "body"
]
LINKS: tuple[Link, ...] = get_args(Link)
FIRST_CODE = 10  # the exit code where the router is what is broken; the next link's is the next


class Finding(Struct, frozen=True, kw_only=True):
    """One link."""

    link: Link
    ok: bool
    text: str  # a phrase for people
    remedy: str = ""
    waits: bool = False  # it works and stands: as it should where `ok`, else for the reason given


class Verdict(Struct, frozen=True, kw_only=True):
    """Every link as far as it can be judged, and what follows."""

    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def broken(self) -> Finding | None:
        """The first link that is broken; one that works and only waits comes after all others."""
        broken = [one for one in self.findings if not one.ok]
        return min(broken, key=lambda one: one.waits, default=None)

    @property
    def waits(self) -> Finding | None:
        """Where nothing is broken: the first link that stands as it should."""
        return None if self.broken else next((one for one in self.findings if one.waits), None)

    @property
    def moves(self) -> bool:
        """Whether the body moves."""
        body = self.findings[-1]
        return body.link == "body" and body.ok and not body.waits

    @property
    def exit_code(self) -> int:
        """0 where nothing is broken, else 10 for the router to 19 for the body itself."""
        return FIRST_CODE + LINKS.index(self.broken.link) if self.broken else 0


def judge(facts: Facts) -> Verdict:
    """Of what one look has found. Without a router or a state nothing behind them can be told."""
    if facts.router:
        return Verdict(findings=(_no("router", facts.router, ROUTER),))
    findings = [_ok("router", "answers")]
    for look in LOOKS:
        found = look(facts)
        findings.append(found)
        if found.link == "driver" and not found.ok:
            break
    return Verdict(findings=tuple(findings), notes=_notes(facts))


ROUTER = (
    "start the robot with `gigabrain up` or `gigabrain demo`, or name its router with --connect"
)


def _ok(link: Link, text: str) -> Finding:
    return Finding(link=link, ok=True, text=text)


def _waits(link: Link, text: str, remedy: str = "") -> Finding:
    return Finding(link=link, ok=True, text=text, remedy=remedy, waits=True)


def _no(link: Link, text: str, remedy: str) -> Finding:
    return Finding(link=link, ok=False, text=text, remedy=remedy)


def _silent(facts: Facts, link: Link, process: str, what: str) -> Finding:
    """A process from which nothing comes: is it gone, or is it only mute?"""
    look = f"read its log with `gigabrain log --process {process}`"
    if process in facts.there:
        return _no(link, f"{process} runs, but no {what} comes from it", look)
    start = f"start it (`gigabrain up` does), or end it if it hangs; {look}"
    return _no(link, f"{process} does not answer, and no {what} comes from it", start)


def _driver(facts: Facts) -> Finding:
    state = facts.state
    if state is None:
        return _silent(facts, "driver", "driver", "state")
    return _ok("driver", f"{state.robot_type}, state {facts.hz.get(STATE.key, 0):g} Hz")


def _link(facts: Facts) -> Finding:
    state = facts.state
    assert state
    line = state.link
    told = [cause for cause in state.gate.causes if cause.code == "link_lost"]
    if not line.connected or told:
        remedy = "look at the body's power, its cable or its network"
        return _no("link", f"the body has not answered for {line.age_ms / 1e3:.1f} s", remedy)
    return _ok("link", f"the body was heard {line.age_ms:.0f} ms ago")


def _scan(facts: Facts) -> Finding:
    body, age = facts.body, facts.scan_age_ms
    if body and body.description.lidar is None:
        return _ok("scan", "the body has no lidar")
    lidar = "look at the lidar's power and cable"
    if age is None:
        return _no("scan", "no scan has come", lidar)
    if body and age > scan_limit_ns(body.description) / 1e6:
        return _no("scan", f"the newest scan is {age / 1e3:.1f} s old", lidar)
    if facts.world and not facts.world.scan_ok:
        remedy = "clean and uncover the lidar, or move the robot to where it sees walls"
        return _no("scan", f"it cannot be believed: {facts.world.scan_problem}", remedy)
    return _ok("scan", f"{age:.0f} ms old, {facts.hz.get(SCAN.key, 0):g} Hz")


def _world(facts: Facts) -> Finding:
    world = facts.world
    if world is None:
        return _silent(facts, "world", "perception", "world")
    ahead = "free ahead"
    if world.obstacle_ahead:
        near = world.distance_ahead
        ahead = "something ahead" if near is None else f"obstacle {near:.2f} m ahead"
    return _ok("world", f"{ahead}{_after(facts, WORLD.key, 'the scan')}")


def _by_another(facts: Facts) -> str:
    """Who drives instead of the brain; empty where it is the brain, or nobody."""
    gate = facts.state.gate if facts.state else None
    other = gate is not None and gate.mode == "enabled" and gate.commander != BRAIN
    return gate.commander if gate and other else ""


def _intent(facts: Facts) -> Finding:
    intent, other = facts.intent, _by_another(facts)
    if other:
        return _ok("intent", f"not asked: {other} drives")
    if intent is None and facts.tasks:
        return _waits("intent", "decision is starting up", "wait until it is ready")
    if intent is None:
        return _silent(facts, "intent", "decision", "intent")
    if not _wants_to_move(facts):
        return _idle(facts.tasks) or Finding(
            link="intent", ok=False, waits=True,
            text=f"decision wants to stand: {intent.reason}",
            remedy="remove the cause; decision goes on by itself then",
        )  # fmt: skip
    return _ok("intent", f"{intent.reason}{_after(facts, INTENT.key, 'the world')}")


def _wants_to_move(facts: Facts) -> bool:
    twist = facts.intent.twist if facts.intent else None
    return twist is not None and not stands(twist)


def _idle(tasks: TaskStatus | None) -> Finding | None:
    """That there is nowhere to drive to now, where that is so."""
    if tasks is None:
        return None  # a behaviour that is not sent anywhere drives by itself
    task = tasks.current
    if task is None:
        return _waits("intent", "waiting for a goal", "send it one, as with `gigabrain goto 1 2`")
    if task.state == "paused":
        remedy = f"let it go on with `gigabrain task resume {task.id}`"
        return _waits("intent", f"{task.id} is paused: {task.reason}", remedy)
    if tasks.drives:
        return None
    return _waits("intent", f"{task.id}: {tasks.doing}", "it goes on by itself after that step")


def _control(facts: Facts) -> Finding:
    command, intent, other = facts.command, facts.intent, _by_another(facts)
    if other:
        return _ok("control", f"not asked: {other} drives")
    if command is None:
        return _silent(facts, "control", "control", "command")
    gate = facts.state.gate if facts.state else None
    still = gate is not None and gate.mode == "enabled" and stands(facts.fastest)
    if still and command.operator:
        text = "an operator holds the body"
        remedy = "hand the body back to decision with `gigabrain enable`"
        if _wants_to_move(facts):
            return _no("control", f"{text}; decision wants to move", remedy)
        return _waits("control", text, remedy)
    free = facts.safety is not None and facts.safety.verdict != "stop"
    caps = facts.safety.caps if facts.safety else NO_CAPS
    wants = intent.twist if intent and intent.twist else ZERO
    if still and free and not stands(wants) and not leaves_nothing(wants, caps):
        remedy = "read its log with `gigabrain log --process control`"
        return _no("control", "control sends zero although decision wants to move", remedy)
    who = "an operator drives: " if command.operator else ""
    return _ok(
        "control",
        f"{who}{command.linear_x:+.2f} m/s {command.angular_z:+.2f} rad/s"
        f"{_after(facts, CMD_VEL.key, 'the intent')}",
    )


def _safety(facts: Facts) -> Finding:
    said = facts.safety
    if said is None:
        return _silent(facts, "safety", "safety", "verdict")
    text, remedy = _told(said.causes)
    if said.verdict == "stop":
        return _no("safety", f"safety says stop: {text or 'no reason given'}", remedy or READ)
    wants = facts.intent.twist if facts.intent else None
    if wants and not _by_another(facts) and leaves_nothing(wants, said.caps):
        return _no("safety", f"safety lets it go no farther that way: {text}", remedy or READ)
    return _ok("safety", f"{said.verdict}{': ' if text else ''}{text}")


READ = "read its log with `gigabrain log --process safety`"


def _gate(facts: Facts) -> Finding:
    assert facts.state
    gate = facts.state.gate
    text, remedy = _told(gate.causes)
    if gate.mode == "latched":
        act = "`gigabrain release`, then `gigabrain enable`"
        return _no("gate", f"it is latched: {text}", f"{remedy}: {act}" if remedy else act)
    if gate.mode != "enabled":
        why = text or "nobody has enabled it"
        act = "enable it with `gigabrain enable`"
        return _no("gate", f"it is {gate.mode}: {why}", f"{remedy}; {act}" if remedy else act)
    if stands(facts.fastest) and gate.commander != BRAIN:
        remedy = "let it drive, or take the body back with `gigabrain enable --take`"
        return _no("gate", f"{gate.commander} has the body, and stands still", remedy)
    return _ok("gate", f"open for {gate.commander}")


def _body(facts: Facts) -> Finding:
    assert facts.state
    now, told = facts.state.velocity, facts.fastest
    if not facts.state.link.connected:
        return _no("body", "how fast it moves is not known", "mend its link first")
    speed = f"{now.linear_x:+.2f} m/s {now.angular_z:+.2f} rad/s"
    if stands(now) and not stands(told):
        remedy = "see whether something holds it, at its motors, and whether its power is on"
        wanted = f"{told.linear_x:+.2f} m/s {told.angular_z:+.2f} rad/s"
        return _no("body", f"the body stands although it is told {wanted}", remedy)
    if stands(now):
        return _waits("body", "it stands, as it is told", "send it a command or a goal")
    return _ok("body", f"it moves: {speed}")


LOOKS: tuple[Callable[[Facts], Finding], ...] = (
    _driver, _link, _scan, _world, _intent, _control, _safety, _gate, _body,
)  # fmt: skip


def _after(facts: Facts, key: str, before: str) -> str:
    value = facts.after_ms.get(key)
    return "" if value is None else f", {value:.1f} ms after {before}"


def _told(causes: tuple[Cause, ...]) -> tuple[str, str]:
    """What holds it back, and what to do about it."""
    text = "; ".join(cause.text for cause in causes)
    return text, "; ".join(dict.fromkeys(cause.remedy for cause in causes if cause.remedy))


def _notes(facts: Facts) -> tuple[str, ...]:
    notes = []
    if facts.strangers:
        names = ", ".join(facts.strangers)
        notes.append(f"{names} sends commands as well, which the gate does not obey")
    warnings = facts.safety.warnings if facts.safety else ()
    notes += [f"warning: {one.text} ({one.remedy})" for one in (*warnings, *facts.problems)]
    return tuple(notes)
