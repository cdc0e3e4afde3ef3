"""`gigabrain proxy`: a bad network, between a robot and its router."""

import asyncio
import re

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.faults.call import Address
from gigabrain_zenoh.faults.chaos import CALM, WAYS, Told, told
from gigabrain_zenoh.faults.proxy import TcpProxy
from gigabrain_zenoh.typed import typed_lines

ENDPOINT = re.compile(r"(?:(?:tcp|tls|ws)/)?(?P<host>\[[^\]]+\]|[^/:\[\]]+):(?P<port>\d+)")


def proxy(to: str, *, listen: str = "tcp/127.0.0.1:0", chaos: str = "", seed: int = 0) -> int:
    """Stand in front of a router, or of a body's TCP port, and spoil the line, until Ctrl-C.

    Example: gigabrain proxy tcp/127.0.0.1:7447 --listen tcp/127.0.0.1:7448

    In another terminal: gigabrain control --connect tcp/127.0.0.1:7448

    What goes wrong is typed in, one line each: `delay_ms=50 jitter_ms=20`, `down hole`,
    `corrupt=0.001`, `cut=rst`, `figures`, `off`.

    Parameters
    ----------
    to
        What it stands in front of: a Zenoh endpoint, or HOST:PORT.
    listen
        Where it listens; port 0 for any free one.
    chaos
        What goes wrong from the start, in the same words.
    seed
        For what is left to chance.
    """
    begin = told(chaos)
    asyncio.run(_stand(TcpProxy(_address(to), _address(listen), seed=seed), begin))
    return 0


async def _stand(proxy: TcpProxy, begin: Told) -> None:
    async with proxy:
        host, port = proxy.address
        _say(f"{host}:{port} leads to what is spoiled")
        _say(f"type [{'|'.join(WAYS)}] {' '.join(CALM.__struct_fields__)}; "
             "cut[=rst] unplug plug figures; off ends it")  # fmt: skip
        wishes: asyncio.Queue[str] = asyncio.Queue()
        await obey(proxy, begin)
        with typed_lines(wishes.put_nowait):
            while True:
                try:
                    await obey(proxy, told(await wishes.get()))
                except ConfigError as error:
                    _say(str(error))


async def obey(proxy: TcpProxy, wish: Told) -> None:
    """Do what a typed line asks for."""
    if wish.cut:
        proxy.cut(reset=wish.cut == "rst")
    if wish.unplugged is not None:
        await (proxy.unplug if wish.unplugged else proxy.plug)()
    if wish.figures:
        _say(f"{proxy.open_calls} of {proxy.calls} calls open, {proxy.cuts} cut")
        for way, figures in proxy.figures.items():
            _say(f"{way}: {figures}")
    if wish.ways:
        proxy.set(wish.chaos, *wish.ways)


def _address(text: str) -> Address:
    found = ENDPOINT.fullmatch(text)
    if not found or int(found["port"]) > 65535:
        raise ConfigError(f"expected an endpoint such as tcp/127.0.0.1:7447, got {text!r}")
    return found["host"].strip("[]"), int(found["port"])


def _say(line: str) -> None:
    print(line, flush=True)
