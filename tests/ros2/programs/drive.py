"""Publishes commands at a rate, and single messages of any type.

Commands: `drive`, `rest` (Twist or TwistStamped), `advertise`, `publish`, `readers`, `endpoints`.
Each message of `drive` is also an event `sent`, so that the last one is known after a kill.
"""

from typing import Any

from rclpy.publisher import Publisher

from tests.ros2.programs.console import endpoints, profile, start
from tests.ros2.programs.events import emit
from tests.ros2.programs.messages import find, make

TWIST = "geometry_msgs/msg/Twist"


def stamp(message: Any, now_ns: int, frame: str) -> None:
    """Fill in the header of a TwistStamped."""
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)


def main() -> None:
    """Run until stdin ends."""
    console = start()
    node = console.node
    publishers: dict[str, Publisher] = {}
    timers: dict[str, Any] = {}

    def publisher(topic: str, type: str, qos: dict[str, Any]) -> Publisher:
        if topic not in publishers:
            publishers[topic] = node.create_publisher(find(type), topic, profile(**qos))
        return publishers[topic]

    def publish(topic: str, type: str, value: dict[str, Any], **qos: Any) -> None:
        publisher(topic, type, qos).publish(make(find(type), value))

    def drive(
        linear: float,
        angular: float = 0.0,
        hz: float = 20.0,
        topic: str = "/cmd_vel",
        type: str = TWIST,
        frame: str = "base_link",
        late_s: float = 0.0,
    ) -> None:
        twist, stamped = {"linear": {"x": linear}, "angular": {"z": angular}}, type != TWIST
        message = make(find(type), {"twist": twist} if stamped else twist)
        to = publisher(topic, type, {})

        def send() -> None:
            if stamped:
                stamp(message, node.get_clock().now().nanoseconds - int(late_s * 1e9), frame)
            emit("sent", topic=topic)
            to.publish(message)

        rest(topic)
        timers[topic] = node.create_timer(1 / hz, send)
        send()

    def rest(topic: str = "/cmd_vel") -> None:
        if topic in timers:
            node.destroy_timer(timers.pop(topic))

    console.commands |= {
        "advertise": lambda topic, type, **qos: publisher(topic, type, qos) and None,
        "publish": publish,
        "drive": drive,
        "rest": rest,
        "readers": lambda topic: {"readers": publishers[topic].get_subscription_count()},
        "endpoints": lambda topic: endpoints(node, topic),
    }
    console.run()


if __name__ == "__main__":
    main()
