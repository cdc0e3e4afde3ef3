"""Requests about things, tags and the robot's pose, for the page and the command line."""

import asyncio
import math
from typing import Any

import msgspec

from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.objects import ObjectMap, ObjectsRequest
from gigabrain_schemas.requests import PoseRequest
from gigabrain_schemas.topics import OBJECT_MAP, OBJECTS_CHANGE, POSE, POSE_SET
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.zones import ANSWER_S, NO_MAPPING
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config.name_words import plain
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused

LOCALIZE_TIMEOUT_S = 4.0  # for the scan to confirm a pose
MAX_POSE_ERROR_M = 1.2  # between the given and the confirmed pose
OLD_POSES_S = 0.1  # poses from before the request may still arrive this long
NO_OBJECTS = (
    "no process stores things; the robot needs a camera (--cameras), and perception a map "
    "(mapping: slam or localize)"
)


async def known_objects(bus: Bus) -> ObjectMap:
    """Return the things and tags that the robot knows. Raises BodyLost."""
    kept = await bus.kept(OBJECT_MAP)
    if not kept:
        raise BodyLost(NO_OBJECTS)
    found: ObjectMap = Codec(OBJECT_MAP.type, OBJECT_MAP.max_bytes).decode(kept[0])
    return found


async def forget_objects(bus: Bus, **fields: Any) -> str:
    """Forget `ids`, `tags` or `everything`; return the reply as text.

    Raises ConfigError for fields that are not valid, BodyLost and Refused.
    """
    request = _request(ObjectsRequest, {"source": bus.process[:64], **fields})
    replies = await bus.ask(OBJECTS_CHANGE, request, timeout_s=ANSWER_S)
    if not replies:
        raise BodyLost(NO_OBJECTS)
    if not replies[0].ok:
        raise Refused(replies[0].text)
    return replies[0].text


async def set_pose(bus: Bus, x: float, y: float, yaw: float | None = None) -> PoseInMap:
    """Set the robot's pose [m, m, rad]; return it once the robot's scan confirms it.

    Raises ConfigError for numbers that are not valid, BodyLost, and Refused if the scan does not
    fit there.
    """
    request = _request(PoseRequest, {"x": x, "y": y, "yaw": yaw, "source": bus.process[:64]})
    replies = await bus.ask(POSE_SET, request, timeout_s=ANSWER_S)
    if not replies:
        raise BodyLost(NO_MAPPING)
    if not replies[0].ok:
        raise Refused(replies[0].text)
    await asyncio.sleep(OLD_POSES_S)
    found: asyncio.Future[PoseInMap] = asyncio.get_running_loop().create_future()

    def on_pose(_key: str, pose: PoseInMap) -> None:
        if pose.localized and not found.done():
            found.set_result(pose)

    close = bus.subscribe(POSE, on_pose)
    try:
        pose = await asyncio.wait_for(found, LOCALIZE_TIMEOUT_S)
    except TimeoutError:
        raise Refused(
            f"not found: the scan does not determine the robot's place near ({x:.2f}, {y:.2f}); "
            "the whole map is searched; correct x and y, or drive the robot a little"
        ) from None
    finally:
        close()
    if math.hypot(pose.x - x, pose.y - y) > MAX_POSE_ERROR_M:
        raise Refused(
            f"the scan does not match the map near ({x:.2f}, {y:.2f}); the robot is localized at "
            f"({pose.x:.2f}, {pose.y:.2f})"
        )
    return pose


def _request(kind: Any, fields: dict[str, Any]) -> Any:
    try:
        return msgspec.convert(fields, kind)
    except (ValueError, OverflowError) as error:  # msgspec.ValidationError is one
        raise ConfigError(f"not a valid request: {plain(error)}") from None
