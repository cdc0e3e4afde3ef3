"""Processes one by one: they wait for their router, can be ended, and none starts twice."""

import signal

from tests.stack import Home, free_port, until


async def test_a_missing_router_is_waited_for_and_said_in_one_line(home: Home) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    perception = home.start("perception", "--connect", where)
    waiting = f"no router at {where} yet; waiting for it (start one with: gigabrain router)"
    await until(lambda: waiting in perception.err, "it says what it waits for")
    home.start("router", "--listen", where)
    await until(lambda: "ready" in perception.err, "it goes on")
    assert perception.err.count("\n") == 2
    perception.send(signal.SIGINT)
    assert await perception.ended() == 0


async def test_a_process_that_waits_for_its_router_can_be_ended(home: Home) -> None:
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
