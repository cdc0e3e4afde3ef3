"""Faults between ROS and the gateway, for health: types, QoS, hashes, clocks, duplicate names."""

from collections.abc import Callable, Iterable, Mapping

from gigabrain_schemas.base import Cause
from gigabrain_zenoh.config.settings import DRIVER_NODE, Ros2Config
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gateway.conversions.diagnostics import Level, Status
from gigabrain_zenoh.ros2.graph import (
    CLOCK_S,
    SYNCHRONISE,
    clock_text,
    doubles,
    nameless,
    troubles,
    unreached,
)
from gigabrain_zenoh.ros2.rtps_sockets import outer_addresses
from gigabrain_zenoh.ros2.transport import RosTransport

MAX_CAUSES = 8
MAX_TEXT = 500
TOPIC_KINDS = ("publisher", "subscriber")
REJOIN = "restart the robot's processes, or the process ros2 alone"
CHECK_EVERY = 5  # calls of `look` between two checks of the graph


class GraphWatch:
    """Checks the graph every few seconds, because a graph of many nodes takes time."""

    def __init__(
        self, ros: RosTransport, config: Ros2Config, offsets_s: Callable[[], Iterable[float]]
    ) -> None:
        """`offsets_s` returns how far clocks of publishers of /cmd_vel are behind [s]."""
        self._ros, self._config, self._offsets_s = ros, config, offsets_s
        # this host's addresses when joining: Cyclone DDS keeps one of their interfaces
        bound = config.transport == "dds" and not config.localhost
        self._joined = outer_addresses() if bound else None
        self._calls = 0
        self.causes: tuple[Cause, ...] = ()

    def refuse_own_body(self) -> None:
        """Raise ConfigError if a ROS 2 robot's driver uses topics of the gateway.

        Its commands and scans would return to it through the gateway, and keep the robot moving.
        """
        endpoints = self._ros.endpoints()
        ours = {one.topic for one in endpoints if one.ours and one.kind in TOPIC_KINDS}
        theirs = [one for one in endpoints if one.node.rpartition("/")[2] == DRIVER_NODE]
        if shared := sorted(ours & {one.topic for one in theirs if not one.ours}):
            raise ConfigError(
                f"ros2: {theirs[0].node}, whose body is a ROS 2 robot, uses {', '.join(shared)} "
                "here as well: that robot's commands and scans would come to this one, or back to "
                "it; set another `namespace:`, such as /gigabrain, or another `domain:`"
            )

    def look(self) -> tuple[Cause, ...]:
        """Return the present faults; each fifth call checks again."""
        if self._calls % CHECK_EVERY == 0:
            self.causes = tuple(self._find())[:MAX_CAUSES]
        self._calls += 1
        return self.causes

    def status(self) -> Status:
        """Return a line of diagnostics."""
        if not self.causes:
            return Status("graph", Level.OK, "all ends match")
        return Status("graph", Level.WARN, "; ".join(one.text for one in self.causes))

    def report(self) -> Mapping[str, str | int]:
        """Return the gateway's connection to ROS, for `gigabrain doctor`."""
        config = self._config
        others = {one.node for one in self._ros.endpoints() if not one.ours}
        return {
            "transport": config.transport,
            "domain": config.domain,
            "node": f"{config.namespace.rstrip('/')}/{config.node}",
            "distro": config.distro,
            "localhost": int(config.localhost),
            "other_nodes": len(others),
            "to_check": "" if others else unreached(config.transport, config.domain, config.router),
        }

    def _find(self) -> Iterable[Cause]:
        endpoints = self._ros.endpoints()
        found = [*doubles(endpoints), *troubles(self._config, endpoints, ours_only=True)]
        if odd := nameless(self._config, endpoints):
            found.append(odd)
        for one in found:
            text = f"{one.topic}: {one.text}"[:MAX_TEXT]
            yield Cause(code=f"ros2_{one.kind}", text=text, remedy=one.remedy)
        if text := self._moved():
            yield Cause(code="ros2_network", text=text[:MAX_TEXT], remedy=REJOIN)
        for offset_s in self._offsets_s():
            if abs(offset_s) > CLOCK_S:
                text = f"/cmd_vel: the clock of a publisher is {clock_text(offset_s)}"
                yield Cause(code="ros2_clock", text=text, remedy=SYNCHRONISE)

    def _moved(self) -> str:
        """Return why other hosts may no longer see the topics; empty if they can."""
        now = outer_addresses()
        if self._joined is None or not now or self._joined & now:
            return ""
        then = ", ".join(sorted(self._joined)) or "127.0.0.1 only"
        return (
            f"the network has changed since the gateway joined DDS: then {then}, now "
            f"{', '.join(sorted(now))}; other hosts see its services, but not its topics"
        )
