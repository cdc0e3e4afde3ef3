"""Calls services of any type.

Commands: `available` (whether there is a server), `call` (reports response and duration).
"""

import time
from typing import Any

from rclpy.client import Client

from tests.ros2.programs.console import start
from tests.ros2.programs.events import emit
from tests.ros2.programs.messages import find, make, to_json


def main() -> None:
    """Run until stdin ends."""
    console = start()
    clients: dict[str, Client] = {}

    def client(service: str, type: str) -> Client:
        if service not in clients:
            clients[service] = console.node.create_client(find(type), service)
        return clients[service]

    def available(service: str, type: str) -> dict[str, Any]:
        return {"available": client(service, type).service_is_ready()}

    def call(service: str, type: str, name: str = "", **request: Any) -> None:
        sent_ns = time.monotonic_ns()
        future = client(service, type).call_async(make(find(type).Request, request))

        def show(done: Any) -> None:
            now_ns = time.monotonic_ns()
            emit(
                "response",
                at_ns=now_ns,
                name=name,
                service=service,
                sent_ns=sent_ns,
                took_s=(now_ns - sent_ns) / 1e9,
                value=to_json(done.result()),
            )

        future.add_done_callback(show)

    console.commands |= {"available": available, "call": call}
    console.run()


if __name__ == "__main__":
    main()
