"""Serves services and actions, for our clients and for tests of these programs.

Commands: `service` (a constant response to each request), `action` (sends feedback at a rate, then
its result; a new goal preempts the previous one, as in Nav2). Each request is an event.
"""

from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future

from tests.ros2.programs.console import Console, start
from tests.ros2.programs.events import emit
from tests.ros2.programs.messages import find, make, to_json


class Action:
    """An action server that pursues one goal at a time."""

    def __init__(self, console: Console, action: str, type: str, **settings: Any) -> None:
        self._node, self._type, self._action = console.node, find(type), action
        self._accept = settings.get("accept", True)
        self._feedback = [make(self._type.Feedback, each) for each in settings.get("feedback", [])]
        self._period_s = 1 / settings.get("hz", 20.0)
        self._result = make(self._type.Result, settings.get("result", {}))
        self._outcome = settings.get("outcome", "succeed")
        self._newest: Any = None
        self._server = ActionServer(
            self._node,
            self._type,
            action,
            execute_callback=self._run,
            goal_callback=self._decide,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def _decide(self, goal: Any) -> GoalResponse:
        emit("goal", action=self._action, value=to_json(goal))
        return GoalResponse.ACCEPT if self._accept else GoalResponse.REJECT

    async def _run(self, goal: Any) -> Any:
        """Send all feedback, then end the goal with the configured outcome."""
        self._newest = goal
        for message in self._feedback:
            await self._sleep()
            if goal.is_cancel_requested:
                goal.canceled()
                return self._type.Result()
            if self._newest is not goal:
                goal.abort()
                return self._type.Result()
            goal.publish_feedback(message)
        getattr(goal, self._outcome)()
        return self._result

    async def _sleep(self) -> None:
        """Wait for one period without blocking the executor."""
        over: Future = Future(executor=self._node.executor)
        timer = self._node.create_timer(self._period_s, lambda: over.set_result(None))
        await over
        self._node.destroy_timer(timer)


def main() -> None:
    """Run until stdin ends."""
    console = start()
    servers: list[Any] = []

    def service(service: str, type: str, **response: Any) -> None:
        def answer(request: Any, _: Any) -> Any:
            emit("request", service=service, value=to_json(request))
            return make(find(type).Response, response)

        servers.append(console.node.create_service(find(type), service, answer))

    def action(action: str, type: str, **settings: Any) -> None:
        servers.append(Action(console, action, type, **settings))

    console.commands |= {"service": service, "action": action}
    console.run()


if __name__ == "__main__":
    main()
