"""Somebody behind a proxy, who hears what comes through."""

import asyncio
import contextlib
from collections.abc import AsyncIterator


class Server:
    """Takes what comes, and has a writer for each caller."""

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
    """A server, and the port that it listens at."""
    served = Server()
    listening = await asyncio.start_server(served.serve, "127.0.0.1", 0)
    async with listening:
        yield served, listening.sockets[0].getsockname()[1]
    for writer in served.writers:
        writer.close()
