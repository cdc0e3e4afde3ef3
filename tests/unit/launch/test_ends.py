"""`demo` and `up` end with the exit code and the reason of the process that they need."""

import asyncio
import errno
import os
from collections.abc import AsyncIterator, Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import OwnProcess
from gigabrain_zenoh.errors import BodyLost, BusError, ConfigError, GigabrainError
from gigabrain_zenoh.launch import demo as demo_module
from gigabrain_zenoh.launch import up as up_module
from gigabrain_zenoh.launch.demo import Demo, DemoOptions
from gigabrain_zenoh.launch.deployment import ROBOT, Deployment
from gigabrain_zenoh.launch.up import up
from gigabrain_zenoh.runtime.supervisor import Supervisor
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.ui.run_report import Observed, RunMonitor, make_report

DEPLOYMENT = Deployment(
    router="tcp/127.0.0.1:0",
    hosts={"robot": (*ROBOT, "page", "foxglove", "mine")},
    processes={"mine": OwnProcess(module="json")},
)


class Watch(RunMonitor):
    """A monitor at whose robot each look takes one second."""

    looks = 0

    def look(self) -> None:
        self.looks += 1

    @property
    def seconds(self) -> float:
        return float(self.looks)


@pytest.fixture(autouse=True)
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have runs write into `tmp_path`."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))


@pytest.fixture
def stop(monkeypatch: pytest.MonkeyPatch) -> asyncio.Event:
    """The event that a signal sets, in both commands."""
    event = asyncio.Event()
    for module in (demo_module, up_module):
        monkeypatch.setattr(module, "stop_signals", lambda _: nullcontext(event))
    return event


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch) -> Demo:
    """A demo of three seconds, whose processes are ready; none really runs."""
    monkeypatch.setattr(demo_module, "CHECK_S", 0.001)
    made = Demo(DEPLOYMENT, DemoOptions(headless=True, seconds=3.0))
    for status in made._supervisor.statuses.values():
        status.state = "ready"
    return made


@pytest.fixture
async def watch() -> AsyncIterator[Watch]:
    net = Net()
    yield Watch(net.one)
    await net.one.close()
    await net.two.close()


def give_up(supervisor: Supervisor, name: str, exit_code: int, error: str = "") -> None:
    """Have a supervisor give a process up, which has logged `error`."""
    status, on_record = supervisor.statuses[name], supervisor._shared.on_record
    if error:
        failed = {"process": name, "level": "error", "event": "failed", "text": error}
        on_record(name, {"t": 0, "value": f"value of {name}", **failed})
    status.state, status.last_exit = "given up", exit_code
    text = f"{name} ended with exit code {exit_code} and is given up"
    record = {"process": "supervisor", "level": "error", "event": "given up", "text": text}
    on_record(name, {"t": 0, **record})


def at_start(monkeypatch: pytest.MonkeyPatch, happens: Callable[[Supervisor], None]) -> None:
    """Have supervisors run nothing; this happens at their start."""

    async def run(supervisor: Supervisor) -> None:
        happens(supervisor)
        await supervisor._shared.halt.wait()

    monkeypatch.setattr(Supervisor, "run", run)


@pytest.fixture
def joined(demo: Demo, watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the demo watch a robot in memory."""

    async def join(_: asyncio.Event) -> Bus:
        return watch.bus

    monkeypatch.setattr(demo, "_join", join)
    monkeypatch.setattr(demo_module, "REPORT_TIMEOUT_S", 0.0)
    monkeypatch.setattr(demo_module, "RunMonitor", lambda _: watch)


def test_the_one_host_of_a_demo_may_have_any_name() -> None:
    made = Demo(Deployment(router="tcp/127.0.0.1:0", hosts={"lab": ROBOT}), DemoOptions())
    assert set(made._supervisor.statuses) == set(ROBOT)


def test_a_demo_of_several_hosts_is_refused_in_one_line() -> None:
    hosts = {"robot": ("router", "driver"), "brain": ("decision",)}
    with pytest.raises(ConfigError) as refused:
        Demo(Deployment(hosts=hosts), DemoOptions())
    expected = "hosts: a demo has one host, got robot, brain; run them with `gigabrain up`"
    assert str(refused.value) == expected


@pytest.mark.parametrize("exit_code", [1, 2])
@pytest.mark.parametrize("name", ["mine", "page", "foxglove"])
async def test_a_demo_goes_on_without_a_process_that_the_robot_does_not_need(
    demo: Demo, watch: Watch, name: str, exit_code: int
) -> None:
    give_up(demo._supervisor, name, exit_code)
    await demo._watch(watch, asyncio.Event())
    assert watch.seconds > 3.0


@pytest.mark.parametrize("name", ["router", "driver", "decision"])
async def test_a_demo_ends_without_a_process_that_the_robot_needs(
    demo: Demo, watch: Watch, name: str
) -> None:
    give_up(demo._supervisor, name, 1)
    await demo._watch(watch, asyncio.Event())
    assert watch.seconds == 1.0


async def test_a_demo_does_not_wait_for_space_on_the_disk_of_its_driver(
    demo: Demo, watch: Watch
) -> None:
    waits = {"process": "driver", "level": "warning", "text": "no space"}
    demo._record("driver", waits | {"event": "disk full"})
    await demo._watch(watch, asyncio.Event())
    assert (watch.seconds, demo._failure()) == (1.0, "no space")
    with pytest.raises(BodyLost, match=r"^no report: no space; logs in "):
        demo._finish(None, demo._failure(), stopped=False)


def test_a_report_that_cannot_be_written_is_still_printed(
    demo: Demo, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = Observed(
        body="mock",
        world="arena",
        seed=0,
        speed=1.0,
        seconds=3600.0,
        distance_m=700.0,
        decisions=(),
        turns=9,
        deaths=0,
        restarts=0,
        rejected=0,
    )
    demo._options = replace(demo._options, report=tmp_path / "gone" / "report.json")
    with pytest.raises(ConfigError, match=r"cannot write .*report\.json: no such file or folder"):
        demo._finish(make_report({}, seen), "", stopped=False)
    assert capsys.readouterr().out.startswith("ok: 700.00 m in 3600 s, 9 turns")


@pytest.mark.usefixtures("joined")
async def test_a_signal_after_a_demo_has_ended_does_not_hide_why(
    demo: Demo, watch: Watch, stop: asyncio.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def describe(*_: object) -> None:
        stop.set()

    at_start(monkeypatch, lambda supervisor: give_up(supervisor, "decision", 1))
    monkeypatch.setattr(watch, "describe", describe)
    with pytest.raises(BodyLost, match="decision ended with exit code 1 and is given up"):
        await demo.run()


@pytest.mark.usefixtures("joined")
async def test_a_demo_that_a_person_ends_is_not_judged_and_tells_what_failed(
    demo: Demo,
    stop: asyncio.Event,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def happens(supervisor: Supervisor) -> None:
        give_up(supervisor, "mine", 1)
        stop.set()

    at_start(monkeypatch, happens)
    assert await demo.run() == 0
    assert "mine ended with exit code 1 and is given up; logs in " in capfd.readouterr().err


async def test_a_signal_cuts_the_wait_for_the_truth_short(
    demo: Demo, watch: Watch, stop: asyncio.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo_module, "REPORT_TIMEOUT_S", 1000.0)
    asyncio.get_running_loop().call_later(0.01, stop.set)
    async with asyncio.timeout(60):
        assert await demo._make_report(watch, stop) is None


@pytest.mark.parametrize("name", ["decision", "router", "mine"])
async def test_up_ends_without_an_error_after_a_signal_whichever_process_was_given_up(
    name: str, stop: asyncio.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    def happens(supervisor: Supervisor) -> None:
        give_up(supervisor, name, 1)
        stop.set()

    at_start(monkeypatch, happens)
    await up(DEPLOYMENT, "robot", lambda _: None)


@pytest.mark.parametrize(
    ("names", "keys", "told"),
    [
        (("driver", "mine"), "blue", ["mine"]),
        (("router", "driver", "mine"), "blue", []),  # it knows the file
        (("driver",), "blue", []),
        (("driver", "mine"), "", []),  # and forbids nothing
    ],
)
async def test_up_names_processes_that_the_router_of_another_robot_may_not_know(
    stop: asyncio.Event,
    monkeypatch: pytest.MonkeyPatch,
    names: tuple[str, ...],
    keys: str,
    told: list[str],
) -> None:
    async def checked(*_: object) -> None:
        pass

    monkeypatch.setattr(up_module, "_check_keys", checked)
    at_start(monkeypatch, lambda _: stop.set())
    router = "tcp/127.0.0.1:7447"
    blue = {"namespace": "blue", "keys": keys, "router": router, "hosts": {"robot": names}}
    processes = DEPLOYMENT.processes if "mine" in names else {}
    lines: list[str] = []
    await up(replace(DEPLOYMENT, **blue, processes=processes), "robot", lines.append)
    assert [line for line in lines if line.startswith("warning: ")] == [
        f"warning: {name}: the router at {router} is not in this file, and drops "
        "their messages if it does not know them; declare them in its file too, or install their "
        "package on its host"
        for name in told
    ]


def needed_first(exit_code: int, name: str = "decision") -> Callable[[Supervisor], None]:
    """Return what gives up a process that the robot needs, and then one of its own."""

    def happens(supervisor: Supervisor) -> None:
        give_up(supervisor, name, exit_code, f"{name} lacks something")
        give_up(supervisor, "mine", 2, "mine has an unknown field")

    return happens


@pytest.mark.usefixtures("joined", "stop")
@pytest.mark.parametrize(
    ("exit_code", "kind", "text"),
    [(2, ConfigError, "^decision lacks something$"), (1, BodyLost, "decision ended with")],
)
async def test_a_demo_ends_with_the_error_of_the_process_that_ended_it(
    demo: Demo,
    monkeypatch: pytest.MonkeyPatch,
    exit_code: int,
    kind: type[GigabrainError],
    text: str,
) -> None:
    at_start(monkeypatch, needed_first(exit_code))
    with pytest.raises(kind, match=text):
        await demo.run()


@pytest.mark.usefixtures("stop")
async def test_up_ends_with_the_error_and_the_wrong_value_of_the_process_that_ended_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at_start(monkeypatch, needed_first(2))
    with pytest.raises(ConfigError, match=r"^decision lacks something$") as caught:
        await up(DEPLOYMENT, "robot", lambda _: None)
    assert caught.value.value == "value of decision"


@pytest.mark.usefixtures("stop")
async def test_up_does_not_explain_a_dead_router_by_what_another_process_lacks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def happens(supervisor: Supervisor) -> None:
        give_up(supervisor, "mine", 2, "mine has an unknown field")
        give_up(supervisor, "router", 1)

    at_start(monkeypatch, happens)
    with pytest.raises(BusError, match="router"):
        await up(DEPLOYMENT, "robot", lambda _: None)


@pytest.mark.usefixtures("stop")
async def test_up_prints_the_same_error_of_a_process_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def happens(supervisor: Supervisor) -> None:
        for name in ("mine", "page", "mine", "page"):
            give_up(supervisor, name, 1, f"{name} lacks something")
        give_up(supervisor, "router", 1)

    lines: list[str] = []
    at_start(monkeypatch, happens)
    with pytest.raises(BusError):
        await up(DEPLOYMENT, "robot", lines.append)
    assert sum("lacks something" in line for line in lines) == 2


@pytest.mark.parametrize("full", ["runs", "robots"])
async def test_up_waits_while_its_disk_is_full(
    stop: asyncio.Event, monkeypatch: pytest.MonkeyPatch, full: str
) -> None:
    mkdir, pauses, lines = Path.mkdir, list[float](), list[str]()

    def make(path: Path, *more: Any, **options: Any) -> None:
        if full in path.parts and len(pauses) < 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        mkdir(path, *more, **options)

    async def pause(seconds: float) -> None:
        pauses.append(seconds)

    monkeypatch.setattr(Path, "mkdir", make)
    monkeypatch.setattr(asyncio, "sleep", pause)
    at_start(monkeypatch, lambda _: stop.set())
    await up(DEPLOYMENT, "robot", lines.append)
    assert len(pauses) == 3
    assert lines[0].startswith("waiting for space on the disk: cannot write ")
    assert lines[0].endswith(": the disk is full; free some space")
    assert lines[1].startswith("turtlebot3_waffle on robot: ")


async def test_two_robots_of_one_body_need_a_namespace_of_their_own(
    stop: asyncio.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else both would replace the files of what the other remembers, such as its e-stop."""
    refused: list[str] = []

    async def another(deployment: Deployment, host: str = "robot") -> None:
        try:
            await up(deployment, host, lambda _: None)
        except ConfigError as error:
            refused.append(str(error))

    async def run(supervisor: Supervisor) -> None:
        monkeypatch.setattr(Supervisor, "run", lambda one: one._shared.halt.wait())
        stop.set()
        await another(DEPLOYMENT)
        await another(replace(DEPLOYMENT, namespace="red"))
        await another(replace(DEPLOYMENT, hosts={"a/b": ROBOT}), "a/b")
        await supervisor._shared.halt.wait()

    monkeypatch.setattr(Supervisor, "run", run)
    await up(DEPLOYMENT, "robot", lambda _: None)
    await another(DEPLOYMENT)  # once the first one has ended
    (text,) = refused
    assert text.startswith("a robot turtlebot3_waffle runs here already, with its state in ")
    assert text.endswith("; stop it, or give this one a `namespace` of its own")
    assert "\n" not in text
