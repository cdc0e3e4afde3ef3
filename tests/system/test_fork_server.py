"""Processes started by a fork server behave like those started directly."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from gigabrain_zenoh.cli import app
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.processes import PROCESSES
from gigabrain_zenoh.launch.specs import SHARED, process_specs
from gigabrain_zenoh.runtime import forking
from gigabrain_zenoh.runtime.supervisor import Supervisor
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT
from tests.system.children import (
    PARENT,
    SERVE,
    alive,
    another_supervisor,
    forked,
    freeze,
    running,
    spec,
)

pytestmark = pytest.mark.skipif(not forking.works_here(), reason="Linux alone has pidfds")
NEVER = (("tests.system.never_imported",),)


@pytest.fixture(autouse=True)
def path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    yield
    forking.end_early()  # in case the test failed


def servers() -> list[psutil.Process]:
    """Return the first-level fork servers that this process started."""
    return [one for one in psutil.Process().children() if "fork_server" in " ".join(one.cmdline())]


async def until_ready(supervisor: Supervisor) -> None:
    await until(lambda: all(one.state == "ready" for one in supervisor.statuses.values()))


async def test_a_fork_is_a_child_of_its_supervisor_and_the_servers_exit() -> None:
    async with running(forked("one"), forked("two"), spec("three")) as (supervisor, records):
        await until_ready(supervisor)
        one, two, three = (psutil.Process(s.pid) for s in supervisor.statuses.values())
        assert [one.cmdline()[0], two.cmdline()[0]] == ["forked one", "forked two"]
        assert {one.ppid(), two.ppid(), three.ppid()} == {os.getpid()}
        assert os.getsid(one.pid) == os.getpgid(one.pid) == one.pid
        assert not servers()
        assert not records.texts("fork server")
        own = one.memory_full_info().uss
        assert own < 0.5 * one.memory_info().rss  # the rest is shared


async def test_several_supervisors_of_one_process_fork_at_once() -> None:
    specs = [(forked("one"), forked("two"), forked("three")) for _ in range(4)]
    async with contextlib.AsyncExitStack() as stack:
        robots = [await stack.enter_async_context(running(*one)) for one in specs]
        for supervisor, records in robots:
            await until_ready(supervisor)
            assert not records.texts("fork server")


async def test_a_dead_fork_is_restarted_without_a_server() -> None:
    async with running(forked("one"), forked("two")) as (supervisor, records):
        status = supervisor.statuses["one"]
        await until_ready(supervisor)
        first = status.pid
        os.kill(first or 0, signal.SIGKILL)
        await until(lambda: status.restarts == 1 and status.state == "ready")
        assert (status.last_exit, supervisor.deaths) == (-9, 1)
        assert psutil.Process(status.pid).cmdline()[0] == sys.executable
        assert records.texts("died") == ["one ended with signal 9 (Killed); next start in 0.01 s"]


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("sys.exit(7)", "one ended with exit code 7; next start in 0.01 s"),
        ("print('x' * 99_999); raise ValueError", "one ended with exit code 1; next start in"),
        ("pass", "one ended with exit code 0; next start in 0.01 s"),
    ],
)
async def test_the_exit_of_a_fork_is_reported_with_its_output(code: str, text: str) -> None:
    async with running(forked("one", code), forked("two")) as (_, records):
        await until(lambda: records.texts("died"))
        assert records.texts("died")[0].startswith(text)
        output = "".join(records.texts("output"))
        assert output.count("x") >= 99_999 * ("print" in code)
        assert ("ValueError" in output) == ("raise" in code)


async def test_a_fork_starts_after_the_processes_it_depends_on() -> None:
    async with running(forked("one", SERVE, "two"), forked("two"), forked("three")) as running_now:
        supervisor, records = running_now
        await until_ready(supervisor)
        order = records.events()
        assert order.index(("two", "ready")) < order.index(("one", "ready"))


async def kill_server(server: psutil.Process) -> None:
    server.kill()


async def freeze_server(server: psutil.Process) -> None:
    await freeze(server.pid)


async def leave_alone(server: psutil.Process) -> None:
    del server


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (kill_server, "has ended"),
        (freeze_server, "does not answer"),
        (leave_alone, "does not answer"),
    ],
)
async def test_with_a_failing_server_processes_are_started_directly(
    fault: Callable[[psutil.Process], object], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server's import never ends, so it is given up after a while."""
    if fault is leave_alone:
        monkeypatch.setattr(forking, "IMPORT_TIMEOUT_S", 0.2)
        monkeypatch.setattr(forking, "STOPPED_CHECK_S", 0.1)
    specs = forked("one", imports=NEVER), forked("two", imports=NEVER)
    async with running(*specs) as (supervisor, records):
        await until(servers)
        await fault(servers()[0])  # type: ignore[misc]
        await until_ready(supervisor)
        warnings = [f"the fork server {why}; processes start without it, with more memory"]
        assert records.texts("fork server") == warnings
        assert supervisor.deaths == 0
        assert not servers()


async def test_if_no_server_can_start_processes_are_started_directly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(forking, "COMMAND", ("/nowhere/python",))
    async with running(forked("one"), forked("two")) as (supervisor, records):
        await until_ready(supervisor)
        (warning,) = records.texts("fork server")
        assert warning.startswith("the fork server cannot be started ([Errno 2] No such file")
        assert supervisor.deaths == 0


async def test_a_stop_does_not_wait_for_an_importing_server() -> None:
    specs = forked("one", imports=NEVER), forked("two", imports=NEVER)
    async with running(*specs):
        await until(servers)
    assert not servers()


async def test_a_supervisor_uses_a_server_that_was_started_early() -> None:
    forking.start_early("tests.system.children")
    (early,) = servers()
    async with running(forked("one"), forked("two")) as (supervisor, records):
        await until_ready(supervisor)
        assert psutil.Process(supervisor.statuses["one"].pid).cmdline()[0] == "forked one"
        assert not servers()
        assert not records.texts("fork server")
    assert not early.is_running()


async def test_an_unused_early_server_is_ended() -> None:
    forking.start_early()
    assert servers()
    async with running(forked("one"), spec("two")) as (supervisor, _):
        assert not servers()
        await until_ready(supervisor)


async def test_after_the_death_of_the_early_server_processes_are_started_directly() -> None:
    forking.start_early()
    (early,) = servers()
    early.kill()
    early.wait()
    async with running(forked("one"), forked("two")) as (supervisor, records):
        await until_ready(supervisor)
        assert len(records.texts("fork server")) == 1
        assert supervisor.deaths == 0


LEAVES_EARLY_SERVER = """
from gigabrain_zenoh.runtime import forking
forking.start_early("time")
print(forking._early[0][0].pid)
"""


def test_an_early_server_ends_with_the_command_that_started_it() -> None:
    pid = subprocess.check_output((sys.executable, "-c", LEAVES_EARLY_SERVER), text=True)
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(int(pid)).wait(timeout=10)


@pytest.mark.parametrize(
    ("words", "started"),
    [
        (["up", "nowhere.yaml"], [SHARED]),
        (["demo", "--seconds", "-1"], [SHARED]),
        (["up", "--help"], []),
        (["robots", "--nothing"], []),
        ([], []),
    ],
)
def test_commands_that_run_a_robot_start_a_server_early(
    words: list[str], started: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    early: list[str] = []
    monkeypatch.setattr(forking, "start_early", early.append)
    app._call(words)
    assert early == started


def all_forked(parent: str) -> str:
    """Return the supervisor program changed so that a fork server starts its processes."""
    made = parent.replace("specs = [", "from tests.system.children import forked\nspecs = [")
    made = made.replace('ProcessSpec(n, (sys.executable, "-c", code))', "forked(n)")
    assert made.count("forked") == 2
    return made


async def test_forks_die_with_their_supervisor() -> None:
    with another_supervisor(all_forked(PARENT), one="", two="") as (parent, pids):
        assert all(psutil.Process(pid).cmdline()[0] == f"forked {n}" for n, pid in pids.items())
        parent.kill()
        await until(lambda: not any(alive(pid) for pid in pids.values()))


def test_imports_of_fork_servers_start_no_thread(tmp_path: Path) -> None:
    """A fork has only the forking thread, and locks held by other threads stay locked."""
    rows = [name for name, row in PROCESSES.items() if row.forks and row.named]
    deployment = Deployment(
        hosts={"robot": tuple(rows)},
        perception=PerceptionConfig(mapping="slam"),
        decision=DecisionConfig(behaviour="navigate"),
    )
    specs = process_specs(deployment, "robot", tmp_path, tmp_path)
    modules = [
        module for one in specs if one.fork for level in one.fork.imports for module in level
    ]
    assert "gigabrain_zenoh.kernels.shared" in modules
    code = (
        "import importlib, os, sys; [importlib.import_module(one) for one in sys.argv[1:]];"
        "print(os.listdir('/proc/self/task'), os.getpid())"
    )
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    argv = [sys.executable, "-c", code, *modules]
    threads, _, pid = subprocess.check_output(argv, text=True, env=env).rpartition(" ")
    assert threads == f"['{pid.strip()}']"
