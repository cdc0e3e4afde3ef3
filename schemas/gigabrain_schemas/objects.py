"""Objects found by cameras: in one picture, in the map, and near an arm."""

from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_schemas.base import (
    Angle,
    Coordinate,
    Count,
    Distance,
    Fraction,
    Message,
    Name,
    Record,
    Text,
)
from gigabrain_schemas.body import CameraName, PixelOffset, Side
from gigabrain_schemas.sensors import Quaternion

Point = tuple[Coordinate, Coordinate, Coordinate]  # [m] x, y, z; z from the floor
Box = tuple[PixelOffset, PixelOffset, PixelOffset, PixelOffset]  # [px] left, top, right, bottom
Pixel = tuple[PixelOffset, PixelOffset]
TagId = Annotated[int, Meta(ge=0, le=1_000_000)]
Label = Annotated[str, Meta(min_length=1, max_length=64)]
Extent = tuple[Distance, Distance]  # [m] width and height
Length = Annotated[float, Meta(gt=0.0, le=10.0)]  # [m]
Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]
MAX_LABELS = 2048  # of one process
SIZES = {"box": 3, "cylinder": 2, "sphere": 1}  # number of lengths in the size of a solid


class Detection(Record, frozen=True, kw_only=True):
    """An object in a picture."""

    label: Label  # class
    confidence: Fraction
    box: Box
    position: Point | None = None  # [m], middle in the body's frame at the exposure; by depth
    in_map: Point | None = None  # [m], the same in the map; None if not localized
    size: Extent | None = None  # by depth


class TagDetection(Record, frozen=True, kw_only=True):
    """An AprilTag in a picture. Its x axis comes out of its face, its z axis points to its top."""

    id: TagId
    corners: tuple[Pixel, Pixel, Pixel, Pixel]  # from its lower left, counter-clockwise as seen
    size: Distance  # [m], of the black square
    position: Point  # [m], in the body's frame at the exposure
    orientation: Quaternion  # x, y, z, w, in the body's frame
    in_map: Point | None = None  # [m]
    yaw_in_map: Angle | None = None  # [rad], of its x axis


class Detections(Message, frozen=True, kw_only=True):
    """All objects and tags recognised in one picture. The basis is the tick of the exposure."""

    camera: CameraName
    width: Side  # [px], of the picture
    height: Side  # [px]
    things: Annotated[tuple[Detection, ...], Meta(max_length=128)] = ()
    tags: Annotated[tuple[TagDetection, ...], Meta(max_length=64)] = ()
    took_ms: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0


class Labels(Message, frozen=True, kw_only=True):
    """The classes of things that a process recognises in pictures; none if only tags."""

    labels: Annotated[tuple[Label, ...], Meta(max_length=MAX_LABELS)]


class MapObject(Record, frozen=True, kw_only=True):
    """An object in the map."""

    id: Count
    label: Label
    x: Coordinate  # [m], of the middle
    y: Coordinate  # [m]
    z: Coordinate  # [m], from the floor
    size: Extent
    confidence: Fraction
    seen: Count = 1  # pictures
    last_seen_ns: Count = 0  # Unix time, for people


class MapTag(Record, frozen=True, kw_only=True):
    """An AprilTag in the map."""

    id: TagId
    x: Coordinate  # [m]
    y: Coordinate  # [m]
    z: Coordinate  # [m], from the floor
    yaw: Angle  # [rad], direction of its face
    size: Distance  # [m], of its black square
    seen: Count = 1  # pictures
    last_seen_ns: Count = 0  # Unix time, for people


class ObjectMap(Message, frozen=True, kw_only=True):
    """The remembered objects and tags of the map. The last value is kept for late joiners."""

    objects: Annotated[tuple[MapObject, ...], Meta(max_length=256)] = ()
    tags: Annotated[tuple[MapTag, ...], Meta(max_length=256)] = ()
    map: Name = ""  # saved map that they belong to; empty for a growing one
    recognizing: bool = False  # detections arrived within the last seconds


class SeenSolid(Record, frozen=True, kw_only=True):
    """The shape of an object near an arm. Unseen parts are guessed."""

    id: Count  # the same as long as the object is known
    shape: Literal["box", "cylinder", "sphere"]  # cylinders stand upright
    size: Annotated[tuple[Length, ...], Meta(min_length=1, max_length=3)]
    # [m]: of a box x, y, z; of a cylinder radius, height; of a sphere its radius
    position: Point  # [m], of its middle, in the body's frame at the message's basis
    yaw: Angle = 0.0  # [rad] of a box
    label: Name = ""  # class, if recognised
    seen: Count = 1  # pictures
    age: Seconds = 0.0  # [s] since the object was last seen

    def __post_init__(self) -> None:
        if len(self.size) != SIZES[self.shape]:
            raise ValueError(f"size: expected {SIZES[self.shape]} lengths of a {self.shape}")


class Solids(Message, frozen=True, kw_only=True):
    """The solids near an arm, in the body's frame at the basis, the nearest first."""

    solids: Annotated[tuple[SeenSolid, ...], Meta(max_length=64)] = ()


class ObjectsRequest(Message, frozen=True, kw_only=True):
    """Forget objects or tags."""

    ids: Annotated[tuple[Count, ...], Meta(max_length=256)] = ()
    tags: Annotated[tuple[TagId, ...], Meta(max_length=256)] = ()
    everything: bool = False
    source: Name = "anonymous"

    def __post_init__(self) -> None:
        if bool(self.ids or self.tags) == self.everything:
            raise ValueError("expected ids and tags, or everything")


class ObjectsReply(Message, frozen=True, kw_only=True):
    """The result of a change."""

    ok: bool
    text: Text  # a sentence for people
