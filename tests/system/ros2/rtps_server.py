"""Serves SetBool until it is killed: `rtps_server.py DOMAIN SERVICE NAME`.

Its replies hold NAME, so that a test knows which of several servers answered.
"""

import asyncio
import sys

from gigabrain_zenoh.ros2.rtps import RequestReply, ServiceType
from gigabrain_zenoh.ros2.types import Types

SET_BOOL = "std_srvs/srv/SetBool"


async def main(domain: int, service: str, name: str) -> None:
    """Serve until the process is killed."""
    types = Types()
    reply = types.make(f"{SET_BOOL}_Response", success=True, message=name)
    payload = types.encode(f"{SET_BOOL}_Response", reply)

    async def answer(_: bytes) -> bytes:
        return payload

    bus = await RequestReply.open(domain, localhost=True)
    bus.serve(service, ServiceType(SET_BOOL), answer)
    print("up", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), sys.argv[2], sys.argv[3]))
