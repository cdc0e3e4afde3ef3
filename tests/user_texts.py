"""All texts for users that can be rendered without a robot, and the README's table of commands.

`python -m tests.user_texts` writes both again after an intended change.
"""

import contextlib
import io
import os
import shlex
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from msgspec.structs import replace
from rich.console import Console

from gigabrain_drivers.driver import gatekeeper
from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, WorldModel
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import Description
from gigabrain_schemas.safety import Health, SafetyState, SpeedCaps
from gigabrain_schemas.tasks import Task, TaskStatus
from gigabrain_zenoh.cli import app
from gigabrain_zenoh.config import loading, renames
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.tasks import mission_files
from gigabrain_zenoh.diagnostics import doctor, why
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate import causes, gate
from gigabrain_zenoh.launch.deployment import deployment_type
from gigabrain_zenoh.safety import catalogue
from tests.places import ROOT
from tests.unit.gate.rig import HOT, Rig, driving, enabled, idle

GOLDEN = ROOT / "tests/data/user_texts.txt"
README = ROOT / "README.md"
BEGIN, END = "<!-- commands: made by `make golden` -->\n", "<!-- end of commands -->\n"
WIDTH = 100
WRONG_ARGUMENTS = ROOT / "tests/data/wrong_arguments.txt"
Deployment = deployment_type()
BAD_FILES: dict[str, tuple[Any, str]] = {
    "not YAML": (Deployment, "body: [mock"),
    "empty": (RobotFile, ""),
    "duplicate key": (Deployment, "body: mock\nbody: mock"),
    "not finite": (Deployment, "world: arena\nspeed: .nan"),
    "unknown field": (Deployment, "body: mock\nlnk: sim"),
    "wrong type": (Deployment, "seed: many"),
    "out of range": (Deployment, "body: mock\nspeed: 0"),
    "not a choice": (Deployment, "body: mock\nlink: serial"),
    "not a list": (Deployment, "hosts: {robot: driver}"),
    "unknown process": (Deployment, "hosts: {robot: [router, drivr]}"),
    "two drivers": (Deployment, "hosts:\n  a: [driver]\n  b: [driver]"),
    "no host": (Deployment, "hosts: {}"),
    "router beyond loopback": (Deployment, "body: mock\nrouter: tcp/0.0.0.0:7447"),
    "router without a port": (Deployment, "router: localhost"),
    "port 0 with several hosts": (
        Deployment,
        "hosts:\n  a: [router]\n  b: [driver]\nrouter: tcp/127.0.0.1:0",
    ),
    "auto resume of a real body": (Deployment, "link: real\nresume: auto"),
    "speed of a real body": (Deployment, "link: emulated\nspeed: 2"),
    "button in fast time": (Deployment, "speed: 2\nbutton: {port: /dev/ttyUSB0}"),
    "button without a port": (Deployment, "button:\n  port: ''"),
    "fleet without a namespace": (Deployment, "fleet: [red]"),
    "map without mapping": (Deployment, "perception: {map: office.yaml}"),
    "robot without fields": (RobotFile, "robot_type: red"),
    "robot with a wrong limit": (RobotFile, "robot_type: red\nmax_linear_speed: -1"),
}
BAD_MISSIONS = {
    "no steps": "do: []",
    "unknown step": "do:\n- gotoo: a",
    "unknown place": "places: {kitchen: [1, 2]}\ndo:\n- goto: kichen",
    "two things in one step": "do:\n- wait: 1\n  goto: [1, 2]",
    "step without content": "do:\n- explore:",
    "cycle": "trees:\n  a: [{tree: a}]\ndo: [{wait: 1}]",
    "bad condition": "do:\n- check: nonsense",
    "unknown field in a condition": "do:\n- wait_until: battery.percentag < 3",
    "number against word": "do:\n- check: pose.x == here",
}
GATEWAY = {  # as the process ros2 reports it
    "transport": "dds", "domain": 0, "node": "/gigabrain", "distro": "jazzy", "localhost": 1,
    "other_nodes": 0, "to_check": "check on the other nodes: ROS_DOMAIN_ID=0",
}  # fmt: skip
ROS_SHELL = {
    "ROS_DISTRO": "humble", "ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_zenoh_cpp",
    "ROS_LOCALHOST_ONLY": "1", "ROS_DISCOVERY_SERVER": "10.0.0.2:11811",
}  # fmt: skip
OLD_YAML = {
    "avoid": "turn linear_speed angular_speed speed_limit unknown samples begin scripts",
    "navigate": "turn linear_speed angular_speed speed_limit unknown samples begin scripts",
}
OLD_ARGUMENTS = (
    "demo --turn left",
    "decision --turn left",
    "decision --begin roam",
    "warm",
    "render --png x.png",
    "goto 1 2 --how queue",
    "explore --how queue",
    "patrol round.yaml --how queue",
    "mission evening.yaml --how queue",
    "decision --remember folder",
    "driver run mock --remember folder",
)


def render() -> str:
    """Return the content of the golden file."""
    parts: dict[str, Iterable[str]] = {
        "help": _helps(),
        "wrong arguments": _wrong_arguments(),
        "wrong YAML files": _wrong_files(),
        "wrong missions": _wrong_missions(),
        "old words": _old_words(),
        "causes of safety": _causes(catalogue.CAUSES.values()),
        "warnings of safety": _causes(catalogue.WARNINGS.values()),
        "causes of the gate and the driver": _causes(_gate_causes()),
        "answers of the gate": _gate_answers(),
        "findings of doctor": _doctor(),
        "findings of why": _why(),
    }
    return "\n".join(f"==== {title} ====\n\n" + "\n".join(lines) for title, lines in parts.items())


def _helps() -> Iterator[str]:
    commands = ["", *app.GROUPS, *app.COMMANDS]
    for command in commands:
        console = Console(width=WIDTH, file=io.StringIO(), color_system=None)
        words = command.split()
        app.make_app(words).help_print(words, console=console)
        text = console.file.getvalue()  # type: ignore[attr-defined]
        yield f"$ gigabrain {command} --help".replace("  ", " ")
        yield "\n".join(line.rstrip() for line in text.splitlines()) + "\n"


def _wrong_arguments() -> Iterator[str]:
    with _empty_home() as home:
        for line in WRONG_ARGUMENTS.read_text().splitlines():
            code, text = _call(shlex.split(line))
            yield f"$ gigabrain {line}\n{text.replace(str(home), '/home/ann')}[{code}]\n"


def _call(words: list[str]) -> tuple[object, str]:
    """Run a command in this process; return its exit code and its errors."""
    errors = io.StringIO()
    with (
        Path(os.devnull).open("w") as null,
        contextlib.redirect_stderr(errors),
        contextlib.redirect_stdout(null),
    ):
        code = app._call(words)
    return code, errors.getvalue()


@contextlib.contextmanager
def _empty_home() -> Iterator[Path]:
    """Stand in a folder with some files, and see no running robot."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        (folder / "folder").mkdir()
        (folder / "good.yaml").write_text("body: mock\n")
        (folder / "bad.yaml").write_text("body: mock\nlnk: sim\n")
        (folder / "round.yaml").write_text("points: [[1, 2]]\n")
        (folder / "binary.yaml").write_bytes(b"x\0\1")
        home, names = str(folder / "home"), ("STATE_HOME", "CONFIG_HOME", "RUNTIME_DIR")
        with (
            contextlib.chdir(folder),
            mock.patch.dict(os.environ, {f"XDG_{name}": home for name in names}),
            mock.patch("sys.stdin", io.StringIO()),
        ):
            yield folder


def _wrong_files() -> Iterator[str]:
    for title, (type_, text) in BAD_FILES.items():
        try:
            loading.loads(text, type_, "robot.yaml")
        except ConfigError as error:
            yield f"{title}: {error}"
    for name, settings in (("avoid", {"turn": "rihgt"}), ("navigate", {"samples": 1})):
        try:
            behaviours.check(DecisionConfig(behaviour=name, settings=settings))
        except ConfigError as error:
            yield f"settings of {name}: {error}"
    yield ""


def _wrong_missions() -> Iterator[str]:
    for title, text in BAD_MISSIONS.items():
        try:
            mission_files.loads(text, "evening.yaml")
        except ConfigError as error:
            yield f"{title}: {error}"
    yield ""


def _old_words() -> Iterator[str]:
    for behaviour, words in OLD_YAML.items():
        for word in words.split():
            with mock.patch.object(renames, "_printed", set()):
                errors = io.StringIO()
                value = "roam" if word == "begin" else "0"
                text = f"decision: {{behaviour: {behaviour}, {word}: {value}}}"
                with contextlib.redirect_stderr(errors), contextlib.suppress(ConfigError):
                    loading.loads(text, Deployment, "robot.yaml")
                yield f"{behaviour}: {errors.getvalue().strip()}"
    for arguments in OLD_ARGUMENTS:
        _, notices = renames.renamed_arguments(arguments.split())
        yield f"$ gigabrain {arguments}: {'; '.join(notices)}"
    yield ""


def _causes(found: Iterable[Cause]) -> Iterator[str]:
    for one in found:
        yield f"{one.code}{' (latching)' if one.latching else ''}: {one.text} -> {one.remedy}"
    yield ""


def _gate_causes() -> Iterator[Cause]:
    yield from (one for one in vars(causes).values() if isinstance(one, Cause))
    yield causes.button("the contact is open")
    yield causes.estop("ann")
    yield gatekeeper.UNREADABLE


def _gate_answers() -> Iterator[str]:
    for title, rig, event in (
        ("release, not latched", idle(), gate.Release(0)),
        ("release, old number", Rig(), gate.Release(7)),
        ("release, moving", Rig(), gate.Release(0)),
        ("release, too hot", _latched(enabled(), HOT), gate.Release(1)),
        ("release", _latched(idle()), gate.Release(1)),
        ("enable, no source", idle(), gate.Enable("")),
        ("enable, latched", Rig(), gate.Enable("control")),
        ("enable, stopping", _stopping(), gate.Enable("control")),
        ("enable, another drives", enabled("ann"), gate.Enable("bob")),
        ("enable, the brain takes", enabled("ann"), gate.Enable("control", take=True)),
        ("enable, no safety", _silent(idle()), gate.Enable("control")),
        ("enable", idle(), gate.Enable("control")),
        ("e-stop", driving(), gate.Estop("ann")),
    ):
        yield f"{title}: {rig.feed(event).text}"
    yield ""


def _latched(rig: Rig, *found: Cause) -> Rig:
    """Press the e-stop, with these causes of safety."""
    rig.feed(gate.Estop("ann"))
    rig.safety(*found, verdict="stop" if found else "ok")
    for _ in range(30):
        rig.tick()
        rig.safety(*found, verdict="stop" if found else "ok")
    return rig


def _stopping() -> Rig:
    rig = driving()
    rig.safety(Cause(code="scan_lost", text="no scan"), verdict="stop")
    rig.tick()
    return rig


def _silent(rig: Rig) -> Rig:
    for _ in range(20):
        rig.tick()
    return rig


def _doctor() -> Iterator[str]:
    machine = doctor.MachineFacts(
        python=(3, 10, 2),
        system="Linux",
        libraries={"numpy": None, "eclipse-zenoh": "1.9.9", "textual": None},
        folders=(
            doctor.Folder(path="/a", writable=False, free_mb=9000),
            doctor.Folder(path="/b", writable=True, free_mb=12),
        ),
        ports=(doctor.Port(path="/dev/ttyACM0", about="OpenCR", usb="0483:5740", usable=False),),
        multicast=True,
        certificate=doctor.Certificate(folder="keys/red", problem="red.crt expired on 2026-01-01"),
        shell=doctor.Shell(variables=ROS_SHELL, host="laptop"),
    )
    soon = doctor.Certificate(folder="keys/red", name="robot@red", days_left=12.0)
    health = replace(example(Health), process="driver", sent_hz={}, cpu=0.95)
    described = replace(example(Description), process="driver")
    robot = doctor.RobotFacts(
        router="tcp/127.0.0.1:7447",
        described={
            "driver": described,
            "safety": replace(described, process="safety", version="9"),
            "ros2": replace(described, process="ros2", host="burger", report=GATEWAY),
        },
        health={"driver": replace(health, rejected={"robot/cmd_vel": 3})},
        lead_ms={"waffle": 1800.0, "burger": -1800.0},
        pace=1.0,
    )
    gone = {"problem": "no router answers.", "router": "tcp/127.0.0.1:7447"}
    found = (
        *doctor.examine(machine, robot),
        *doctor.examine(replace(machine, certificate=soon), doctor.RobotFacts(**gone)),
        *doctor.examine(machine, doctor.RobotFacts(**gone, port_open=True)),
        *doctor.examine(machine, doctor.RobotFacts(problem="no robot runs here")),
    )
    bad = (one for one in found if one.grade != "ok")
    yield from dict.fromkeys(f"{one.grade} {one.about}: {one.text} -> {one.cure}" for one in bad)
    yield ""


def _moving() -> why.ChainFacts:
    """Return a chain that is whole, of a robot that should drive forward."""
    still = Velocity(linear_x=0.0, linear_y=0.0, angular_z=0.0)
    forward = replace(still, linear_x=0.2)
    gate = GateStatus(mode="enabled", commander="control")
    return why.ChainFacts(
        state=replace(example(RobotState), velocity=still, gate=gate),
        scan_age_ms=60.0,
        world=replace(example(WorldModel), scan_ok=True, obstacle_ahead=False),
        intent=replace(example(Intent), twist=forward, reason="forward 0.20 m/s"),
        command=replace(example(CmdVel), source="control", linear_x=0.2, angular_z=0.0),
        fastest=forward,
        safety=SafetyState(verdict="ok"),
    )


def _chains() -> dict[str, why.ChainFacts]:
    """Return chains of which each is broken, or rests, at another link."""
    good = _moving()
    state, world, command = good.state, good.world, good.command
    still, gate = state.velocity, state.gate
    tasks = replace(example(TaskStatus), current=None, drives=False, doing="waiting")
    task = Task(
        id="goal-1", kind="goal", label="1 2", source="ann", state="paused", reason="by ann"
    )
    rest = replace(good.intent, twist=still, reason="no path")
    lost_reason = f"waiting: {behaviours.WaitReason.NOT_LOCALIZED}"
    zone, lidar = catalogue.cause("zone_ahead"), catalogue.cause("scan_lost")
    blocked = SafetyState(verdict="ok", caps=SpeedCaps(forward=0.0), causes=(zone,))
    stop = SafetyState(verdict="stop", causes=(lidar,))
    lost = replace(state, link=replace(state.link, connected=False, age_ms=3000.0))
    silent = {name: example(Description) for name in ("driver", "perception")}
    return {
        "no router": why.ChainFacts(router="no router answers"),
        "no driver": replace(good, state=None),
        "driver silent": replace(good, state=None, described=silent),
        "link lost": replace(good, state=lost),
        "no scan": replace(good, scan_age_ms=None),
        "blind": replace(good, world=replace(world, scan_ok=False, scan_problem="all nan")),
        "no world": replace(good, world=None),
        "world silent": replace(good, world=None, described=silent),
        "starting": replace(good, intent=None, tasks=tasks, fastest=still),
        "no intent": replace(good, intent=None),
        "stands": replace(good, intent=rest, fastest=still),
        "lost": replace(good, intent=replace(rest, reason=lost_reason), fastest=still),
        "no goal": replace(good, intent=rest, tasks=tasks, fastest=still),
        "paused": replace(good, intent=rest, tasks=replace(tasks, current=task), fastest=still),
        "no command": replace(good, command=None),
        "operator": replace(good, command=replace(command, operator=True), fastest=still),
        "control stands": replace(good, fastest=still),
        "no safety": replace(good, safety=None),
        "safety stops": replace(good, safety=stop),
        "blocked": replace(good, safety=blocked),
        "latched": replace(
            good, state=replace(state, gate=GateStatus(mode="latched", causes=(causes.BOOT,)))
        ),
        "idle": replace(good, state=replace(state, gate=GateStatus(mode="idle"))),
        "ann stands": replace(
            good, state=replace(state, gate=replace(gate, commander="ann")), fastest=still
        ),
        "stuck": good,
        "strangers": replace(good, strangers=("eve",)),
    }


def _why() -> Iterator[str]:
    for title, facts in _chains().items():
        verdict = why.judge(facts)
        found = verdict.broken or verdict.waits
        text = f"{found.link}: {found.text} -> {found.remedy}" if found else "it moves"
        yield f"{title} [{verdict.exit_code}]: {'; '.join((text, *verdict.notes))}"
    yield ""


def with_commands(readme: str) -> str:
    """Return the README with a new table of commands: a row for each command or group."""
    rows = {}
    for command, (_, summary) in app.COMMANDS.items():
        group, _, name = command.rpartition(" ")
        if not group:
            rows[command] = (f"`gigabrain {command}`", summary)
        elif group in rows:
            names, about = rows[group]
            rows[group] = (f"{names}, `{name}`", about)
        else:
            rows[group] = (f"`gigabrain {group} {name}`", app.GROUPS[group])
    lines = "".join(f"| {names} | {about.removesuffix('.')} |\n" for names, about in rows.values())
    before, rest = readme.split(BEGIN)
    return f"{before}{BEGIN}| command | what it does |\n|---|---|\n{lines}{END}{rest.split(END)[1]}"


def main() -> None:
    """Write the golden file and the README's table."""
    GOLDEN.write_text(render())
    README.write_text(with_commands(README.read_text()))


if __name__ == "__main__":
    main()
