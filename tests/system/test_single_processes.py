"""Processes started one by one: they wait for their router, can be ended, and run only once."""

import signal

import pytest

from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import Home, free_port
from gigabrain_zenoh.testing.waiting import until


async def test_a_process_waits_for_a_missing_router_with_one_line(home: Home) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    perception = home.start("perception", "--connect", where)
    waiting = f"no router at {where} yet; waiting for it (start one with: gigabrain router)"
    await until(lambda: waiting in perception.err, "it says what it waits for")
    home.start("router", "--listen", where)
    await until(lambda: "ready" in perception.err, "it goes on")
    assert perception.err.count("\n") == 2
    perception.send(signal.SIGINT)
    assert await perception.ended() == 0


async def test_tools_find_a_robot_that_was_started_process_by_process(home: Home) -> None:
    listen = f"tcp/0.0.0.0:{free_port()}"
    where = listen.replace("0.0.0.0", "127.0.0.1")
    router = home.start("router", "--listen", listen, "--insecure")
    driver = home.start("driver", "run", "mock", "--connect", where)
    await until(lambda: "ready" in driver.err, "the driver")
    listed = await home.run("node", "list")
    assert (await listed.ended(), "driver" in listed.out, listed.err) == (0, True, "")
    other = home.start("router", "--listen", f"tcp/127.0.0.1:{free_port()}")
    await until(lambda: "ready" in other.err, "a second router")
    why = await home.run("why")
    assert why.err.startswith("gigabrain: several robots run here; choose one with --connect: ")
    assert (await why.ended(), why.out) == (1, "")
    router.send(signal.SIGTERM)
    assert await router.ended() == 0


async def test_a_process_waiting_for_its_router_can_be_ended(home: Home) -> None:
    control = home.start("control", "--connect", f"tcp/127.0.0.1:{free_port()}")
    await until(lambda: "waiting for it" in control.err, "it waits")
    control.send(signal.SIGTERM)
    assert await control.ended() == 0


async def test_a_second_driver_for_the_same_body_is_refused_in_one_line(home: Home) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    home.start("router", "--listen", where)
    first = home.start("driver", "run", "mock", "--connect", where)
    await until(lambda: "ready" in first.err, "the first driver")
    second = await home.run("driver", "run", "mock", "--connect", where)
    assert await second.ended() == 2
    assert f"a driver is already running here (pid {first.pid} on " in second.err
    assert second.err.count("\n") == 1
    namesake = home.start(
        "driver", "run", "mock", "--connect", where, "--namespace", "other"
    )  # fmt: skip
    await until(lambda: "ready" in namesake.err, "a driver in a namespace of its own")


@pytest.mark.slow
async def test_of_two_drivers_started_together_exactly_one_remains(home: Home) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    home.start("router", "--listen", where)
    both = [home.start("driver", "run", "mock", "--connect", where) for _ in range(2)]
    await until(lambda: not all(driver.running for driver in both), "one of them leaves")
    (left,) = [driver for driver in both if not driver.running]
    (stays,) = [driver for driver in both if driver.running]
    assert await left.ended() == 2
    assert f"a driver is already running here (pid {stays.pid} on " in left.err
    async with probing(Endpoint(connect=(where,))) as robot:
        await robot.ticks(250)  # until the remaining one has settled
        replies = await robot.bus.ask(DESCRIBE, DescribeRequest(), name="driver", timeout_s=20)
        assert [(one.pid, one.claim) for one in replies] == [(stays.pid, "settled")]


@pytest.mark.slow
async def test_a_suspended_process_that_was_replaced_exits_when_resumed(home: Home) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    router = home.start("router", "--listen", where)
    await until(lambda: "ready" in router.err, "the router")
    first = home.start("driver", "run", "mock", "--connect", where)
    async with probing(Endpoint(connect=(where,))) as robot:
        await robot.ticks(250)  # until the driver has settled
        first.send(signal.SIGSTOP)  # Ctrl-Z
        second = home.start("driver", "run", "mock", "--connect", where)
        await until(lambda: "ready" in second.err, "the second driver")
        await robot.ticks(250)
    first.send(signal.SIGCONT)
    assert await first.ended() == 2
    assert f"a driver is already running here (pid {second.pid} on " in first.err
    assert second.running
