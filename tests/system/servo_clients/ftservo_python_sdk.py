"""Talk to an arm with ftservo-python-sdk 2.0.1: `python ftservo_python_sdk.py PORT SECONDS`.

The SDK gives up after 34 ms; a busy machine may answer later, so each call is repeated.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import scservo_sdk as sdk

SERVOS = range(1, 7)
ATTEMPTS = 20
line = sdk.PortHandler(sys.argv[1])
bus = sdk.sms_sts(line)


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
    pings = [call_until_success(bus.ping, servo) for servo in SERVOS]
    before = [call_until_success(bus.ReadPos, servo)[0] for servo in SERVOS]
    for servo in (1, 2, 3):
        call_until_success(bus.write1ByteTxRx, servo, sdk.SMS_STS_TORQUE_ENABLE, 1)
    written = call_until_success(bus.WritePosEx, 1, 2200, 1500, 100)
    for servo, goal in ((2, 1400), (3, 2600)):
        assert bus.SyncWritePosEx(servo, goal, 1500, 100)
    assert bus.groupSyncWrite.txPacket() == sdk.COMM_SUCCESS
    time.sleep(float(sys.argv[2]))
    sync_read = sdk.GroupSyncRead(bus, sdk.SMS_STS_PRESENT_POSITION_L, 4)
    for servo in SERVOS:
        sync_read.addParam(servo)
    read = call_until_success(sync_read.txRxPacket)
    print(json.dumps({
        "models": [model for model, _, _ in pings],
        "results": [result for _, result, _ in pings] + [*written, read],
        "before": before,
        "after": [sync_read.getData(s, sdk.SMS_STS_PRESENT_POSITION_L, 2) for s in SERVOS],
        "missing": bus.ping(7)[1],
    }))  # fmt: skip


main()
