"""Serves `robot/param/<process>`, and logs who changed which parameter."""

import logging

from gigabrain_schemas.requests import ParamReply, ParamRequest
from gigabrain_schemas.topics import PARAM
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.granting import grant
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.host.log_text import LEVELS

LOG_LEVEL = "log_level"  # does not affect behaviour, so a change need not be recorded

log = logging.getLogger(__name__)


def serve_params(bus: Bus) -> None:
    """Serve this process's parameters, including its log level."""
    bus.params.add(LOG_LEVEL, f"one of: {', '.join(LEVELS)}", _level, _set_level)

    async def answer(request: ParamRequest) -> ParamReply:
        if not request.name:
            return ParamReply(ok=True, text="", params=bus.params.all())
        data = {"event": "param", "name": request.name, "source": request.source}
        try:
            before, now = bus.params.change(request.name, request.value)
        except Refused as error:
            log.warning("param refused to %s: %s", request.source, error, extra={"data": data})
            return ParamReply(ok=False, text=str(error)[:500], params=bus.params.all())
        if request.name != LOG_LEVEL:
            grant(bus, PARAM.at(bus.process), request, bus.time.tick)
        text = f"{request.name} is {now} now, it was {before}"
        log.info("param by %s: %s", request.source, text, extra={"data": data})
        return ParamReply(ok=True, text=text, params=bus.params.all())

    bus.serve(PARAM, answer, name=bus.process)


def _level() -> str:
    return logging.getLevelName(logging.getLogger().level).lower()


def _set_level(text: str) -> None:
    if text not in LEVELS:
        raise ValueError(text)
    logging.getLogger().setLevel(text.upper())
