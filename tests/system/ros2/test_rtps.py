"""Our services, called by rclpy over Fast DDS, and services of rclpy, called by us."""

import asyncio
import contextlib
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gigabrain_zenoh.errors import NoAnswer, Refused
from gigabrain_zenoh.ros2.rtps import RequestReply, ServiceType
from gigabrain_zenoh.ros2.rtps_discovery import participant_ports
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.waiting import PATIENCE_S, until
from tests.places import ROOT
from tests.ros2.judge import Judge, Program, free_domain

SET_BOOL, TRIGGER = "std_srvs/srv/SetBool", "std_srvs/srv/Trigger"
GET_MAP, SET_MAP = "nav_msgs/srv/GetMap", "nav_msgs/srv/SetMap"
ESTOP = {"service": "/estop", "type": SET_BOOL}


class Bus:
    """Our participant, with messages instead of payloads."""

    def __init__(self, bus: RequestReply, types: Types) -> None:
        self.bus, self.types = bus, types
        self.requests: list[Any] = []

    def kind(self, name: str) -> ServiceType:
        halves = (self.types.hash(f"{name}_{half}") for half in ("Request", "Response"))
        return ServiceType(name, *halves)

    def serve(self, service: str, type: str, wait_s: float = 0.0, **fields: Any):
        reply = self.types.make(f"{type}_Response", **fields)
        payload = self.types.encode(f"{type}_Response", reply)

        async def answer(request: bytes) -> bytes:
            self.requests.append(self.types.decode(f"{type}_Request", request))
            await asyncio.sleep(wait_s)
            return payload

        return self.bus.serve(service, self.kind(type), answer)

    async def call(self, service: str, type: str, timeout_s: float = 30.0, **fields: Any) -> Any:
        request = self.types.make(f"{type}_Request", **fields)
        payload = self.types.encode(f"{type}_Request", request)
        reply = await self.bus.call(service, self.kind(type), payload, timeout_s)
        return self.types.decode(f"{type}_Response", reply)


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


@pytest.fixture
async def bus(judge: Judge, types: Types) -> AsyncIterator[Bus]:
    opened = await RequestReply.open(judge.domain, localhost=True)
    yield Bus(opened, types)
    await opened.close()


async def calls(program: Program, count: int, service: str, type: str, **request: Any):
    """Call a service `count` times, one after the other; return the responses."""
    responses = []
    for number in range(count):
        name = f"{service}-{len(program.seen('response'))}-{number}"
        await asyncio.to_thread(
            program.send, "call", service=service, type=type, name=name, **request
        )
        responses.append(await program.wait_async("response", name=name))
    return responses


@contextmanager
def server(domain: int, service: str, name: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run our server in a separate process."""
    script = Path(__file__).with_name("rtps_server.py")
    command = [sys.executable, str(script), str(domain), service, name]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE)
    try:
        assert process.stdout
        assert process.stdout.readline() == b"up\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


async def test_rclpy_receives_the_reply_of_our_server(judge: Judge, bus: Bus) -> None:
    bus.serve("/estop", SET_BOOL, success=True, message="stopped")
    call = judge.start("call")
    await call.available(**ESTOP)

    (response,) = await calls(call, 1, **ESTOP, data=True)

    assert response["value"] == {"success": True, "message": "stopped"}
    assert [request.data for request in bus.requests] == [True]


async def test_a_client_that_started_first_finds_our_server(judge: Judge, bus: Bus) -> None:
    call = judge.start("call")
    assert not (await call.query("available", **ESTOP))["available"]
    bus.serve("/estop", SET_BOOL, success=True)
    await call.available(**ESTOP)

    assert (await calls(call, 1, **ESTOP, data=True))[0]["value"]["success"]


async def test_our_server_is_found_beside_many_other_participants(
    judge: Judge, types: Types
) -> None:
    with contextlib.ExitStack() as others:
        for index in range(40):  # more than ROS announces to without multicast
            for port in participant_ports(judge.domain, index):
                taken = others.enter_context(socket.socket(type=socket.SOCK_DGRAM))
                taken.bind(("", port))
        bus = Bus(await RequestReply.open(judge.domain, localhost=True), types)
        try:
            bus.serve("/estop", SET_BOOL, success=True)
            call = judge.start("call")
            await call.available(**ESTOP)
            (response,) = await calls(call, 1, **ESTOP, data=True)
            assert response["value"]["success"]
        finally:
            await bus.bus.close()


@pytest.mark.slow
async def test_a_thousand_requests_get_a_thousand_replies(judge: Judge, bus: Bus) -> None:
    bus.serve("/estop", SET_BOOL, success=True, message="stopped")
    bus.serve("/release", TRIGGER, success=False, message="it is still moving")
    call = judge.start("call")
    await call.available(**ESTOP)
    await call.available(service="/release", type=TRIGGER)

    stopped = await calls(call, 500, **ESTOP, data=True)
    released = await calls(call, 500, "/release", TRIGGER)

    assert all(each["value"] == {"success": True, "message": "stopped"} for each in stopped)
    refused = {"success": False, "message": "it is still moving"}
    assert all(each["value"] == refused for each in released)
    took_ms = sorted(1e3 * each["took_s"] for each in (*stopped, *released))
    print(f"median {statistics.median(took_ms):.2f} ms, p99 {took_ms[989]:.2f} ms")


@pytest.mark.slow
async def test_many_simultaneous_requests_are_all_answered(judge: Judge, bus: Bus) -> None:
    bus.serve("/estop", SET_BOOL, wait_s=0.05, success=True)
    programs = [await asyncio.to_thread(judge.start, "call", f"call{n}") for n in range(3)]
    for program in programs:
        await program.available(**ESTOP)
        for number in range(8):  # the history of an rclpy client holds 10
            program.send("call", **ESTOP, name=str(number), data=True)

    for program in programs:
        for number in range(8):
            assert (await program.wait_async("response", name=str(number)))["value"]["success"]


async def test_replies_and_requests_longer_than_a_datagram_arrive(judge: Judge, bus: Bus) -> None:
    cells = [(3 * n) % 101 for n in range(300_000)]
    grid = bus.types.make("nav_msgs/msg/OccupancyGrid", data=cells)
    bus.serve("/map", GET_MAP, map=grid)
    bus.serve("/set_map", SET_MAP, success=True)
    call = judge.start("call")
    await call.available(service="/map", type=GET_MAP)
    await call.available(service="/set_map", type=SET_MAP)

    (fetched,) = await calls(call, 1, "/map", GET_MAP)
    (stored,) = await calls(call, 1, "/set_map", SET_MAP, map={"data": cells[:200_000]})

    assert fetched["value"]["map"]["data"] == cells
    assert stored["value"]["success"]
    assert bus.requests[-1].map.data.tolist() == cells[:200_000]


@pytest.mark.slow
async def test_a_server_is_found_again_after_its_process_was_killed(judge: Judge) -> None:
    call = judge.start("call")
    with server(judge.domain, "/estop", "first"):
        await call.available(**ESTOP)
        (response,) = await calls(call, 1, **ESTOP, data=True)
        assert response["value"]["message"] == "first"
    with server(judge.domain, "/estop", "second"):
        began = time.monotonic()
        while call.seen("response")[-1]["value"]["message"] != "second":
            assert time.monotonic() < began + PATIENCE_S
            call.send("call", **ESTOP, name="again", data=True)
            await asyncio.sleep(0.05)
        print(f"found again in {time.monotonic() - began:.2f} s")


@pytest.mark.slow
async def test_two_servers_in_two_processes_answer_their_services(judge: Judge) -> None:
    call = judge.start("call")
    with server(judge.domain, "/left/estop", "left"), server(judge.domain, "/right/estop", "right"):
        for name in ("left", "right"):
            await call.available(service=f"/{name}/estop", type=SET_BOOL)
            (response,) = await calls(call, 1, f"/{name}/estop", SET_BOOL, data=True)
            assert response["value"]["message"] == name


@pytest.mark.slow  # ROS gives its participants a lease of 20 s
async def test_a_client_killed_while_it_waits_is_forgotten(judge: Judge, bus: Bus) -> None:
    served = bus.serve("/estop", SET_BOOL, wait_s=1.0, success=True)
    call = judge.start("call")
    await call.available(**ESTOP)
    for number in range(5):
        call.send("call", **ESTOP, name=str(number), data=True)
    await until(lambda: len(bus.requests) == 5, "five requests")
    call.kill()

    await until(lambda: not bus.bus.participant.remotes, "the lease has ended")
    await until(lambda: not served.pending, "replies are dropped")
    assert served.clients == 0

    later = judge.start("call", "later")
    await later.available(**ESTOP)
    assert (await calls(later, 1, **ESTOP, data=True))[0]["value"]["success"]


async def test_our_client_receives_the_reply_of_an_rclpy_server(judge: Judge, bus: Bus) -> None:
    serve = judge.start("serve")
    serve.ask("service", **ESTOP, success=True, message="stopped")

    for number in range(20):
        reply = await bus.call("/estop", SET_BOOL, data=bool(number % 2))
        assert (reply.success, reply.message) == (True, "stopped")

    await serve.wait_async("request", nth=19)  # the event may be read a little after the reply
    values = [each["value"]["data"] for each in serve.seen("request")]
    assert values == [False, True] * 10


async def test_our_client_waits_for_a_server_that_starts_later(judge: Judge, bus: Bus) -> None:
    called = asyncio.create_task(bus.call("/estop", SET_BOOL, data=True))
    serve = await asyncio.to_thread(judge.start, "serve")
    await serve.query("service", **ESTOP, success=True, message="late")

    assert (await called).message == "late"


async def test_without_a_server_a_call_ends_in_time(judge: Judge, bus: Bus) -> None:
    with pytest.raises(NoAnswer, match=r"/estop: no server within 0\.2 s"):
        await bus.call("/estop", SET_BOOL, timeout_s=0.2, data=True)


async def test_a_request_that_is_refused_gets_no_reply(judge: Judge, bus: Bus) -> None:
    async def refuse(request: bytes) -> bytes:
        raise Refused("not now")

    other = await RequestReply.open(judge.domain, localhost=True)
    other.serve("/estop", bus.kind(SET_BOOL), refuse)
    with pytest.raises(NoAnswer, match="/estop: no reply within 1 s"):
        await bus.call("/estop", SET_BOOL, timeout_s=1, data=True)
    await other.close()


async def test_ros_lists_our_services_with_their_hashes(judge: Judge, bus: Bus) -> None:
    bus.serve("/estop", SET_BOOL, success=True)
    graph = judge.start("graph")
    found = await asyncio.to_thread(
        graph.poll, "graph", lambda found: "/estop" in found["services"]
    )

    assert found["services"]["/estop"] == [SET_BOOL]


async def test_our_participants_find_each_other_by_multicast(types: Types) -> None:
    with free_domain() as domain:
        each, two = await RequestReply.open(domain), await RequestReply.open(domain)
        Bus(each, types).serve("/estop", SET_BOOL, success=True)
        assert (await Bus(two, types).call("/estop", SET_BOOL, data=True)).success
        await each.close()
        await two.close()
