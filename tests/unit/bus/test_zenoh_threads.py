"""At the end of a process Zenoh's threads have ended: one that has not may abort it."""

import asyncio
import json
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest
import zenoh

from gigabrain_schemas.topics import STATE
from gigabrain_zenoh.bus.zenoh import workarounds
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.testing.processes import free_endpoint

PROGRAM = """
import asyncio, sys, threading
from gigabrain_zenoh.bus.zenoh import session
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint

async def receive():
    transport = await ZenohTransport.open(Endpoint(connect=(sys.argv[1],)))
    arrived = asyncio.Event()
    for _ in range(20):
        transport.subscribe("flood", lambda key, payload: arrived.set(), 1)
    await arrived.wait()
    if sys.argv[2] == "closes":
        await transport.close()

session.CLOSE_S = 0.0
loop = asyncio.new_event_loop()
threading.Thread(target=loop.run_forever, daemon=True).start()
asyncio.run_coroutine_threadsafe(receive(), loop).result()
"""


def open_router(listen: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([listen] if listen else []))
    return zenoh.open(config)


@pytest.fixture
def flood() -> Iterator[str]:
    """Publish without a pause; yield the router's endpoint."""
    endpoint, ending = free_endpoint(), threading.Event()
    with open_router(endpoint) as router:
        publisher = router.declare_publisher("flood")

        def publish() -> None:
            while not ending.wait(0.001):
                publisher.put(b"data")

        thread = threading.Thread(target=publish)
        thread.start()
        yield endpoint
        ending.set()
        thread.join()


@pytest.mark.long
@pytest.mark.parametrize("way", ["closes", "leaves it open"])
def test_a_program_may_end_at_once(flood: str, way: str) -> None:
    for _ in range(5):
        command = (sys.executable, "-c", PROGRAM, flood, way)
        done = subprocess.run(command, capture_output=True, text=True, timeout=30)
        assert (done.returncode, done.stderr) == (0, "")


async def test_a_subscription_starts_no_thread() -> None:
    endpoint = free_endpoint()
    with open_router(endpoint):
        transport = await ZenohTransport.open(Endpoint(connect=(endpoint,)))
        before, arrived = {*threading.enumerate()}, asyncio.Event()
        for key in ("one", "two", "one"):
            transport.subscribe(key, lambda _key, _payload: arrived.set(), 1)
        transport.tap("**", lambda _key, _encoding, _payload: None)
        assert {*threading.enumerate()} <= before  # threads of other tests may end meanwhile
        transport.publish(STATE, "one", b"data", "")
        await asyncio.wait_for(arrived.wait(), 10.0)
        assert {*threading.enumerate()} <= before
        await transport.close()


@pytest.mark.parametrize("name", ["Thread-1 (pyo3-closure)", workarounds.CLOSING_THREAD])
def test_a_process_waits_for_its_threads(name: str) -> None:
    ending = threading.Event()
    thread = threading.Thread(target=ending.wait, args=(0.2,), name=name, daemon=True)
    thread.start()
    workarounds.await_zenoh_threads()
    assert not thread.is_alive()


def test_it_does_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workarounds, "CALLBACK_ENDS_S", 0.01)
    ending = threading.Event()
    thread = threading.Thread(target=ending.wait, name="Thread-1 (pyo3-closure)", daemon=True)
    thread.start()
    workarounds.await_zenoh_threads()
    assert thread.is_alive()
    ending.set()
    thread.join()


def test_zenoh_still_calls_its_threads_so() -> None:
    with open_router("") as session:
        before = set(threading.enumerate())
        session.declare_subscriber("callback/thread", lambda _: None)
        (started,) = set(threading.enumerate()) - before
        assert workarounds.CALLBACK_THREAD in started.name
