"""Quality of service of ROS 2: the policies that decide whether messages arrive."""

from dataclasses import dataclass

MAX_DEPTH = 1000  # messages in a publisher's history, or in a reader's queue


@dataclass(frozen=True)
class Qos:
    """The QoS that a publisher offers, or that a subscriber requests."""

    reliable: bool = True
    transient_local: bool = False  # a late reader receives the last `depth` messages
    depth: int = 10

    def __post_init__(self) -> None:
        if not 1 <= self.depth <= MAX_DEPTH:
            raise ValueError(f"depth {self.depth}: expected 1 to {MAX_DEPTH}")

    def __str__(self) -> str:
        reliability = "reliable" if self.reliable else "best effort"
        durability = "transient local" if self.transient_local else "volatile"
        return f"{reliability}, {durability}, depth {self.depth}"


DEFAULT = Qos()
SENSOR_DATA = Qos(reliable=False, depth=5)
LATCHED = Qos(transient_local=True, depth=1)  # /map, /tf_static, /robot_description
SERVICES = Qos()
ACTION_STATUS = Qos(transient_local=True, depth=1)


def mismatch(offered: Qos, requested: Qos) -> str:
    """Return why DDS does not match a publisher with a subscriber; empty if it does.

    `rmw_zenoh` always matches, but a volatile publisher has no old messages for a late reader.
    """
    if requested.reliable and not offered.reliable:
        return "the publisher is best effort, the subscriber wants reliable"
    if requested.transient_local and not offered.transient_local:
        return "the publisher is volatile, the subscriber wants transient local"
    return ""
