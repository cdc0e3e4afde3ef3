import asyncio
import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from gigabrain_zenoh.child import Child, Lines, as_record
from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.specs import COMMAND
from gigabrain_zenoh.supervisor import Backoff, ProcessSpec, Supervisor

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the supervisor is for POSIX hosts")

ROOT = Path(__file__).parent.parent
QUICK = Backoff(first_s=0.01, factor=2.0, longest_s=0.04)
CHILD = f"""
import json, os, signal, subprocess, sys, time
sys.path.insert(0, {str(ROOT)!r})
from gigabrain_zenoh import lifeline
def say(event, **data):
    print(json.dumps({{"event": event, **data}}), file=sys.stderr, flush=True)
def wait():
    while True:
        time.sleep(60)
"""
SERVE = "say('ready'); wait()"
HANG = "signal.signal(signal.SIGTERM, signal.SIG_IGN); say('ready'); wait()"


def spec(name: str, code: str = SERVE, *after: str, **more: Any) -> ProcessSpec:
    return ProcessSpec(name, (sys.executable, "-c", CHILD + code), after, **more)


class Records:
    def __init__(self) -> None:
        self.all: list[tuple[str, Mapping[str, Any]]] = []

    def __call__(self, name: str, record: Mapping[str, Any]) -> None:
        self.all.append((name, record))

    def events(self) -> list[tuple[str, str]]:
        return [(name, record["event"]) for name, record in self.all]

    def texts(self, event: str) -> list[str]:
        return [record["text"] for _, record in self.all if record["event"] == event]


@asynccontextmanager
async def running(
    *specs: ProcessSpec, backoff: Backoff = QUICK
) -> AsyncIterator[tuple[Supervisor, Records]]:
    records = Records()
    async with Supervisor(specs, records, backoff) as supervisor:
        task = asyncio.create_task(supervisor.run())
        yield supervisor, records
        pids = [status.pid for status in supervisor.statuses.values() if status.pid]
        await supervisor.stop(within_s=1.0)
        await task
    for pid in pids:
        with pytest.raises(ProcessLookupError):  # not even a zombie is left
            os.kill(pid, 0)


async def until(condition: Callable[[], object], within_s: float = 30.0) -> None:
    async with asyncio.timeout(within_s):
        while True:
            if condition():
                return
            await asyncio.sleep(0.005)


def state(pid: int) -> str:
    """Its letter in /proc (`S`, `T`, `Z`, ...), empty where there is no process or no /proc."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    return ""


def alive(pid: int) -> bool:
    """Whether a process runs; a zombie, which its new parent may not have reaped yet, does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return state(pid) not in ("Z", "X")


async def freeze(pid: int | None) -> None:
    assert pid
    os.kill(pid, signal.SIGSTOP)
    if sys.platform == "linux":  # a signal that comes before it stands still would be the first
        await until(lambda: state(pid) == "T")


async def test_a_process_starts_when_those_before_it_are_ready_and_not_merely_started() -> None:
    slow = "say('begun'); time.sleep(0.3); say('ready'); wait()"
    async with running(
        spec("perception", "say('begun'); " + SERVE, "driver", "router"),
        spec("driver", slow, "router"),
        spec("router", SERVE),
        spec("page", SERVE),
    ) as (supervisor, records):
        await until(lambda: all(s.state == "ready" for s in supervisor.statuses.values()))
        order = records.events()
        assert order.index(("router", "ready")) < order.index(("driver", "begun"))
        assert order.index(("driver", "ready")) < order.index(("perception", "begun"))
        assert order.index(("page", "ready")) < order.index(("driver", "ready"))
        assert all((s.ready_after_s or 0) > 0 for s in supervisor.statuses.values())
        assert supervisor.deaths == 0


async def test_a_process_that_dies_is_started_again() -> None:
    async with running(spec("control")) as (supervisor, records):
        status = supervisor.statuses["control"]
        await until(lambda: status.state == "ready")
        first = status.pid
        assert first
        os.kill(first, signal.SIGKILL)
        await until(lambda: status.restarts == 1 and status.state == "ready")
        assert status.pid not in (None, first)
        assert (status.last_exit, supervisor.deaths, supervisor.given_up) == (-9, 1, ())
        assert records.texts("died") == [
            "control ended with signal 9 (Killed); next start in 0.01 s"
        ]


async def test_a_restart_leaves_those_that_come_after_alone() -> None:
    async with running(spec("driver"), spec("control", SERVE, "driver")) as (supervisor, _):
        driver, control = supervisor.statuses["driver"], supervisor.statuses["control"]
        await until(lambda: control.state == "ready")
        pid = control.pid
        os.kill(driver.pid or 0, signal.SIGKILL)
        await until(lambda: driver.restarts == 1 and driver.state == "ready")
        assert (control.pid, control.restarts) == (pid, 0)


async def test_five_deaths_are_enough_and_a_sentence_says_so() -> None:
    async with running(spec("control", "sys.exit(7)")) as (supervisor, records):
        status = supervisor.statuses["control"]
        await until(lambda: status.state == "given up")
        assert (supervisor.deaths, status.restarts, status.last_exit) == (5, 4, 7)
        assert (supervisor.given_up, supervisor.misconfigured) == (("control",), ())
        assert records.texts("given up") == [
            "control ended with exit code 7 and is given up: 5 deaths within 60 s"
        ]
        assert [text.rsplit(" in ")[1] for text in records.texts("died")] == [
            "0.01 s",
            "0.02 s",
            "0.04 s",
            "0.04 s",
        ]


async def test_a_crash_loop_at_start_costs_less_than_a_twentieth_of_a_core() -> None:
    """With the real times, and a real process that gets as far as reading its configuration."""
    crasher = ProcessSpec("control", (*COMMAND, "{"))
    before = os.times()
    async with running(crasher, backoff=Backoff()) as (supervisor, records):
        await until(lambda: supervisor.statuses["control"].state == "given up")
        assert [text.rsplit(" in ")[1] for text in records.texts("died")] == [
            "0.2 s",
            "0.4 s",
            "0.8 s",
            "1.6 s",
        ]
    after = os.times()
    used_s = sum(after[:4]) - sum(before[:4])  # ours and the children's, of the user and the system
    assert used_s <= 0.05 * Backoff().window_s


async def test_a_bad_configuration_is_not_tried_twice() -> None:
    async with running(spec("driver", "sys.exit(2)")) as (supervisor, records):
        await until(lambda: supervisor.given_up)
        assert (supervisor.misconfigured, supervisor.deaths) == (("driver",), 1)
        (name, record) = records.all[-1]
        assert (name, record["event"], record["level"], record["exit_code"]) == (
            "driver",
            "given up",
            "error",
            2,
        )
        assert record["text"] == (
            "driver ended with exit code 2 and is given up: what it was given is wrong"
        )


async def test_a_program_that_is_not_there_is_not_tried_twice() -> None:
    missing = ProcessSpec("driver", ("/nowhere/gigabrain",))
    async with running(missing) as (supervisor, records):
        await until(lambda: supervisor.given_up)
        (text,) = records.texts("given up")
        assert text.startswith("driver could not be started ([Errno 2] No such file")
        assert text.endswith("is given up: it cannot run here")


async def test_a_start_that_fails_for_want_of_resources_is_tried_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start, refusals = Child.start, [OSError(errno.EAGAIN, "Resource temporarily unavailable")]

    async def scarce(*arguments: Any) -> Child:
        if refusals:
            raise refusals.pop()
        return await start(*arguments)

    monkeypatch.setattr(Child, "start", scarce)
    async with running(spec("driver")) as (supervisor, records):
        await until(lambda: supervisor.statuses["driver"].state == "ready")
        (text,) = records.texts("died")
        assert text.startswith(f"driver could not be started ([Errno {errno.EAGAIN}] Resource ")


async def test_what_comes_after_a_process_that_is_given_up_is_not_started() -> None:
    async with running(
        spec("driver", "sys.exit(2)"), spec("control", SERVE, "driver"), spec("page")
    ) as (supervisor, records):
        await until(lambda: records.texts("not started"))
        assert records.texts("not started") == ["control is not started without driver"]
        await until(lambda: supervisor.statuses["page"].state == "ready")
        assert supervisor.statuses["control"].state == "waiting"


async def test_a_process_that_does_not_get_ready_is_killed_and_counts_as_dead() -> None:
    async with running(spec("driver", "wait()", ready_timeout_s=0.2)) as (supervisor, records):
        status = supervisor.statuses["driver"]
        await until(lambda: status.restarts == 1)
        assert (supervisor.deaths, status.last_exit) == (1, -9)
        assert records.texts("not ready") == ["driver was not ready within 0.2 s and is killed"]


async def test_what_a_process_writes_that_is_no_record_becomes_one() -> None:
    code = """
print('to stdout')
print('x' * 300_000, file=sys.stderr, flush=True)
say('long', text='y' * 200_000)
sys.stderr.buffer.write(b'\\xff\\x00 panicked\\n\\n{"event": 3}\\n[1]\\n'); sys.stderr.flush()
say('ready', level='warning', process='driver')
sys.stderr.write('no newline at the end'); sys.stderr.flush()
sys.exit(1)
"""
    async with running(spec("driver", code)) as (_, records):
        await until(lambda: records.texts("died"))
        said = [record for _, record in records.all]
        output = [r["text"] for r in said if r["event"] == "output"]
        assert [text for text in output if not text.startswith("x")][:5] == [
            "to stdout",
            "\ufffd\x00 panicked",
            '{"event": 3}',
            "[1]",
            "no newline at the end",
        ]
        assert sum(len(text) for text in output if text.startswith("x")) == 300_000
        assert next(len(r["text"]) for r in said if r["event"] == "long") == 200_000
        ready = next(r for r in said if r["event"] == "ready")
        assert (ready["level"], ready["process"]) == ("warning", "driver")


async def test_all_end_also_those_that_hang_or_are_frozen_and_the_router_last() -> None:
    # waits for the signal in the open: a handler must not write while a write goes on
    obedient = """
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
say('ready')
signal.sigwait({signal.SIGTERM})
say('bye')
"""
    names = ("router", "driver", "control", "safety")
    async with running(
        spec("router", obedient, stop_last=True),
        spec("driver", obedient),
        spec("control", HANG),
        spec("safety", SERVE),
    ) as (supervisor, records):
        await until(lambda: all(s.state == "ready" for s in supervisor.statuses.values()))
        await freeze(supervisor.statuses["safety"].pid)
        await supervisor.stop(within_s=2.0)
        assert [supervisor.statuses[name].state for name in names] == ["stopped"] * 4
        assert sorted(records.texts("killed")) == [
            "control did not end when asked and is killed",
            "safety did not end when asked and is killed",
        ]
        order = records.events()
        assert order.index(("driver", "bye")) < order.index(("control", "killed"))
        assert order[-1] == ("router", "bye")
        assert supervisor.deaths == 0


async def test_all_end_also_while_they_wait_start_or_back_off() -> None:
    async with running(
        spec("starting", "wait()"),
        spec("waiting", SERVE, "starting"),
        spec("dying", "sys.exit(1)"),
        backoff=Backoff(first_s=60.0, longest_s=60.0),
    ) as (supervisor, _):
        await until(lambda: supervisor.statuses["dying"].state == "backing off")
        await supervisor.stop(within_s=1.0)
        assert {s.state for s in supervisor.statuses.values()} == {"stopped"}


async def test_a_stop_at_any_moment_of_the_start_leaves_nothing_behind() -> None:
    for turns in range(0, 12, 2):
        supervisor = Supervisor([spec("one"), spec("two")], Records(), QUICK)
        task = asyncio.create_task(supervisor.run())
        for _ in range(turns):
            await asyncio.sleep(0)
        await supervisor.stop(within_s=1.0)
        await task
        assert {status.pid for status in supervisor.statuses.values()} == {None}


async def test_a_stop_before_the_start_starts_nothing() -> None:
    records = Records()
    async with Supervisor([spec("one")], records) as supervisor:
        await supervisor.stop()
        await supervisor.run()
    assert records.all == []


async def test_a_cancelled_run_ends_all() -> None:
    supervisor = Supervisor([spec("one"), spec("two", HANG)], Records(), QUICK)
    task = asyncio.create_task(supervisor.run())
    await until(lambda: all(s.state == "ready" for s in supervisor.statuses.values()))
    pids = [status.pid or 0 for status in supervisor.statuses.values()]
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not any(alive(pid) for pid in pids)


async def test_a_terminals_ctrl_c_does_not_reach_the_processes() -> None:
    async with running(spec("one")) as (supervisor, _):
        await until(lambda: supervisor.statuses["one"].state == "ready")
        pid = supervisor.statuses["one"].pid or 0
        assert os.getpgid(pid) == pid
        assert os.getsid(pid) == pid


async def test_what_a_dead_process_has_started_goes_with_it() -> None:
    code = "p = subprocess.Popen(['sleep', '60']); say('ready', child_pid=p.pid); sys.exit(1)"
    async with running(spec("driver", code)) as (supervisor, records):
        await until(lambda: supervisor.deaths)
        pid = next(r["child_pid"] for _, r in records.all if r["event"] == "ready")
        await until(lambda: not alive(pid))


async def test_a_process_knows_its_supervisor_and_its_output_is_not_held_back() -> None:
    code = "print(os.environ['GIGABRAIN_SUPERVISOR']); " + SERVE
    async with running(spec("one", code)) as (_, records):
        await until(lambda: records.texts("output"))
        assert records.texts("output") == [str(os.getpid())]


async def test_a_fault_of_the_supervisor_itself_is_not_swallowed() -> None:
    def broken(name: str, record: Mapping[str, Any]) -> None:
        if record["event"] == "given up":
            raise RuntimeError("the console is gone")

    supervisor = Supervisor([spec("one", "sys.exit(2)"), spec("two")], broken, QUICK)
    with pytest.raises(RuntimeError, match="the console is gone"):
        await supervisor.run()
    assert supervisor.statuses["two"].state == "stopped"


def test_names_that_make_no_sense_are_refused() -> None:
    with pytest.raises(UnknownName, match="no process 'drivr'; did you mean 'driver'"):
        Supervisor([spec("driver"), spec("control", SERVE, "drivr")], Records())
    with pytest.raises(ConfigError, match="2 processes are called 'driver'; expected one"):
        Supervisor([spec("driver"), spec("driver")], Records())
    with pytest.raises(ConfigError, match=r"no process can be first: \w after \w after \w; exp"):
        Supervisor([spec("a", SERVE, "b"), spec("b", SERVE, "a")], Records())


async def whole_life() -> None:
    async with running(
        spec("driver", "print('x' * 100_000); " + SERVE), spec("control", HANG, "driver")
    ) as (supervisor, records):
        driver, control = supervisor.statuses["driver"], supervisor.statuses["control"]
        await until(lambda: control.state == "ready")
        os.kill(driver.pid or 0, signal.SIGKILL)
        await until(lambda: driver.restarts == 1 and driver.state == "ready")
        await freeze(control.pid)
        await supervisor.stop(within_s=1.0)
        assert len(records.texts("killed")) == 1
        assert (driver.last_exit, control.last_exit) == (-15, -9)


def test_it_works_on_uvloop_too() -> None:
    uvloop = pytest.importorskip("uvloop")
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(whole_life())


def test_it_works_on_asyncio_in_debug_mode() -> None:
    with asyncio.Runner(debug=True) as runner:
        runner.run(whole_life())


PARENT = f"""
import asyncio, json, sys
sys.path[:0] = [{str(ROOT)!r}, {str(Path(__file__).parent)!r}]
from gigabrain_zenoh.supervisor import ProcessSpec, Supervisor
codes = json.loads(sys.argv[1])
specs = [ProcessSpec(n, (sys.executable, "-c", code)) for n, code in codes.items()]
def show(name, record):
    if record["event"] == "ready":
        print(json.dumps([name, supervisor.statuses[name].pid]), flush=True)
supervisor = Supervisor(specs, show)
asyncio.run(supervisor.run())
"""


@contextmanager
def another_supervisor(
    **codes: str,
) -> Iterator[tuple[subprocess.Popen[str], dict[str, int]]]:
    """A supervisor in a process of its own, with the pids of its processes, all ready."""
    argv = [sys.executable, "-c", PARENT, json.dumps(codes)]
    pids: dict[str, int] = {}
    with subprocess.Popen(
        argv, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as parent:
        assert parent.stdout
        try:
            while len(pids) < len(codes):
                name, pid = json.loads(parent.stdout.readline())
                pids[name] = pid
            yield parent, pids
        finally:
            parent.kill()
            for pid in pids.values():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


TIED = CHILD + "lifeline.die_with_supervisor(); "


async def test_nothing_is_left_when_the_supervisor_is_killed() -> None:
    with another_supervisor(
        obedient=TIED + SERVE,
        hanging=TIED + HANG,
        frozen=TIED + SERVE,
        watched=CHILD + "lifeline.watch_parent(os.getppid()); " + HANG,
    ) as (parent, pids):
        if sys.platform == "linux":
            await freeze(pids["frozen"])
        parent.kill()
        await until(lambda: not any(alive(pid) for pid in pids.values()))


async def test_an_impatient_second_ctrl_c_leaves_nothing_behind() -> None:
    with another_supervisor(hanging=CHILD + HANG, other=CHILD + HANG) as (parent, pids):
        parent.send_signal(signal.SIGINT)
        await asyncio.sleep(0.1)
        parent.send_signal(signal.SIGINT)
        await until(lambda: not any(alive(pid) for pid in pids.values()))
        await until(lambda: parent.poll() is not None)


def lifeline_exit(code: str, variable: str | None) -> int:
    env = {k: v for k, v in os.environ.items() if k != "GIGABRAIN_SUPERVISOR"}
    env |= {"GIGABRAIN_SUPERVISOR": variable} if variable is not None else {}
    return subprocess.run([sys.executable, "-c", CHILD + code], env=env, check=False).returncode


def test_a_child_whose_supervisor_has_died_before_it_could_ask_ends() -> None:
    assert lifeline_exit("lifeline.die_with_supervisor(); sys.exit(7)", "1") == -9


@pytest.mark.parametrize("variable", [None, "", "nonsense"])
def test_a_process_without_supervisor_lives_as_long_as_it_likes(variable: str | None) -> None:
    assert lifeline_exit("lifeline.die_with_supervisor(); sys.exit(7)", variable) == 7


def test_the_lifeline_is_not_handed_on_to_grandchildren() -> None:
    code = "lifeline.die_with_supervisor(); sys.exit('GIGABRAIN_SUPERVISOR' in os.environ)"
    assert lifeline_exit(code, str(os.getpid())) == 0


def test_lines_of_any_cut_are_put_together() -> None:
    lines = Lines()
    assert lines.feed(b"on") == []
    assert lines.feed(b"e\ntwo\n\n  \nthr") == [b"one", b"two"]
    assert lines.end() == b"thr"
    assert lines.end() == b""


def test_a_line_without_end_does_not_grow_for_ever() -> None:
    lines = Lines()
    pieces = [piece for _ in range(100) for piece in lines.feed(b"x" * 65_536)]
    assert sum(map(len, pieces)) >= 6_000_000
    assert max(map(len, pieces)) == 327_680


def test_a_record_with_fields_of_the_wrong_kind_is_put_right() -> None:
    record = as_record(b'{"event": "ready", "t": "noon", "level": 3, "port": 7}', "driver")
    assert record.pop("t") > 1_700_000_000_000_000_000
    assert record == {"event": "ready", "level": "info", "process": "driver", "port": 7}


def test_deeply_nested_output_is_text() -> None:
    assert as_record(b"[" * 100_000, "driver")["event"] == "output"
