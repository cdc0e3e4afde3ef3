import asyncio
import os
import signal
import subprocess
import sys

import pytest

from gigabrain_zenoh.runtime.child import Child
from gigabrain_zenoh.runtime.supervisor import Backoff, Supervisor
from gigabrain_zenoh.testing.waiting import until
from tests.system.children import (
    CHILD,
    HANG,
    QUICK,
    SERVE,
    Records,
    alive,
    another_supervisor,
    freeze,
    reaped,
    running,
    spec,
    state,
)

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="the supervisor is for POSIX hosts"),
]


async def test_all_processes_end_even_hanging_or_frozen_ones_and_the_router_last() -> None:
    # uses sigwait, because a signal handler must not write during another write
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


async def test_all_processes_end_also_while_waiting_starting_or_backing_off() -> None:
    async with running(
        spec("starting", "wait()"),
        spec("waiting", SERVE, "starting"),
        spec("dying", "sys.exit(1)"),
        backoff=Backoff(first_s=60.0, longest_s=60.0),
    ) as (supervisor, _):
        await until(lambda: supervisor.statuses["dying"].state == "backing off")
        await supervisor.stop(within_s=1.0)
        assert {s.state for s in supervisor.statuses.values()} == {"stopped"}


async def test_a_stop_at_any_moment_of_the_start_leaves_no_process() -> None:
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


async def test_a_cancelled_run_ends_all_processes() -> None:
    supervisor = Supervisor([spec("one"), spec("two", HANG)], Records(), QUICK)
    task = asyncio.create_task(supervisor.run())
    await until(lambda: all(s.state == "ready" for s in supervisor.statuses.values()))
    pids = [status.pid or 0 for status in supervisor.statuses.values()]
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not any(alive(pid) for pid in pids)


async def test_a_run_cancelled_twice_ends_all_processes() -> None:
    """A second Ctrl-C cancels all tasks of asyncio."""
    supervisor = Supervisor([spec("one"), spec("two", HANG)], Records(), QUICK)
    before = asyncio.all_tasks()
    task = asyncio.create_task(supervisor.run())
    await until(lambda: all(s.state == "ready" for s in supervisor.statuses.values()))
    pids = [status.pid or 0 for status in supervisor.statuses.values()]
    task.cancel()
    await asyncio.sleep(0)  # the stop is requested but has not begun
    left = asyncio.all_tasks() - before
    for each in left:
        each.cancel()
    await asyncio.gather(*left, return_exceptions=True)
    await until(lambda: not any(alive(pid) for pid in pids))


TRACER = """
import ctypes, sys, time
print(ctypes.CDLL(None).ptrace(16, int(sys.argv[1]), None, None), flush=True)  # PTRACE_ATTACH
time.sleep(60)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="by ptrace(2)")
async def test_an_unkillable_process_does_not_delay_the_end() -> None:
    """A traced process stands for one blocked in a broken device: neither is reaped when killed."""
    supervisor = Supervisor([spec("one"), spec("two")], Records(), QUICK)
    task = asyncio.create_task(supervisor.run())
    await until(lambda: all(s.state == "ready" for s in supervisor.statuses.values()))
    held = str(supervisor.statuses["one"].pid)
    tracer = await asyncio.create_subprocess_exec(
        sys.executable, "-c", TRACER, held, stdout=subprocess.PIPE
    )
    assert tracer.stdout
    try:
        if await tracer.stdout.readline() != b"0\n":
            pytest.skip("this host lets no process trace another one")
        await supervisor.stop(within_s=1.0)
        await asyncio.wait_for(task, 5.0)
        assert supervisor.statuses["two"].state == "stopped"
    finally:
        tracer.kill()
        await tracer.wait()
    await reaped(int(held))


async def test_ctrl_c_of_the_terminal_does_not_reach_the_processes() -> None:
    async with running(spec("one")) as (supervisor, _):
        await until(lambda: supervisor.statuses["one"].state == "ready")
        pid = supervisor.statuses["one"].pid or 0
        assert os.getpgid(pid) == pid
        assert os.getsid(pid) == pid


async def test_children_of_a_dead_process_are_ended() -> None:
    code = "p = subprocess.Popen(['sleep', '60']); say('ready', child_pid=p.pid); sys.exit(1)"
    async with running(spec("driver", code)) as (supervisor, records):
        await until(lambda: supervisor.deaths)
        pid = next(r["child_pid"] for _, r in records.all if r["event"] == "ready")
        await until(lambda: not alive(pid))


DIES_WITH_SUPERVISOR = CHILD + "lifeline.die_with_supervisor(); "


async def test_no_process_is_left_when_the_supervisor_is_killed() -> None:
    with another_supervisor(
        obedient=DIES_WITH_SUPERVISOR + SERVE,
        hanging=DIES_WITH_SUPERVISOR + HANG,
        frozen=DIES_WITH_SUPERVISOR + SERVE,
        watched=CHILD + "lifeline.watch_parent(os.getppid()); " + HANG,
    ) as (parent, pids):
        if sys.platform == "linux":
            await freeze(pids["frozen"])
        parent.kill()
        await until(lambda: not any(alive(pid) for pid in pids.values()))


async def test_a_second_ctrl_c_leaves_no_process() -> None:
    with another_supervisor(hanging=CHILD + HANG, other=CHILD + HANG) as (parent, pids):
        parent.send_signal(signal.SIGINT)
        await asyncio.sleep(0.1)
        parent.send_signal(signal.SIGINT)
        await until(lambda: not any(alive(pid) for pid in pids.values()))
        await until(lambda: parent.poll() is not None)


async def test_an_abandoned_process_is_reaped_without_the_loop() -> None:
    child = await _abandoned()
    with pytest.raises(ProcessLookupError):
        os.kill(child.pid, 0)


def test_an_abandoned_process_ends_on_uvloop_too() -> None:
    uvloop = pytest.importorskip("uvloop")

    async def ended() -> bool:
        child = await _abandoned()
        await until(lambda: not state(child.pid))  # reaped
        return True

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        assert runner.run(ended())


async def _abandoned() -> Child:
    child = await Child.start("mine", (sys.executable, "-c", CHILD + SERVE), os.environ, print)
    child.abandon()
    return child
