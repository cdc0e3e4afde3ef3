"""Somebody who may talk, and does not stop: commands and questions by the thousand, large messages.

Its commands call themselves the most urgent of all, and wait for nobody.

For tests only. Started as
`python -m gigabrain_zenoh.qa.faults.flooder RATE_HZ LARGE_BYTES ENDPOINT`.
"""

import asyncio
import os
import sys
from dataclasses import replace

import msgspec

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, DESCRIBE, IMAGE, INTENT, SCAN, STATE, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.host import this_process

NAME = "flooder"
URGENT = replace(CMD_VEL, priority="real_time", express=True)
PERIOD_NS = 5_000_000
LARGE_PERIODS = 100  # one large message in so many, on one of these keys after the other
LARGE_KEYS = (IMAGE, SCAN, INTENT, TELEOP, CMD_VEL)
ASKED = DESCRIBE.at("driver")
ASKED_AT_ONCE, MAX_ASKED = 5, 2000  # questions in a period, and those that may be under way
ANSWER_S = 5.0


async def flood(rate_hz: int, large: bytes, endpoint: Endpoint) -> None:
    """Until it is ended."""
    at_once = rate_hz * PERIOD_NS // 1_000_000_000
    transport = await ZenohTransport.open(endpoint)
    bus = Bus(transport, Clock(), NAME)
    bus.latest(STATE)
    print("up", flush=True)
    periods, asked = 0, set[asyncio.Task[list[bytes | str]]]()
    async for _ in bus.clock.every(PERIOD_NS):
        for _ in range(at_once):
            bus.publish(URGENT, CmdVel(linear_x=0.2, source=NAME))
        for _ in range(min(ASKED_AT_ONCE, MAX_ASKED - len(asked))):
            question = transport.query(ASKED, b"", "", ANSWER_S, DESCRIBE.priority)
            asked.add(task := asyncio.create_task(question))
            task.add_done_callback(asked.discard)
        periods += 1
        if periods % LARGE_PERIODS == 0:
            topic = LARGE_KEYS[periods // LARGE_PERIODS % len(LARGE_KEYS)]
            transport.publish(topic, topic.at(NAME), large, "")
        if periods % 200 == 0:
            print(bus.sent[CMD_VEL.key], flush=True)


def main() -> None:
    """Entry of the process."""
    this_process.die_with_supervisor()
    os.nice(19)  # it stands for somebody on another machine: its work is not to cost the robot's
    rate_hz, large_bytes, endpoint = sys.argv[1:]
    where = msgspec.json.decode(endpoint, type=Endpoint)
    asyncio.run(flood(int(rate_hz), bytes(int(large_bytes)), where))
    os._exit(0)  # Zenoh's threads must not keep it alive


if __name__ == "__main__":
    main()
