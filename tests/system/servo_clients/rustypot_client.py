"""Talk to an arm with rustypot 1.13.1: `python rustypot_client.py PORT SECONDS`."""

import json
import sys
import time

from rustypot import Sts3215PyController

SERVOS = list(range(1, 7))


def main() -> None:
    bus = Sts3215PyController(sys.argv[1], 1_000_000, 0.1)
    pings = [bool(bus.ping(servo)) for servo in SERVOS]
    models = [bus.read_register(servo, "model") for servo in SERVOS]
    before = bus.sync_read_raw_data(SERVOS, 56, 2)
    bus.sync_write_raw_data([1, 2, 3], 40, [[1], [1], [1]])
    bus.write_raw_data(1, 42, list((2200).to_bytes(2, "little")))
    goals = [list(goal.to_bytes(2, "little")) for goal in (1400, 2600)]
    bus.sync_write_raw_data([2, 3], 42, goals)
    time.sleep(float(sys.argv[2]))
    after = bus.sync_read_raw_data(SERVOS, 56, 2)
    try:
        missing = bool(bus.ping(7))
    except (OSError, RuntimeError):
        missing = False
    print(json.dumps({
        "pinged": pings, "models": models, "before": words(before), "after": words(after),
        "volts": bus.sync_read_present_voltage(SERVOS), "missing": missing,
    }))  # fmt: skip


def words(rows: list[list[int]]) -> list[int]:
    return [row[0] | row[1] << 8 for row in rows]


main()
