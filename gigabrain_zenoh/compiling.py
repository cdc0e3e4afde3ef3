"""Compiling what a driving robot calls, before it drives."""

import asyncio
import logging
from collections.abc import Callable

log = logging.getLogger(__name__)

QUIET_S = 5.0  # of compiling, before people are told


async def compiled(warm_up: Callable[[], None]) -> None:
    """Have `warm_up` call all that is to be compiled, beside the loop, and say so if that lasts."""
    compiling = asyncio.ensure_future(asyncio.to_thread(warm_up))
    done, _ = await asyncio.wait((compiling,), timeout=QUIET_S)
    if not done:
        told = {"event": "compiling"}
        log.info("compiling: the first start takes about a minute", extra={"data": told})
    await compiling
