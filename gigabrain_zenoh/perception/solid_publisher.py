"""Publishes the solids near the arm of a body with a depth camera on `robot/solids`."""

import logging
import math
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import ArmModel, BodyDescription, RobotState
from gigabrain_schemas.objects import Detections, Solids
from gigabrain_schemas.topics import ARM_MODEL, DETECTIONS, SOLIDS
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.geometry.pose import PoseHistory
from gigabrain_zenoh.perception.solid_memory import SolidMemory
from gigabrain_zenoh.vision.obstacle_contours import OwnPoints, Seen
from gigabrain_zenoh.vision.solid_fit import SolidFit
from gigabrain_zenoh.vision.solids import EDGE_PX, find_solids, is_gone

if TYPE_CHECKING:
    from gigabrain_zenoh.manipulation.arm_mask import ArmMask

KEPT_STATES = 50  # whose joint positions are kept until a picture of that time arrives
MAX_OFFSET_TICKS = (
    3  # from a picture to a state; meanwhile, joints move less than the mask's margin
)
log = logging.getLogger(__name__)


class SolidPublisher:
    """Tracks and publishes the solids near an arm. Runs on the event loop."""

    def __init__(self, bus: Bus, description: BodyDescription) -> None:
        self._bus, self._description = bus, description
        self._memory, self._history = SolidMemory(), PoseHistory()
        self._mask: ArmMask | None = None
        self._joints: deque[tuple[int, dict[str, float]]] = deque(maxlen=KEPT_STATES)
        self._unsubscribe = [
            bus.subscribe(ARM_MODEL, lambda _, model: self._on_model(model)),
            bus.subscribe(DETECTIONS, lambda _, found: self._on_detections(found)),
        ]

    def close(self) -> None:
        """End the subscriptions."""
        for unsubscribe in self._unsubscribe:
            unsubscribe()

    def on_state(self, state: RobotState) -> None:
        """Record the positions of joints and body. A restart of the driver clears everything."""
        if state.boot != self._history.boot:
            self._memory = SolidMemory()
            self._joints.clear()
        self._history = self._history.then(state)
        self._joints.append((state.tick, {one.name: one.position for one in state.joints}))

    def own(self, tick: int) -> OwnPoints | None:
        """Return a function that finds the arm's points in a picture of `tick`; None if unknown."""
        if self._mask is None or not self._joints:
            return None
        then, joints = min(self._joints, key=lambda one: abs(one[0] - tick))
        if abs(then - tick) > MAX_OFFSET_TICKS or not self._mask.knows(joints):
            return None
        return partial(self._mask.covers, joints=joints)

    @staticmethod
    def find(seen: Seen) -> tuple[SolidFit, ...]:
        """Return the solids in a picture. This is slow: call it in a thread."""
        return tuple(find_solids(seen.view, seen.model, seen.own))

    def look(self, seen: Seen, fits: Sequence[SolidFit], pose: Pose, tick: int) -> None:
        """Add the fits in a picture of `tick` by a body at `pose`, and publish the solids."""
        self._memory.look(fits, pose, tick, partial(is_gone, seen.view, seen.model))
        self._bus.publish(SOLIDS, Solids(solids=self._memory.solids(pose, tick)), basis=tick)

    def _on_model(self, model: ArmModel) -> None:
        self._mask = None
        try:
            from gigabrain_zenoh.manipulation.arm_mask import ArmMask  # imports MuJoCo

            self._mask = ArmMask(model.mjcf, self._description)
        except ModuleNotFoundError as error:
            problem = f"{error.name} is missing; pip install 'gigabrain-zenoh[arm]'"
        except GigabrainError as error:
            problem = str(error)
        else:
            return
        text = f"things near the arm are not detected: {problem}"
        log.warning("%s", text, extra={"data": {"event": "solids"}})

    def _on_detections(self, found: Detections) -> None:
        """Add the classes of recognised things that no edge of the picture cuts off."""
        pose = self._history.at(found.boot, found.basis)
        camera = next((one for one in self._description.cameras if one.name == found.camera), None)
        if pose is None or camera is None:
            return
        for one in found.things:
            left, top, right, bottom = one.box
            whole = left >= EDGE_PX and right <= found.width - EDGE_PX
            whole = whole and top >= EDGE_PX and bottom <= found.height - EDGE_PX
            if one.position and whole:
                x, y, _ = one.position
                distance = math.hypot(x - camera.x, y - camera.y)
                self._memory.name(one.label, one.confidence, (x, y), distance, pose)
