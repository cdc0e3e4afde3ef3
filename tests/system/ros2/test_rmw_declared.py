"""Zenoh declarations of `rmw_zenoh`, in a separate process, because they could hang."""

import subprocess
import sys

from gigabrain_zenoh.testing.processes import free_port

WITHDRAWING = """
import json, os, sys, threading, time
from gigabrain_zenoh.bus.zenoh.config import ZENOH_RUNTIME
os.environ["ZENOH_RUNTIME"] = ZENOH_RUNTIME
import zenoh
from zenoh.handlers import Callback
from gigabrain_zenoh.ros2.qos import Qos
from gigabrain_zenoh.ros2.rmw_declared import advanced_publisher

def opened(end):
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(f"{end}/endpoints", json.dumps(["tcp/127.0.0.1:" + sys.argv[1]]))
    return zenoh.open(config)

arrived, over = threading.Event(), threading.Event()

def waits_for_the_gil(sample):
    arrived.set()
    time.sleep(0.001)

def flood():
    while not over.is_set():
        there.put("flood", b"x")
        time.sleep(0.0005)

here, there = opened("listen"), opened("connect")
watch = here.declare_subscriber("flood", Callback(waits_for_the_gil, indirect=False))
flooding = threading.Thread(target=flood)
flooding.start()
arrived.wait()
for number in range(30):
    qos = Qos(reliable=True, transient_local=True, depth=1)
    publisher = advanced_publisher(here, f"latched/{number}", qos)
    publisher.put(b"1")
    publisher.undeclare()
over.set()
flooding.join()
there.close()
here.close()
"""


def test_a_latched_publisher_is_withdrawn_while_messages_arrive() -> None:
    command = [sys.executable, "-c", WITHDRAWING, str(free_port())]
    subprocess.run(command, check=True, timeout=60.0)
