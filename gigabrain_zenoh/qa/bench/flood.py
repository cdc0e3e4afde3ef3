"""Floods a robot's network: what an e-stop has to get through. A process of its own.

Started as `python -m gigabrain_zenoh.qa.bench.flood ENDPOINT`, with an Endpoint in JSON.
"""

import asyncio
import os
import sys
from collections.abc import Callable

import msgspec

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import CMD_VEL, IMAGE
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.bench.group import client

RATE_HZ = 100.0
PICTURE_BYTES = 1_000_000
COMMANDS = 10  # with each picture: 1000 a second, of somebody who has not asked for the body


async def flood(endpoint: Endpoint, ready: Callable[[], None]) -> None:
    """Pictures and commands until it is ended; the pictures are listened to, else none would go."""
    picture = Image(frame_id="flood", encoding="jpeg", height=1, width=1, data=bytes(PICTURE_BYTES))
    command = CmdVel(linear_x=0.2, source="flood")
    async with client(endpoint) as bus, client(endpoint) as listener:
        listener.subscribe(IMAGE, lambda _key, _picture: None)
        ready()
        async for _ in bus.clock.every(round(1e9 / RATE_HZ)):
            bus.publish(IMAGE, picture, name="flood")
            for _ in range(COMMANDS):
                bus.publish(CMD_VEL, command)


def main() -> None:
    """Entry of the process."""
    this_process.die_with_supervisor()
    endpoint = msgspec.json.decode(sys.argv[1], type=Endpoint)
    asyncio.run(flood(endpoint, lambda: print('{"event": "ready"}', flush=True)))
    os._exit(0)  # Zenoh's threads must not keep it alive


if __name__ == "__main__":
    main()
