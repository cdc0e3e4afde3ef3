"""Somebody behind a proxy, who hears what comes through."""

import asyncio


class Server:
    """Takes what comes, and has a writer for each caller."""

    def __init__(self) -> None:
        self.heard = bytearray()
        self.ends: list[str] = []
        self.writers: list[asyncio.StreamWriter] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        try:
            while data := await reader.read(65536):
                self.heard += data
            self.ends.append("fin")
        except ConnectionResetError:
            self.ends.append("rst")
        finally:
            writer.close()
