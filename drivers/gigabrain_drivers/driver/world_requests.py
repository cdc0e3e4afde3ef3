"""Serves requests to change a simulated world; accepted ones are logged for recordings."""

import logging
from collections.abc import Awaitable, Callable

from gigabrain_schemas.sim import SimReply, SimRequest
from gigabrain_schemas.topics import SIM_CHANGE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.errors import GigabrainError

log = logging.getLogger(__name__)


def serve_world(bus: Bus, change: Callable[[SimRequest], Awaitable[SimReply]]) -> None:
    """Answer SIM_CHANGE by `change`; errors are part of the reply."""

    async def answer(request: SimRequest) -> SimReply:
        try:
            reply = await change(request)
        except GigabrainError as error:
            return SimReply(ok=False, text=str(error)[:500])
        if reply.ok and request.do != "list":
            log_accepted(bus, SIM_CHANGE.key, request, bus.time.tick)
            data = {"event": "world", "source": request.source}
            log.info("world, by %s: %s", request.source, reply.text, extra={"data": data})
        return reply

    bus.serve(SIM_CHANGE, answer)
