"""Serialises and deserialises by ROS itself, and lists its type hashes; needs no network.

Commands: `hashes` (of all installed types, from their descriptions), `serialize`, `deserialize`.
"""

import json
import sys
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from tests.ros2.programs.events import emit
from tests.ros2.programs.messages import find, make, to_json


def hashes() -> dict[str, Any]:
    """Return the hashes of all installed messages, services and actions, and of their parts."""
    found: dict[str, str] = {}
    for kind in ("msg", "srv", "action"):
        for path in sorted(Path(sys.prefix, "share").glob(f"*/{kind}/*.json")):
            described = json.loads(path.read_text())
            for entry in described.get("type_hashes", ()):
                found[entry["type_name"]] = entry["hash_string"]
    return {"hashes": found}


def serialize(type: str, value: dict[str, Any]) -> dict[str, Any]:
    """Serialise a message by ROS."""
    return {"payload": serialize_message(make(find(type), value)).hex()}


def deserialize(type: str, payload: str) -> dict[str, Any]:
    """Deserialise a message by ROS."""
    return {"value": to_json(deserialize_message(bytes.fromhex(payload), find(type)))}


def main() -> None:
    """Run until stdin ends."""
    commands = {"hashes": hashes, "serialize": serialize, "deserialize": deserialize}
    emit("ready")
    for line in sys.stdin:
        command = json.loads(line)
        do, number = command.pop("do"), command.pop("id")
        emit(do, id=number, **commands[do](**command))


if __name__ == "__main__":
    main()
