import asyncio
import errno
import functools
import os
import signal
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from gigabrain_zenoh.errors import ConfigError, UnknownName
from gigabrain_zenoh.launch.specs import COMMAND
from gigabrain_zenoh.runtime.child import Child
from gigabrain_zenoh.runtime.supervisor import Backoff, ProcessSpec, Supervisor
from gigabrain_zenoh.testing.waiting import until
from tests.system.children import HANG, QUICK, SERVE, Records, freeze, running, spec

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="the supervisor is for POSIX hosts"),
]


async def test_a_process_starts_when_its_predecessors_are_ready(
    tmp_path: Path,
) -> None:
    go_on = tmp_path / "go_on"
    slow = f"""
say('begun')
while not os.path.exists({str(go_on)!r}):
    time.sleep(0.01)
say('ready'); wait()"""
    async with running(
        spec("perception", "say('begun'); " + SERVE, "driver", "router"),
        spec("driver", slow, "router"),
        spec("router", SERVE),
        spec("page", SERVE),
    ) as (supervisor, records):
        await until(lambda: ("driver", "begun") in records.events())
        await until(lambda: supervisor.statuses["page"].state == "ready")
        assert supervisor.statuses["perception"].state == "waiting"
        go_on.touch()
        await until(lambda: all(s.state == "ready" for s in supervisor.statuses.values()))
        order = records.events()
        assert order.index(("router", "ready")) < order.index(("driver", "begun"))
        assert order.index(("driver", "ready")) < order.index(("perception", "begun"))
        assert all((s.ready_after_s or 0) > 0 for s in supervisor.statuses.values())
        assert supervisor.deaths == 0


async def test_a_process_reads_its_configuration_where_other_users_cannot_see_it() -> None:
    config = "secret ü" * 40_000  # more than a pipe holds
    code = "read = sys.stdin.buffer.read().decode(); say('read', text=f'{len(read)} {read[-8:]}'); "
    async with running(spec("camera", code + SERVE, config=config)) as (supervisor, records):
        status = supervisor.statuses["camera"]
        for starts in (1, 2):  # a restart reads it again
            await until(lambda: status.restarts == starts - 1 and status.state == "ready")  # noqa: B023
            assert records.texts("read") == ["320000 secret ü"] * starts
            assert status.pid
            os.kill(status.pid, signal.SIGKILL)


async def test_a_process_need_not_read_its_configuration() -> None:
    config = "x" * 400_000
    async with running(
        spec("camera", "os.close(0); " + SERVE, config=config),
        spec("lamp", "sys.exit(7)", config=config),
    ) as (supervisor, _):
        await until(lambda: supervisor.statuses["camera"].state == "ready")
        await until(lambda: supervisor.statuses["lamp"].state == "given up")
        assert supervisor.statuses["lamp"].last_exit == 7


async def test_a_dead_process_is_restarted() -> None:
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


@pytest.mark.slow
async def test_a_frozen_process_is_killed_and_restarted() -> None:
    beating = """
say('ready')
while True:
    say('progress'); time.sleep(0.2)
"""
    frozen, well = spec("control", beating, beats=True), spec("safety", beating, beats=True)
    async with running(frozen, well) as (supervisor, records):
        control, safety = supervisor.statuses["control"], supervisor.statuses["safety"]
        await until(lambda: control.state == safety.state == "ready")
        await freeze(control.pid)
        await until(lambda: control.restarts == 1 and control.state == "ready")
        assert records.texts("stuck") == ["control has made no progress for 5 s and is killed"]
        assert (control.last_exit, safety.restarts, supervisor.deaths) == (-9, 0, 1)


async def test_a_restart_does_not_restart_later_processes() -> None:
    async with running(spec("driver"), spec("control", SERVE, "driver")) as (supervisor, _):
        driver, control = supervisor.statuses["driver"], supervisor.statuses["control"]
        await until(lambda: control.state == "ready")
        pid = control.pid
        os.kill(driver.pid or 0, signal.SIGKILL)
        await until(lambda: driver.restarts == 1 and driver.state == "ready")
        assert (control.pid, control.restarts) == (pid, 0)


async def test_a_process_is_given_up_after_five_deaths_with_one_line() -> None:
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


def used_s() -> float:
    """Return the user and system CPU time of this process and its ended children [s]."""
    return sum(os.times()[:4])


async def test_a_crash_loop_costs_no_more_cpu_than_five_starts() -> None:
    """Use the real pauses, and a real process that fails when it reads its configuration."""
    crasher = ProcessSpec("control", COMMAND, config="{")
    before_s = used_s()
    once = functools.partial(subprocess.run, capture_output=True, check=False, input=b"{")
    assert (await asyncio.to_thread(once, crasher.argv)).returncode
    one_s = used_s() - before_s
    before_s += one_s
    async with running(crasher, backoff=Backoff()) as (supervisor, records):
        await until(lambda: supervisor.statuses["control"].state == "given up")
        assert [text.rsplit(" in ")[1] for text in records.texts("died")] == [
            "0.2 s",
            "0.4 s",
            "0.8 s",
            "1.6 s",
        ]
    assert used_s() - before_s <= 3 * 5 * one_s  # a loop without pauses would start hundreds


async def test_a_process_with_a_bad_configuration_is_not_restarted() -> None:
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
            "driver ended with exit code 2 and is given up: its settings are wrong"
        )


@pytest.mark.parametrize("ready_end", [1, 2])
async def test_a_process_that_was_ready_before_is_always_restarted(
    tmp_path: Path, ready_end: int
) -> None:
    """It may end for another reason, such as a full disk or a second process of its name."""
    once = f"os.path.exists({str(tmp_path / 'once')!r}) and sys.exit(2)"
    code = f"{once}; open({str(tmp_path / 'once')!r}, 'w'); say('ready'); sys.exit({ready_end})"
    async with running(spec("driver", code)) as (supervisor, records):
        await until(lambda: supervisor.given_up)
        assert (supervisor.misconfigured, supervisor.deaths) == ((), 5)
        assert records.texts("given up") == [
            "driver ended with exit code 2 and is given up: 5 deaths within 60 s"
        ]


async def test_a_missing_program_is_not_restarted() -> None:
    missing = ProcessSpec("driver", ("/nowhere/gigabrain",))
    async with running(missing) as (supervisor, records):
        await until(lambda: supervisor.given_up)
        (text,) = records.texts("given up")
        assert text.startswith("driver could not be started ([Errno 2] No such file")
        assert text.endswith("is given up: it cannot run here")


async def test_a_start_that_fails_for_lack_of_resources_is_repeated(
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


async def test_processes_after_a_given_up_one_are_not_started() -> None:
    async with running(
        spec("driver", "sys.exit(2)"), spec("control", SERVE, "driver"), spec("page")
    ) as (supervisor, records):
        await until(lambda: records.texts("not started"))
        assert records.texts("not started") == ["control is not started without driver"]
        await until(lambda: supervisor.statuses["page"].state == "ready")
        assert supervisor.statuses["control"].state == "waiting"


async def test_a_process_that_does_not_become_ready_is_killed() -> None:
    async with running(spec("driver", "wait()", ready_timeout_s=0.2)) as (supervisor, records):
        status = supervisor.statuses["driver"]
        await until(lambda: status.restarts)
        assert supervisor.deaths >= status.restarts
        assert status.last_exit == -9
        assert records.texts("not ready")[0] == "driver was not ready within 0.2 s and is killed"


async def test_plain_output_of_a_process_becomes_log_records() -> None:
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
        logged = [record for _, record in records.all]
        output = [r["text"] for r in logged if r["event"] == "output"]
        assert [text for text in output if not text.startswith("x")][:5] == [
            "to stdout",
            "\ufffd\x00 panicked",
            '{"event": 3}',
            "[1]",
            "no newline at the end",
        ]
        assert sum(len(text) for text in output if text.startswith("x")) == 300_000
        assert next(len(r["text"]) for r in logged if r["event"] == "long") == 200_000
        ready = next(r for r in logged if r["event"] == "ready")
        assert (ready["level"], ready["process"]) == ("warning", "driver")


async def test_a_process_knows_its_supervisor_and_its_output_is_unbuffered() -> None:
    code = "print(os.environ['GIGABRAIN_SUPERVISOR']); " + SERVE
    async with running(spec("one", code)) as (_, records):
        await until(lambda: records.texts("output"))
        assert records.texts("output") == [str(os.getpid())]


async def test_an_exception_in_the_supervisor_is_raised() -> None:
    def broken(name: str, record: Mapping[str, Any]) -> None:
        if record["event"] == "given up":
            raise RuntimeError("the console is gone")

    supervisor = Supervisor([spec("one", "sys.exit(2)"), spec("two")], broken, QUICK)
    with pytest.raises(RuntimeError, match="the console is gone"):
        await supervisor.run()
    assert supervisor.statuses["two"].state == "stopped"


def test_invalid_process_names_are_refused() -> None:
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


def test_the_supervisor_works_on_uvloop_too() -> None:
    uvloop = pytest.importorskip("uvloop")
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(whole_life())


def test_the_supervisor_works_with_asyncio_in_debug_mode() -> None:
    with asyncio.Runner(debug=True) as runner:
        runner.run(whole_life())
