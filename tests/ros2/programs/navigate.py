"""Sends goals to action servers of any type.

Commands: `available`, `send` (a goal with a name), `cancel`. Events with that name: `accepted` or
`rejected`, `feedback`, `cancelled` (the response to the request), `result` with its status.
"""

import time
from typing import Any

from rclpy.action import ActionClient

from tests.ros2.programs.console import start
from tests.ros2.programs.events import emit
from tests.ros2.programs.messages import find, make, to_json

STATUS = ("unknown", "accepted", "executing", "canceling", "succeeded", "canceled", "aborted")


def main() -> None:
    """Run until stdin ends."""
    console = start()
    clients: dict[str, ActionClient] = {}
    goals: dict[str, Any] = {}

    def client(action: str, type: str) -> ActionClient:
        if action not in clients:
            clients[action] = ActionClient(console.node, find(type), action)
        return clients[action]

    def available(action: str, type: str) -> dict[str, Any]:
        return {"available": client(action, type).server_is_ready()}

    def send(action: str, type: str, name: str, goal: dict[str, Any]) -> None:
        sent_ns = time.monotonic_ns()

        def feedback(message: Any) -> None:
            emit("feedback", name=name, value=to_json(message.feedback))

        def result(done: Any) -> None:
            answer = done.result()
            value = to_json(answer.result)
            emit("result", name=name, status=STATUS[answer.status], value=value)

        def decided(done: Any) -> None:
            handle = goals[name] = done.result()
            took_s = (time.monotonic_ns() - sent_ns) / 1e9
            if not handle.accepted:
                emit("rejected", name=name, took_s=took_s)
                return
            emit("accepted", name=name, took_s=took_s)
            handle.get_result_async().add_done_callback(result)

        message = make(find(type).Goal, goal)
        sending = client(action, type).send_goal_async(message, feedback_callback=feedback)
        sending.add_done_callback(decided)

    def cancel(name: str) -> None:
        def show(done: Any) -> None:
            answer = done.result()
            emit("cancelled", name=name, code=answer.return_code, goals=len(answer.goals_canceling))

        goals[name].cancel_goal_async().add_done_callback(show)

    console.commands |= {"available": available, "send": send, "cancel": cancel}
    console.run()


if __name__ == "__main__":
    main()
