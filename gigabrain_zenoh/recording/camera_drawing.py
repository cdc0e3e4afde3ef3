"""Drawings of cameras for viewers: pictures, calibration, detections, objects and contours.

Foxglove and Rerun match a picture with its calibration by the optical frame (REP-103): z points
ahead, x to the right of the picture and y down. Its parent is `base_link`, or a link of the arm.
"""

import math
from collections.abc import Iterable
from typing import Any

from foxglove import messages as fox

from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import Contour, WorldModel
from gigabrain_schemas.objects import (
    Detection,
    Detections,
    MapObject,
    MapTag,
    ObjectMap,
    SeenSolid,
    Solids,
)
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.vision import CameraInfo, DepthImage
from gigabrain_zenoh.recording.arm_drawing import LINKS
from gigabrain_zenoh.recording.drawn import (
    BASE,
    BLUE,
    MAP,
    Drawn,
    KnownEntities,
    as_drawn,
    label,
    pose_of,
    stamp,
)
from gigabrain_zenoh.vision.pictures import check_jpeg

OPTICAL = (-0.5, 0.5, -0.5, 0.5)  # x, y, z, w: from the optical frame to one with x ahead
RAW_ENCODINGS = {"depth16": "16UC1", "depth32f": "32FC1"}
WHITE, DARK = fox.Color(r=1.0, g=1.0, b=1.0, a=1.0), fox.Color(r=0.0, g=0.0, b=0.0, a=0.6)
THING_COLOUR = fox.Color(r=1.0, g=0.76, b=0.03, a=1.0)
TAG_COLOUR = fox.Color(r=0.2, g=0.85, b=0.95, a=1.0)
TEXT_PX, LINE_PX = 12.0, 2.0
OVERHANG_M = 0.1  # a contour whose bottom is higher is an overhang
HOLE_M = -0.01  # a contour whose bottom is lower is a hole
FADE_S, MIN_ALPHA = 10.0, 0.15  # a contour fades while it is not seen
CONTOUR_COLOURS = {
    "low": (0.64, 0.15, 0.5),
    "overhang": (0.42, 0.31, 0.63),
    "hole": (0.7, 0.07, 0.11),
}
CONTOUR_LIFETIME = fox.Duration(sec=1)
OUTLINE_M, PLATE_M = 0.02, 0.01


def optical_frame(camera: str) -> str:
    """Return the name of a camera's optical frame."""
    return f"{camera}_optical_frame"


def picture(image: Image, camera: str) -> Iterable[Drawn]:
    """Draw a picture; skip a JPEG that is broken or has another size than its message."""
    when, frame = stamp(image), optical_frame(camera)
    if image.encoding == "jpeg":
        try:
            check_jpeg(image)
        except ValueError:
            return
        jpeg = fox.CompressedImage(timestamp=when, frame_id=frame, data=image.data, format="jpeg")
        yield as_drawn(f"image/{camera}", jpeg)
        return
    raw = fox.RawImage(
        timestamp=when, frame_id=frame, width=image.width, height=image.height,
        encoding=RAW_ENCODINGS.get(image.encoding, image.encoding),
        step=len(image.data) // max(image.height, 1), data=image.data,
    )  # fmt: skip
    yield as_drawn(f"image/{camera}", raw)


def depth(message: DepthImage, camera: str) -> Iterable[Drawn]:
    """Draw depth as a picture in millimetres; skip a broken message."""
    try:
        data = message.array().astype("<u2").tobytes()
    except ValueError:
        return
    raw = fox.RawImage(
        timestamp=stamp(message), frame_id=optical_frame(camera), width=message.width,
        height=message.height, encoding="16UC1", step=2 * message.width, data=data,
    )  # fmt: skip
    yield as_drawn(f"depth/{camera}", raw)


def calibration(info: CameraInfo, _: str) -> Iterable[Drawn]:
    """Draw a camera's calibration, and its optical frame."""
    camera = info.camera
    fx, fy, cx, cy = camera.pinhole
    given = camera.distortion
    size = 8 if len(given) > 5 else 5
    drawn = fox.CameraCalibration(
        timestamp=stamp(info), frame_id=optical_frame(camera.name), width=camera.width,
        height=camera.height,
        distortion_model="rational_polynomial" if size == 8 else "plumb_bob",
        D=[*given, *[0.0] * (size - len(given))],
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )  # fmt: skip
    yield as_drawn(f"calibration/{camera.name}", drawn)
    place = fox.FrameTransform(
        timestamp=stamp(info), child_frame_id=optical_frame(camera.name),
        parent_frame_id=f"{LINKS}{camera.link}" if camera.link else BASE,
        translation=fox.Vector3(x=camera.x, y=camera.y, z=camera.z),
        rotation=_optical_rotation(camera),
    )  # fmt: skip
    yield as_drawn("tf", place)


def _optical_rotation(camera: Camera) -> fox.Quaternion:
    """Return the rotation from the optical frame to the frame in which the camera is mounted."""
    (sr, cr), (sp, cp), (sy, cy) = (
        (math.sin(angle / 2), math.cos(angle / 2))
        for angle in (camera.roll, camera.pitch, camera.yaw)
    )
    x, y, z, w = (  # roll, then pitch, then yaw, about fixed axes
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    ox, oy, oz, ow = OPTICAL
    return fox.Quaternion(
        x=w * ox + x * ow + y * oz - z * oy,
        y=w * oy - x * oz + y * ow + z * ox,
        z=w * oz + x * oy - y * ox + z * ow,
        w=w * ow - x * ox - y * oy - z * oz,
    )


def recognised(found: Detections, _: str) -> Iterable[Drawn]:
    """Draw boxes and tags over the picture."""
    when, points, texts = stamp(found), [], []
    for thing in found.things:
        left, top, right, bottom = thing.box
        corners = ((left, top), (right, top), (right, bottom), (left, bottom))
        points.append(_loop(when, corners, THING_COLOUR))
        texts.append(_text(when, left, top, thing_label(thing)))
    for tag in found.tags:
        points.append(_loop(when, tag.corners, TAG_COLOUR))
        left, top = min(u for u, _ in tag.corners), min(v for _, v in tag.corners)
        away = math.hypot(*tag.position[:2])
        texts.append(_text(when, left, top, f"tag {tag.id}  {away:.1f} m"))
    drawn = fox.ImageAnnotations(timestamp=when, points=points, texts=texts)
    yield as_drawn(f"annotations/{found.camera}", drawn)


def thing_label(thing: Detection) -> str:
    """Return the text of a detection: class, confidence, and distance if it is known."""
    text = f"{thing.label} {100 * thing.confidence:.0f} %"
    if thing.position:
        text += f"  {math.hypot(*thing.position[:2]):.1f} m"
    return text


def _loop(
    when: fox.Timestamp, corners: Iterable[tuple[float, float]], colour: fox.Color
) -> fox.PointsAnnotation:
    return fox.PointsAnnotation(
        timestamp=when, type=fox.PointsAnnotationType.LineLoop, outline_color=colour,
        points=[fox.Point2(x=u, y=v) for u, v in corners], thickness=LINE_PX,
    )  # fmt: skip


def _text(when: fox.Timestamp, u: float, v: float, text: str) -> fox.TextAnnotation:
    return fox.TextAnnotation(
        timestamp=when, position=fox.Point2(x=u, y=max(v, TEXT_PX)), text=text,
        font_size=TEXT_PX, text_color=WHITE, background_color=DARK,
    )  # fmt: skip


def contours(world: WorldModel) -> Iterable[Drawn]:
    """Draw contours as prisms; nothing if there is no camera."""
    if world.contours or world.cameras:
        entities = [_prism(world, *each) for each in enumerate(world.contours)]
        yield as_drawn("contours", fox.SceneUpdate(entities=entities))


def contour_kind(contour: Contour) -> str:
    """Return whether a contour is `low`, an `overhang` or a `hole`."""
    if contour.bottom < HOLE_M:
        return "hole"
    return "overhang" if contour.bottom > OVERHANG_M else "low"


def _prism(world: WorldModel, number: int, contour: Contour) -> fox.SceneEntity:
    """Draw the sides of a contour from bottom to top, and its outlines."""
    red, green, blue = CONTOUR_COLOURS[contour_kind(contour)]
    alpha = max(MIN_ALPHA, contour.confidence * max(0.0, 1.0 - contour.age / FADE_S))
    loops = [
        fox.LinePrimitive(
            type=fox.LinePrimitiveLineType.LineLoop, thickness=OUTLINE_M,
            points=[fox.Point3(x=x, y=y, z=z) for x, y in contour.polygon],
            color=fox.Color(r=red, g=green, b=blue, a=alpha),
        )
        for z in sorted({contour.bottom, contour.top})
    ]  # fmt: skip
    sides = []
    for (ax, ay), (bx, by) in zip(
        contour.polygon, (*contour.polygon[1:], contour.polygon[0]), strict=True
    ):
        low_a, low_b = (ax, ay, contour.bottom), (bx, by, contour.bottom)
        high_a, high_b = (ax, ay, contour.top), (bx, by, contour.top)
        sides += [low_a, low_b, high_b, low_a, high_b, high_a]
    faces = fox.TriangleListPrimitive(
        points=[fox.Point3(x=x, y=y, z=z) for x, y, z in sides],
        color=fox.Color(r=red, g=green, b=blue, a=alpha / 2),
    )
    return fox.SceneEntity(
        timestamp=stamp(world), frame_id=BASE, id=str(contour.track or f"new {number}"),
        lifetime=CONTOUR_LIFETIME, lines=loops,
        triangles=[faces] if contour.top > contour.bottom else [],
    )  # fmt: skip


class ObjectMapDrawing:
    """Draws the memory of objects and tags."""

    def __init__(self) -> None:
        self._known = KnownEntities()

    def draw(self, stored: ObjectMap, _: str) -> Iterable[Drawn]:
        """Draw each object as a cylinder and each tag as a plate, with their names."""
        entities = {f"{each.label} {each.id}": _object(stored, each) for each in stored.objects}
        entities |= {f"tag {each.id}": _tag(stored, each) for each in stored.tags}
        yield as_drawn("objects", self._known.update(stored, entities))


def _object(stored: ObjectMap, thing: MapObject) -> fox.SceneEntity:
    width, height = max(thing.size[0], PLATE_M), max(thing.size[1], PLATE_M)
    body = fox.CylinderPrimitive(
        pose=pose_of(thing.x, thing.y, 0.0, thing.z),
        size=fox.Vector3(x=width, y=width, z=height), bottom_scale=1.0, top_scale=1.0,
        color=fox.Color(r=0.04, g=0.37, b=0.49, a=0.6),
    )  # fmt: skip
    name = label(thing.x, thing.y, f"{thing.label} {thing.id}", thing.z + height)
    return fox.SceneEntity(
        timestamp=stamp(stored), frame_id=MAP, id=f"{thing.label} {thing.id}", cylinders=[body],
        texts=[name],
    )  # fmt: skip


def _tag(stored: ObjectMap, tag: MapTag) -> fox.SceneEntity:
    """Draw a plate, and an arrow in the direction of its face."""
    pose = pose_of(tag.x, tag.y, tag.yaw, tag.z)
    plate = fox.CubePrimitive(
        pose=pose, size=fox.Vector3(x=PLATE_M, y=tag.size, z=tag.size), color=DARK
    )
    arrow = fox.ArrowPrimitive(
        pose=pose, shaft_length=tag.size, shaft_diameter=0.02, head_length=0.05,
        head_diameter=0.05, color=BLUE,
    )  # fmt: skip
    return fox.SceneEntity(
        timestamp=stamp(stored), frame_id=MAP, id=f"tag {tag.id}", cubes=[plate], arrows=[arrow],
        texts=[label(tag.x, tag.y, f"tag {tag.id}", tag.z + tag.size)],
    )  # fmt: skip


class SolidsDrawing:
    """Draws the solids near an arm."""

    def __init__(self) -> None:
        self._known = KnownEntities()

    def draw(self, seen: Solids, _: str) -> Iterable[Drawn]:
        """Draw each solid with its class and its number."""
        entities = {f"solid {each.id}": _solid(seen, each) for each in seen.solids}
        yield as_drawn("solids", self._known.update(seen, entities))


def _solid(seen: Solids, solid: SeenSolid) -> fox.SceneEntity:
    x, y, z = solid.position
    pose, colour = pose_of(x, y, solid.yaw, z), fox.Color(r=0.85, g=0.45, b=0.1, a=0.6)
    shape: dict[str, Any] = {}
    if solid.shape == "box":
        long, wide, tall = solid.size
        size = fox.Vector3(x=long, y=wide, z=tall)
        shape["cubes"] = [fox.CubePrimitive(pose=pose, size=size, color=colour)]
    elif solid.shape == "cylinder":
        size = fox.Vector3(x=2 * solid.size[0], y=2 * solid.size[0], z=solid.size[1])
        shape["cylinders"] = [
            fox.CylinderPrimitive(
                pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=colour
            )
        ]
    else:
        wide = 2 * solid.size[0]
        size = fox.Vector3(x=wide, y=wide, z=wide)
        shape["spheres"] = [fox.SpherePrimitive(pose=pose, size=size, color=colour)]
    text = label(x, y, f"{solid.label} {solid.id}".strip(), z + solid.size[-1])
    return fox.SceneEntity(
        timestamp=stamp(seen), frame_id=BASE, id=f"solid {solid.id}", texts=[text], **shape
    )
