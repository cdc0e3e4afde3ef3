"""A decision of one's own in Python, with Zenoh and JSON, and without this package.

python drive.py tcp/127.0.0.1:7447 [SECONDS]. It drives on while there is room, and turns otherwise.
The deployment file leaves out `decision`, whose place this program takes.
"""

import json
import sys
import time

import msgspec
import zenoh

state: dict = {}
world: dict = {}


def keep(into: dict, sample: zenoh.Sample) -> None:
    """Keep the newest message. It is a map in MessagePack, or in JSON."""
    data = sample.payload.to_bytes()
    is_json = "json" in str(sample.encoding)
    into.update(json.loads(data) if is_json else msgspec.msgpack.decode(data))


def intent(number: int) -> dict:
    """Return the wish for what is seen now, with the header that the gate asks for."""
    free = world["scan_ok"] and not world["obstacle_ahead"]
    twist = {"linear_x": 0.1} if free else {"angular_z": 0.4}
    return {
        "twist": twist,
        "behaviour": "mine",
        "reason": "driving on" if free else "turning to where there is room",
        "boot": state["boot"],  # which start of the driver: copied from the state
        "tick": state["tick"],  # the newest time that was seen: copied from the state
        "basis": world["basis"],  # what it rests on: copied from the data that was looked at
        "seq": number,
        "stamp_ns": time.time_ns(),
    }


if len(sys.argv) not in (2, 3):
    sys.exit("usage: python drive.py tcp/127.0.0.1:7447 [SECONDS]")
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
end = time.monotonic() + float(sys.argv[2] if len(sys.argv) > 2 else 10)
with zenoh.open(config) as session:
    subscribers = [
        session.declare_subscriber("robot/state", lambda sample: keep(state, sample)),
        session.declare_subscriber("robot/world", lambda sample: keep(world, sample)),
    ]
    publisher = session.declare_publisher("robot/intent", encoding="application/json")
    sent, last = 0, {}
    while time.monotonic() < end:
        time.sleep(0.02)  # intents are promised at 50 Hz; after 0.1 s of silence the robot stops
        if state and world and state["boot"] == world["boot"]:
            sent += 1
            last = intent(sent)
            publisher.put(json.dumps(last))
    for subscriber in subscribers:
        subscriber.undeclare()
if not state:
    sys.exit("no intents: nothing on robot/state; is the driver running?")
if not last:
    sys.exit("no intents: nothing on robot/world of this driver; is perception running?")
print(f"{sent} intents, the last one: {last['reason']}")
