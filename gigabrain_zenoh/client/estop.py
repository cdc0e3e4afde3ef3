"""Presses the e-stop again and again until a body has confirmed it."""

import asyncio

from gigabrain_schemas.requests import EstopRequest, GateReply
from gigabrain_schemas.topics import ESTOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import NotConfirmed, Refused

FIRST_S, AGAIN_S = 0.15, 0.05  # until the request is repeated, and from then on
GIVE_UP_S = 2.0
LAST_LOOK_S = 0.05  # at answers that came while this process was held up
BY_HAND = "press the hardware e-stop or cut the robot's power"

Asks = set[asyncio.Task[list[GateReply]]]


async def press(bus: Bus, reason: str = "", *, within_s: float = GIVE_UP_S) -> GateReply:
    """Stop the body, and latch it. Raises NotConfirmed when none has said so in time."""
    loop = asyncio.get_running_loop()
    request = EstopRequest(source=bus.process or "anonymous", reason=reason)
    end_s, pause_s, refused = loop.time() + within_s, FIRST_S, ""
    asks: Asks = set()
    try:
        while (left_s := end_s - loop.time()) > 0:
            asks.add(asyncio.create_task(bus.ask(ESTOP, request, timeout_s=left_s)))
            reply, said = await _answer(asks, min(pause_s, left_s))
            if reply:
                return reply
            refused, pause_s = said or refused, AGAIN_S
        reply, said = await _answer(asks, LAST_LOOK_S)
        if reply:
            return reply
        refused = said or refused
    finally:
        for ask in asks:
            ask.cancel()
        await asyncio.gather(*asks, return_exceptions=True)
    why = refused or "no driver answers"
    raise NotConfirmed(f"NOT CONFIRMED: {why}; {BY_HAND}")


async def _answer(asks: Asks, within_s: float) -> tuple[GateReply | None, str]:
    """The first confirmation that comes in time, else what was said instead."""
    loop = asyncio.get_running_loop()
    end_s, refused = loop.time() + within_s, ""
    while asks and (left_s := end_s - loop.time()) > 0:
        done, _ = await asyncio.wait(asks, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
        asks -= done
        for ask in done:
            try:
                latched = [reply for reply in ask.result() if reply.gate.mode == "latched"]
            except Refused as error:
                refused = str(error)
                continue
            if latched:
                return latched[0], ""
    await asyncio.sleep(max(0.0, end_s - loop.time()))
    return None, refused
