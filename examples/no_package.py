"""Listen to a robot without gigabrain_zenoh: plain Zenoh and MessagePack.

python no_package.py tcp/127.0.0.1:7447. Any language with both can do this.
"""

import sys
import time

import msgspec
import zenoh

if len(sys.argv) != 2:
    sys.exit("usage: python no_package.py tcp/127.0.0.1:7447")
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')


state: dict = {}


def show(sample: zenoh.Sample) -> None:
    state.update(msgspec.msgpack.decode(sample.payload.to_bytes()))
    pose = state["pose"]
    print(f"tick {state['tick']}: x {pose['x']:.2f} m, y {pose['y']:.2f} m")


with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("robot/state", show)
    time.sleep(1.0)
    subscriber.undeclare()
if not state:
    sys.exit("nothing on robot/state; is the driver running?")
