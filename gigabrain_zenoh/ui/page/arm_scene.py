"""An arm in three dimensions for browsers, if no simulation publishes its world."""

import itertools
import struct
from collections.abc import Iterable

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sim import SHAPE_KINDS, SimPoses, SimScene
from gigabrain_zenoh.geometry.link_model import AXES, LinkModel, Place, turn

NAME_PREFIX = "robot/"  # of a link's name in the scene, as in a simulation
_versions = itertools.count(1)


class ArmScene:
    """The shapes of an arm as a scene whose bodies are its links."""

    def __init__(self, links: LinkModel) -> None:
        self._links = links
        self._version = next(_versions)

    def scene(self) -> SimScene:
        """Return the shapes; they do not change."""
        shapes = self._links.shapes
        return SimScene(
            version=self._version,
            world="arm",
            bodies=("", *(f"{NAME_PREFIX}{link.name}" for link in self._links.links)),
            kinds=bytes(SHAPE_KINDS.index(shape.kind) for shape in shapes),
            owners=struct.pack(f"<{len(shapes)}H", *(shape.link + 1 for shape in shapes)),
            sizes=_packed(value for shape in shapes for value in shape.size),
            places=_poses(shape.place for shape in shapes),
            colours=bytes(
                round(255 * max(0.0, min(1.0, value))) for shape in shapes for value in shape.colour
            ),
        )

    def poses(self, state: RobotState, base: Pose) -> SimPoses:
        """Return the poses of the links, with the robot at `base`."""
        measured = {joint.name: joint.position for joint in state.joints}
        base_place = Place((base.x, base.y, 0.0), turn(AXES["z"], base.yaw))
        places = self._links.places_in_base(measured)
        return SimPoses(version=self._version, poses=_poses(base_place @ place for place in places))


def _poses(places: Iterable[Place]) -> bytes:
    return _packed(value for place in places for value in (*place.position, *place.rotation))


def _packed(values: Iterable[float]) -> bytes:
    numbers = tuple(values)
    return struct.pack(f"<{len(numbers)}f", *numbers)
