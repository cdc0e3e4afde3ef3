"""A TCP server behind a proxy, which records what it receives."""

import asyncio
import contextlib
from collections.abc import AsyncIterator


class Server:
    """Records received bytes and ends of connections, and has a writer for each caller."""

    def __init__(self) -> None:
        self.received = bytearray()
        self.ends: list[str] = []
        self.writers: list[asyncio.StreamWriter] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        try:
            while data := await reader.read(65536):
                self.received += data
            self.ends.append("fin")
        except ConnectionResetError:
            self.ends.append("rst")
        finally:
            writer.close()


@contextlib.asynccontextmanager
async def serving() -> AsyncIterator[tuple[Server, int]]:
    """Run a server; yield it and its port."""
    server = Server()
    listening = await asyncio.start_server(server.serve, "127.0.0.1", 0)
    async with listening:
        yield server, listening.sockets[0].getsockname()[1]
    for writer in server.writers:
        writer.close()
