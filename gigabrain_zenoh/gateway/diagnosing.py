"""Publishes /diagnostics once a second while ROS reads it."""

from collections.abc import Callable, Iterable

from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import SAFETY
from gigabrain_zenoh.bus.freshness import Latest
from gigabrain_zenoh.diagnostics.robot_view import ProcessHealth
from gigabrain_zenoh.gateway.conversions import diagnostics
from gigabrain_zenoh.gateway.conversions.diagnostics import Status
from gigabrain_zenoh.gateway.scene import Scene
from gigabrain_zenoh.ros2.qos import DEFAULT
from gigabrain_zenoh.ros2.transport import RosTransport
from gigabrain_zenoh.ros2.types import Types

TYPE = "diagnostic_msgs/msg/DiagnosticArray"
PERIOD_NS = 1_000_000_000


class Diagnosing:
    """Health of processes, gate, safety and battery, and commands that the gateway refuses."""

    def __init__(
        self,
        scene: Scene,
        ros: RosTransport,
        types: Types,
        own: Callable[[], Iterable[Status]],
    ) -> None:
        self._scene, self._types, self._own = scene, types, own
        self._health: ProcessHealth | None = None  # while there are readers
        self._safety: Latest[SafetyState] | None = None
        self._close_safety: Callable[[], None] = lambda: None
        self._publisher = ros.publisher("diagnostics", TYPE, DEFAULT, self._count)

    async def run(self) -> None:
        """Publish until cancelled."""
        async for _ in self._scene.bus.clock.every(PERIOD_NS):
            if self._health:
                self._publisher.publish(self.encoded(self._health))

    def encoded(self, processes: ProcessHealth) -> bytes:
        """Return the present array as CDR."""
        bus, description = self._scene.bus, self._scene.description
        robot = description.robot_type if description else ""
        made = diagnostics.array(
            self._types.make, self._scene.ros_ns(), robot, self._statuses(processes)
        )
        bus.counters["published"] += 1
        return self._types.encode(TYPE, made)

    def _statuses(self, processes: ProcessHealth) -> Iterable[Status]:
        state, about, now_ns = (
            self._scene.fresh_state, self._scene.description, self._scene.bus.clock.now_ns(),
        )  # fmt: skip
        yield diagnostics.of_gate(state)
        yield diagnostics.of_safety(self._safety.fresh() if self._safety else None)
        if state and state.battery and about:
            yield diagnostics.of_battery(state.battery, about.thresholds)
        for name, health in sorted(processes.newest.items()):
            yield diagnostics.of_process(health, now_ns - processes.arrived_ns[name])
        yield from self._own()

    def _count(self, readers: int) -> None:
        if readers and self._health is None:
            bus = self._scene.bus
            self._health = ProcessHealth(bus)
            self._safety = Latest(SAFETY, bus.clock, bus.time)
            self._close_safety = bus.subscribe(SAFETY, self._store)
        elif not readers and self._health:
            self._health.close()
            self._close_safety()
            self._health = self._safety = None

    def _store(self, _key: str, verdict: SafetyState) -> None:
        if self._safety:
            self._safety.store(verdict)
