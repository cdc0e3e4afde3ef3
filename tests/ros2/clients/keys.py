"""Prints the keys of pamoja-ros2 for lines of JSON on stdin."""

import json
import sys

from pamoja import ros2

for line in sys.stdin:
    domain, topic, type_name, type_hash = json.loads(line)
    print(
        json.dumps(
            {
                "key": ros2.entity_key(domain, topic, type_name, type_hash),
                "type": ros2.dds_type_name(type_name),
                "mangled": ros2.percent_mangle(topic),
                "valid": ros2.is_valid_name(topic),
            }
        )
    )
