"""Talk to an arm with feetech-servo-sdk 1.0.0: `python feetech_servo_sdk.py PORT SECONDS`.

The SDK gives up after 34 ms; a busy machine may answer later, so each call is repeated.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import scservo_sdk as sdk

SERVOS = range(1, 7)
MODEL, TORQUE, GOAL, POSITION = 3, 40, 42, 56
ATTEMPTS = 20
line = sdk.PortHandler(sys.argv[1])
bus = sdk.PacketHandler(0)


def call_until_success(call: Callable[..., Any], *arguments: Any) -> Any:
    """Call until the SDK reports success; its result is the last but one value, or the only one."""
    for _ in range(ATTEMPTS):
        line.ser.reset_input_buffer()
        answer = call(*arguments)
        if (answer[-2] if isinstance(answer, tuple) else answer) == sdk.COMM_SUCCESS:
            break
        time.sleep(0.1)
    return answer


def main() -> None:
    assert line.openPort()
    pings = [call_until_success(bus.ping, line, servo) for servo in SERVOS]
    before = [call_until_success(bus.read2ByteTxRx, line, servo, POSITION)[0] for servo in SERVOS]
    for servo in (1, 2, 3):
        call_until_success(bus.write1ByteTxRx, line, servo, TORQUE, 1)
    written = call_until_success(bus.write2ByteTxRx, line, 1, GOAL, 2200)
    group = sdk.GroupSyncWrite(line, bus, GOAL, 2)
    for servo, goal in ((2, 1400), (3, 2600)):
        assert group.addParam(servo, list(goal.to_bytes(2, "little")))
    assert group.txPacket() == sdk.COMM_SUCCESS
    time.sleep(float(sys.argv[2]))
    sync_read = sdk.GroupSyncRead(line, bus, POSITION, 2)
    for servo in SERVOS:
        sync_read.addParam(servo)
    read = call_until_success(sync_read.txRxPacket)
    print(json.dumps({
        "models": [model for model, _, _ in pings],
        "results": [result for _, result, _ in pings] + [*written, read],
        "before": before,
        "after": [sync_read.getData(servo, POSITION, 2) for servo in SERVOS],
        "missing": bus.ping(line, 7)[1],
    }))  # fmt: skip


main()
