"""Processes that a fork server starts behave as those that are started by themselves."""

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
    forking.end_early()  # where a test has failed


def servers() -> list[psutil.Process]:
    """The fork server of the first level that this process has started."""
    return [one for one in psutil.Process().children() if "fork_server" in " ".join(one.cmdline())]


async def until_ready(supervisor: Supervisor) -> None:
    await until(lambda: all(one.state == "ready" for one in supervisor.statuses.values()))


async def test_a_fork_is_a_child_of_its_supervisor_and_the_servers_end() -> None:
    async with running(forked("one"), forked("two"), spec("three")) as (supervisor, records):
        await until_ready(supervisor)
        one, two, three = (psutil.Process(s.pid) for s in supervisor.statuses.values())
        assert [one.cmdline()[0], two.cmdline()[0]] == ["forked one", "forked two"]
        assert {one.ppid(), two.ppid(), three.ppid()} == {os.getpid()}
        assert os.getsid(one.pid) == os.getpgid(one.pid) == one.pid
        assert not servers()
        assert not records.texts("fork server")
        own = one.memory_full_info().uss
        assert own < 0.5 * one.memory_info().rss  # the rest is shared with the other one


async def test_several_supervisors_of_one_process_fork_at_once() -> None:
    specs = [(forked("one"), forked("two"), forked("three")) for _ in range(4)]
    async with contextlib.AsyncExitStack() as stack:
        robots = [await stack.enter_async_context(running(*one)) for one in specs]
        for supervisor, records in robots:
            await until_ready(supervisor)
            assert not records.texts("fork server")


async def test_a_fork_that_dies_is_started_again_by_itself() -> None:
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
async def test_how_a_fork_ends_is_reported_with_its_output(code: str, text: str) -> None:
    async with running(forked("one", code), forked("two")) as (_, records):
        await until(lambda: records.texts("died"))
        assert records.texts("died")[0].startswith(text)
        said = "".join(records.texts("output"))
        assert said.count("x") >= 99_999 * ("print" in code)
        assert ("ValueError" in said) == ("raise" in code)


async def test_a_fork_starts_after_those_that_it_needs() -> None:
    async with running(forked("one", SERVE, "two"), forked("two"), forked("three")) as running_now:
        supervisor, records = running_now
        await until_ready(supervisor)
        order = records.events()
        assert order.index(("two", "ready")) < order.index(("one", "ready"))


async def killed(server: psutil.Process) -> None:
    server.kill()


async def frozen(server: psutil.Process) -> None:
    await freeze(server.pid)


async def left_alone(server: psutil.Process) -> None:
    del server


@pytest.mark.parametrize(
    ("fault", "why"),
    [(killed, "has ended"), (frozen, "does not answer"), (left_alone, "does not answer")],
)
async def test_without_a_server_processes_start_by_themselves(
    fault: Callable[[psutil.Process], object], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its import never ends; one that is only slow is given up after a while."""
    if fault is left_alone:
        monkeypatch.setattr(forking, "IMPORT_TIMEOUT_S", 0.2)
        monkeypatch.setattr(forking, "STOPPED_CHECK_S", 0.1)
    specs = forked("one", imports=NEVER), forked("two", imports=NEVER)
    async with running(*specs) as (supervisor, records):
        await until(servers)
        await fault(servers()[0])  # type: ignore[misc]
        await until_ready(supervisor)
        told = [f"the fork server {why}; processes start without it, with more memory"]
        assert records.texts("fork server") == told
        assert supervisor.deaths == 0
        assert not servers()


async def test_where_no_server_can_start_processes_start_by_themselves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(forking, "COMMAND", ("/nowhere/python",))
    async with running(forked("one"), forked("two")) as (supervisor, records):
        await until_ready(supervisor)
        (told,) = records.texts("fork server")
        assert told.startswith("the fork server cannot be started ([Errno 2] No such file")
        assert supervisor.deaths == 0


async def test_a_stop_does_not_wait_for_a_server_that_imports() -> None:
    specs = forked("one", imports=NEVER), forked("two", imports=NEVER)
    async with running(*specs):
        await until(servers)
    assert not servers()


async def test_a_supervisor_takes_over_a_server_that_was_started_early() -> None:
    forking.start_early("tests.system.children")
    (early,) = servers()
    async with running(forked("one"), forked("two")) as (supervisor, records):
        await until_ready(supervisor)
        assert psutil.Process(supervisor.statuses["one"].pid).cmdline()[0] == "forked one"
        assert not servers()
        assert not records.texts("fork server")
    assert not early.is_running()


async def test_an_early_server_that_no_process_needs_is_ended() -> None:
    forking.start_early()
    assert servers()
    async with running(forked("one"), spec("two")) as (supervisor, _):
        assert not servers()
        await until_ready(supervisor)


async def test_without_the_early_server_processes_start_by_themselves() -> None:
    forking.start_early()
    (early,) = servers()
    early.kill()
    early.wait()
    async with running(forked("one"), forked("two")) as (supervisor, records):
        await until_ready(supervisor)
        assert len(records.texts("fork server")) == 1
        assert supervisor.deaths == 0


ABANDONS = """
from gigabrain_zenoh.runtime import forking
forking.start_early("time")
print(forking._early[0][0].pid)
"""


def test_an_early_server_ends_with_the_command_that_started_it() -> None:
    said = subprocess.check_output((sys.executable, "-c", ABANDONS), text=True)
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(int(said)).wait(timeout=10)


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
    """The same supervisor, whose processes a fork server starts."""
    made = parent.replace("specs = [", "from tests.system.children import forked\nspecs = [")
    made = made.replace('ProcessSpec(n, (sys.executable, "-c", code))', "forked(n)")
    assert made.count("forked") == 2
    return made


async def test_forks_die_with_their_supervisor() -> None:
    with another_supervisor(all_forked(PARENT), one="", two="") as (parent, pids):
        assert all(psutil.Process(pid).cmdline()[0] == f"forked {n}" for n, pid in pids.items())
        parent.kill()
        await until(lambda: not any(alive(pid) for pid in pids.values()))


def test_what_servers_import_leaves_no_thread(tmp_path: Path) -> None:
    """A fork has only the thread that forks, while locks of others stay held."""
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
