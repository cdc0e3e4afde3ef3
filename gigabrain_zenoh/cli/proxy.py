"""`gigabrain proxy`: a bad network, between a robot and its router."""

import asyncio
import re
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Protocol

import msgspec

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.network import is_loopback
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.host.terminal import typed_lines
from gigabrain_zenoh.qa.proxy.chaos import (
    CALM,
    WAYS,
    Chaos,
    ProxyCommand,
    Way,
    WayCounters,
    parse_command,
)
from gigabrain_zenoh.qa.proxy.tcp import Address, TcpProxy

ENDPOINT = re.compile(r"(?:(?:tcp|tls|ws)/)?(?P<host>\[[^\]]+\]|[^/:\[\]]+):(?P<port>\d+)")


def proxy(
    to: str,
    *,
    listen: str = "tcp/127.0.0.1:0",
    baud: int = 115200,
    chaos: str = "",
    seed: int = 0,
    insecure: bool = False,
) -> int:
    """Stand in front of a router or of a body's port, and spoil the line, until Ctrl-C.

    Example: gigabrain proxy tcp/127.0.0.1:7447 --listen tcp/127.0.0.1:7448

    In another terminal: gigabrain control --connect tcp/127.0.0.1:7448

    What goes wrong is typed in, one line each: `delay_ms=50 jitter_ms=20`, `down hole`,
    `corrupt=0.001`, `cut=rst`, `figures`, `off`.

    Parameters
    ----------
    to
        What it stands in front of: a Zenoh endpoint, HOST:PORT, or the path of a serial port.
    listen
        Where it is instead; port 0 for any free one. For a serial port, the path of the new one.
    baud
        Of a serial port.
    chaos
        What goes wrong from the start, in the same words.
    seed
        For what is left to chance.
    insecure
        Let others on the network reach it too, and through it what is behind.
    """
    begin = parse_command(chaos)
    if to.startswith("/"):
        from gigabrain_zenoh.qa.proxy.serial import LineProxy

        made: Spoiled = LineProxy(to, _path(listen), baud=baud, seed=seed)
    else:
        made = TcpProxy(_address(to), _own(listen, insecure), seed=seed)
    run_async(_stand(made, begin, to))
    return 0


class Spoiled(AbstractAsyncContextManager[object], Protocol):
    """A proxy for any kind of line."""

    figures: dict[Way, WayCounters]

    def set(self, chaos: Chaos = CALM, *ways: Way) -> None:
        """Have this go wrong."""

    def cut(self, *, reset: bool = False) -> None:
        """End what is open."""

    async def plug(self) -> None:
        """Be there."""

    async def unplug(self) -> None:
        """Be gone."""


async def _stand(proxy: Spoiled, begin: ProxyCommand, to: str) -> None:
    async with proxy:
        await obey(proxy, begin)
        _say(f"{proxy} leads to {to}, and spoils it as it is told")
        _say(f"type [{'|'.join(WAYS)}] {' '.join(CALM.__struct_fields__)}; "
             "cut[=rst] unplug plug figures; off ends it")  # fmt: skip
        wishes: asyncio.Queue[str] = asyncio.Queue()
        with typed_lines(wishes.put_nowait):
            while True:
                try:
                    await obey(proxy, parse_command(await wishes.get()))
                except ConfigError as error:
                    _say(str(error))


async def obey(proxy: Spoiled, wish: ProxyCommand) -> None:
    """Do what a typed line asks for."""
    if wish.cut:
        proxy.cut(reset=wish.cut == "rst")
    if wish.unplugged is not None:
        await (proxy.unplug if wish.unplugged else proxy.plug)()
    if wish.figures:
        for way, figures in proxy.figures.items():
            _say(f"{way}: {msgspec.json.encode(figures).decode()}")
    if wish.ways:
        proxy.set(wish.chaos, *wish.ways)


def _path(listen: str) -> Path:
    if "/" not in listen or listen.startswith("tcp/"):
        raise ConfigError(f"--listen: expected the path of the new port, got {listen!r}")
    return Path(listen)


def _own(listen: str, insecure: bool) -> Address:
    address = _address(listen)
    if not insecure and not is_loopback(address[0]):
        raise ConfigError(
            f"--listen: {listen} can be reached by anybody on the network, and so can what is "
            "behind it; use a loopback address, or say --insecure"
        )
    return address


def _address(text: str) -> Address:
    found = ENDPOINT.fullmatch(text)
    if not found or int(found["port"]) > 65535:
        raise ConfigError(f"expected an endpoint such as tcp/127.0.0.1:7447, got {text!r}")
    return found["host"].strip("[]"), int(found["port"])


def _say(line: str) -> None:
    print(line, flush=True)
