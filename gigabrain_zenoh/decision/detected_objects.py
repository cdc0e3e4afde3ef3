"""Objects found by perceptors: input of behaviours, and obstacles if marked `avoid`."""

import math
from collections.abc import Mapping

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import DetectedObject, Objects, WorldModel
from gigabrain_schemas.topics import PERCEIVED
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import Latest
from gigabrain_zenoh.geometry.pose import PoseHistory, to_frame
from gigabrain_zenoh.host.bounded import put_newest

MAX_PERCEPTORS = 32
RIM_STEP_M = 0.05  # between points on an object's rim: the planner's cells are not smaller
MAX_RIM_POINTS = 256  # of one object
ObjectsByPerceptor = Mapping[str, Objects]


class DetectedObjects:
    """The newest objects of each perceptor."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._newest: dict[str, Latest[Objects]] = {}
        self._history = PoseHistory()
        bus.subscribe(PERCEIVED, self._add)

    def _add(self, key: str, objects: Objects) -> None:
        name = key.removeprefix(f"{PERCEIVED.key}/")
        latest = self._newest.get(name) or Latest(PERCEIVED, self._bus.clock, self._bus.time)
        latest.store(objects)
        put_newest(self._newest, name, latest, MAX_PERCEPTORS)

    def observe(self, state: RobotState) -> None:
        """Record the odometry; called with every state."""
        self._history = self._history.then(state)

    def fresh(self) -> dict[str, Objects]:
        """Return the newest objects by perceptor, without silent perceptors."""
        found = ((name, latest.fresh()) for name, latest in self._newest.items())
        return {name: objects for name, objects in found if objects}

    def merged(self, world: WorldModel) -> WorldModel:
        """Return `world` with the objects marked `avoid` added to its hits and obstacles."""
        pose = self._history.at(world.boot, world.basis)
        return with_objects(world, pose, self.fresh()) if pose else world


def with_objects(world: WorldModel, pose: Pose, found: ObjectsByPerceptor) -> WorldModel:
    """Return `world`, at `pose`, with the objects marked `avoid`, moved on to its tick.

    Their rims become hits of the scan. They are obstacles as well, so that the planner uses their
    velocities.
    """
    avoided = [
        _moved(one, (world.basis - objects.basis) * TICK_NS / 1e9)
        for objects in found.values()
        for one in objects.objects
        if one.avoid
    ]
    if not avoided:
        return world
    import numpy as np  # not needed without perceptors

    from gigabrain_schemas.arrays import hits_bytes

    points = np.array([point for one in avoided for point in _rim(one, pose)])
    hits = world.hits + hits_bytes(points[:, 0], points[:, 1])
    return replace(world, hits=hits, obstacles=(*avoided, *world.obstacles))


def _moved(one: DetectedObject, seconds: float) -> DetectedObject:
    """Return an object moved on by `seconds`, at its current velocity."""
    x, y = one.x + one.velocity_x * seconds, one.y + one.velocity_y * seconds
    return replace(one, x=x, y=y)


def _rim(one: DetectedObject, pose: Pose) -> list[tuple[float, float]]:
    """Return points on the rim of an object [m], in the frame of a body at `pose`."""
    count = min(MAX_RIM_POINTS, max(1, math.ceil(math.tau * one.radius / RIM_STEP_M)))
    angles = (math.tau * i / count for i in range(count))
    return [
        to_frame(pose, one.x + one.radius * math.cos(a), one.y + one.radius * math.sin(a))
        for a in angles
    ]
