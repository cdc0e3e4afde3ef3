"""Serialises and deserialises by ROS itself, and tells its type hashes; needs no network.

Commands: `hashes` (of all installed types, from their descriptions), `serialize`, `deserialize`.
"""

import json
import sys
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from tests.ros2.programs.messages import find, make, to_json
from tests.ros2.programs.say import say


def hashes() -> dict[str, Any]:
    """Return the hash of each installed message, service and action, and of their parts."""
    found: dict[str, str] = {}
    for kind in ("msg", "srv", "action"):
        for path in sorted(Path(sys.prefix, "share").glob(f"*/{kind}/*.json")):
            described = json.loads(path.read_text())
            for entry in described.get("type_hashes", ()):
                found[entry["type_name"]] = entry["hash_string"]
    return {"hashes": found}


def serialize(type: str, value: dict[str, Any]) -> dict[str, Any]:
    """Return a message as ROS serialises it."""
    return {"payload": serialize_message(make(find(type), value)).hex()}


def deserialize(type: str, payload: str) -> dict[str, Any]:
    """Return a message as ROS deserialises it."""
    return {"value": to_json(deserialize_message(bytes.fromhex(payload), find(type)))}


def main() -> None:
    """Run until stdin ends."""
    commands = {"hashes": hashes, "serialize": serialize, "deserialize": deserialize}
    say("ready")
    for line in sys.stdin:
        command = json.loads(line)
        do, number = command.pop("do"), command.pop("id")
        say(do, id=number, **commands[do](**command))


if __name__ == "__main__":
    main()
