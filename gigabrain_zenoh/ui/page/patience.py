"""How long a browser may be connected without asking for anything."""

import asyncio
from typing import Final

from uvicorn.protocols.http.h11_impl import H11Protocol

ASK_S: Final = 5.0  # until a whole request has to be there
ROOM: Final = 64  # connections that may wait for one; the oldest gives way to the newest


class Impatient(H11Protocol):
    """Hangs up on whoever connects and is silent, so that silence keeps nobody else out."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """One more connection."""
        super().connection_made(transport)
        self._since_s = self.loop.time()
        self._watching = self.loop.call_later(ASK_S, self._look)
        silent = [c for c in self.connections if isinstance(c, Impatient) and c.silent]
        if len(silent) > ROOM:
            min(silent, key=lambda connection: connection._since_s).transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """It has gone, or we have hung up."""
        self._watching.cancel()
        super().connection_lost(exc)

    @property
    def silent(self) -> bool:
        """Whether nothing that it has asked for is under way."""
        return not self.transport.is_closing() and (
            self.cycle is None or self.cycle.response_complete
        )

    def _look(self) -> None:
        if self.transport.get_protocol() is not self:
            return  # a WebSocket by now, which has a login of its own to wait for
        if self.silent:
            self.transport.close()
        self._watching = self.loop.call_later(ASK_S, self._look)
