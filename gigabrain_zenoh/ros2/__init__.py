"""Connects to ROS 2: message types, QoS, and two transports, `rmw_zenoh` and `dds`.

It may import bus, config and host. Only this room imports rosbags and cyclonedds.
The gateway, drivers of ROS 2 robots, commands and qa may import it. It knows no robot.
"""

from importlib.util import find_spec

from gigabrain_zenoh.errors import ConfigError

if not all(find_spec(name) for name in ("rosbags", "xxhash")):
    raise ConfigError("ROS 2 needs more packages: pip install 'gigabrain-zenoh[ros2]'")
