"""A node of zenoh-ros2-sdk that echoes strings, serves a service, and calls one of ours.

Started as `python sdk.py PORT` with a router on the loopback; prints a line of JSON for each event.
"""

import json
import sys
import time

from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber

STRING, SET_BOOL = "std_msgs/msg/String", "std_srvs/srv/SetBool"
TEXT, REQUEST, RESPONSE = "string data\n", "bool data\n", "bool success\nstring message\n"
WAIT_S = 60.0


def print_event(**fields: object) -> None:
    """Print an event."""
    print(json.dumps(fields), flush=True)


def main() -> None:
    """Run until stdin ends."""
    where = {"router_port": int(sys.argv[1]), "domain_id": 0}
    back = ROS2Publisher("/back", STRING, TEXT, **where)

    def echo(message: object) -> None:
        print_event(got=message.data)
        back.publish(data=f"re {message.data}")

    def answer(request: object) -> object:
        return server.response_msg_class(success=request.data, message="theirs")

    subscriber = ROS2Subscriber("/chatter", STRING, echo, TEXT, node_name="sdk", **where)
    server = ROS2ServiceServer("/theirs", SET_BOOL, answer, REQUEST, RESPONSE, **where)
    client = ROS2ServiceClient("/estop", SET_BOOL, REQUEST, RESPONSE, **where)
    print_event(ready=True)
    end_s = time.monotonic() + WAIT_S
    while not (response := client.call(data=True)) and time.monotonic() < end_s:
        time.sleep(0.1)
    print_event(response=[response.success, response.message] if response else None)
    sys.stdin.read()
    for each in (subscriber, server, client, back):
        each.close()


if __name__ == "__main__":
    main()
