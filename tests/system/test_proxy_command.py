"""The command `gigabrain proxy`: it causes the requested faults, and refuses impossible ones."""

import asyncio
import signal
from collections.abc import AsyncIterator

import pytest

from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.system.server import Server, serving


@pytest.fixture
async def server() -> AsyncIterator[tuple[Server, int]]:
    async with serving() as made:
        yield made


async def test_the_command_causes_the_requested_faults(
    home: Home, server: tuple[Server, int]
) -> None:
    command = home.start("proxy", f"tcp/127.0.0.1:{server[1]}", "--chaos", "down hole")
    await until(lambda: "forwards to" in command.out, "it listens")
    host, _, port = command.out.split()[0].rpartition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(b"question")
    await asyncio.sleep(0.1)
    assert server[0].received == b""  # a hole lets no connection through
    command.send(signal.SIGINT)
    assert await command.ended() == 130
    with pytest.raises(ConnectionResetError):
        await reader.read()
    writer.close()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("nowhere",), "expected an endpoint such as tcp/127.0.0.1:7447, got 'nowhere'"),
        (("tcp/127.0.0.1:99999",), "expected an endpoint such as tcp/127.0.0.1:7447"),
        (("tcp/127.0.0.1:7447", "--chaos", "hol"), "no fault 'hol'; did you mean 'hole'?"),
    ],
)
async def test_impossible_options_are_refused(
    home: Home, arguments: tuple[str, ...], complaint: str
) -> None:
    command = await home.run("proxy", *arguments)
    assert await command.ended() == 2
    assert complaint in command.err
