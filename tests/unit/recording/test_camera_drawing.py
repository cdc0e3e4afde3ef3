"""Drawing of cameras for viewers: frames of lenses, calibration, boxes, contours and objects."""

import re
import struct

import numpy as np
import pytest
from foxglove import messages as fox
from msgspec.structs import replace

from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import Contour, DetectedObject, Objects, WorldModel
from gigabrain_schemas.objects import Detection, Detections, MapObject, ObjectMap, TagDetection
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import DEPTH, DETECTIONS, IMAGE, OBJECT_MAP, PERCEIVED, WORLD
from gigabrain_schemas.vision import CameraInfo, DepthImage, pack_depth
from gigabrain_zenoh.recording import camera_drawing
from gigabrain_zenoh.recording.drawing import Drawer
from gigabrain_zenoh.vision.camera_model import rotation
from tests.unit.recording.bags import jpeg_head

FRONT = Camera(name="front", x=0.1, z=0.2, intrinsics=(300.0, 310.0, 160.0, 121.0))


def turned(quaternion: fox.Quaternion) -> np.ndarray:
    """Return the rotation matrix of a quaternion."""
    data = quaternion.encode()
    parts = {data[i] >> 3: struct.unpack_from("<d", data, i + 1)[0] for i in range(0, len(data), 9)}
    x, y, z, w = (parts.get(field, 0.0) for field in (1, 2, 3, 4))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.0, 0.3, 0.0), (0.2, -0.4, 2.5)])
def test_the_frame_of_a_lens_looks_along_its_z_axis_with_y_down(
    angles: tuple[float, float, float],
) -> None:
    roll, pitch, yaw = angles
    lens = turned(camera_drawing._optical_rotation(replace(FRONT, roll=roll, pitch=pitch, yaw=yaw)))
    mount = rotation(roll, pitch, yaw)
    ahead, left, up = mount.T
    assert lens[:, 2] == pytest.approx(ahead)
    assert lens[:, 0] == pytest.approx(-left)
    assert lens[:, 1] == pytest.approx(-up)


def test_a_calibration_has_the_intrinsics_and_hangs_below_the_body() -> None:
    found = {one.topic: one.data for one in camera_drawing.calibration(_info(FRONT), "front")}
    expected = fox.CameraCalibration(
        timestamp=fox.Timestamp(0, 7), frame_id="front_optical_frame", width=320, height=240,
        distortion_model="plumb_bob", D=[0.0] * 5,
        K=[300.0, 0.0, 160.0, 0.0, 310.0, 121.0, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[300.0, 0.0, 160.0, 0.0, 0.0, 310.0, 121.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    )  # fmt: skip
    assert found["/viz/calibration/front"] == expected.encode()
    place = fox.FrameTransform(
        timestamp=fox.Timestamp(0, 7), parent_frame_id="base_link",
        child_frame_id="front_optical_frame", translation=fox.Vector3(x=0.1, y=0.0, z=0.2),
        rotation=fox.Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5),
    )  # fmt: skip
    assert found["/viz/tf"] == place.encode()


def test_the_lens_of_a_camera_on_an_arm_moves_with_the_link() -> None:
    arm = replace(FRONT, name="wrist", link="hand")
    found = {one.topic: one.data for one in camera_drawing.calibration(_info(arm), "wrist")}
    place = fox.FrameTransform(
        timestamp=fox.Timestamp(0, 7), parent_frame_id="arm/hand",
        child_frame_id="wrist_optical_frame", translation=fox.Vector3(x=0.1, y=0.0, z=0.2),
        rotation=fox.Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5),
    )  # fmt: skip
    assert found["/viz/tf"] == place.encode()


def test_a_distortion_of_eight_coefficients_is_the_rational_model() -> None:
    wide = replace(FRONT, distortion=(0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6))
    data = next(iter(camera_drawing.calibration(_info(wide), "front"))).data
    assert b"rational_polynomial" in data
    assert struct.pack("<8d", *wide.distortion) in data


def _info(camera: Camera) -> CameraInfo:
    return CameraInfo(stamp_ns=7, camera=camera)


def test_a_picture_is_drawn_in_the_frame_of_its_lens() -> None:
    jpeg = Image(
        stamp_ns=7, frame_id="front", encoding="jpeg", width=320, height=240,
        data=jpeg_head(320, 240),
    )  # fmt: skip
    (drawn,) = Drawer().draw(IMAGE, jpeg, "front")
    expected = fox.CompressedImage(
        timestamp=fox.Timestamp(0, 7), frame_id="front_optical_frame", data=jpeg.data,
        format="jpeg",
    )  # fmt: skip
    assert (drawn.topic, drawn.data) == ("/viz/image/front", expected.encode())


@pytest.mark.parametrize(
    "data",
    [jpeg_head(65500, 65500), jpeg_head(64, 48), b"\xff\xd8", b"no picture"],
    ids=["bomb", "other size", "cut off", "garbage"],
)
def test_a_picture_that_is_not_what_it_claims_is_not_given_to_viewers(data: bytes) -> None:
    jpeg = Image(frame_id="front", encoding="jpeg", width=320, height=240, data=data)
    assert list(Drawer().draw(IMAGE, jpeg, "front")) == []


def test_depth_is_drawn_in_millimetres_and_broken_depth_not_at_all() -> None:
    pixels = np.arange(16 * 16, dtype=np.uint16).reshape(16, 16)
    whole = DepthImage(frame_id="front", width=16, height=16, planes=pack_depth(pixels))
    (drawn,) = Drawer().draw(DEPTH, whole, "front")
    assert pixels.astype("<u2").tobytes() in drawn.data
    assert b"16UC1" in drawn.data
    broken = replace(whole, planes=(b"x", *whole.planes[1:]))
    assert list(Drawer().draw(DEPTH, broken, "front")) == []


def test_boxes_and_tags_are_drawn_over_the_picture_with_their_names() -> None:
    can = Detection(label="can", confidence=0.934, box=(10, 20, 30, 60), position=(1.2, 0.0, 0.1))
    tag = TagDetection(
        id=7, corners=((1, 9), (9, 9), (9, 1), (1, 1)), size=0.1, position=(3.0, 4.0, 0.2),
        orientation=(0.0, 0.0, 0.0, 1.0),
    )  # fmt: skip
    found = Detections(camera="front", width=320, height=240, things=(can,), tags=(tag,))
    (drawn,) = Drawer().draw(DETECTIONS, found)
    assert drawn.topic == "/viz/annotations/front"
    texts = re.findall(rb"can 93 %  1\.2 m|tag 7  5\.0 m", drawn.data)
    assert texts == [b"can 93 %  1.2 m", b"tag 7  5.0 m"]
    for corner in ((10, 20), (30, 20), (30, 60), (10, 60)):
        assert fox.Point2(x=corner[0], y=corner[1]).encode() in drawn.data


SQUARE = ((1.0, 0.0), (1.2, 0.0), (1.2, 0.2), (1.0, 0.2))


@pytest.mark.parametrize(
    ("bottom", "top", "kind"),
    [(0.0, 0.05, "low"), (0.02, 1.0, "low"), (0.4, 0.7, "overhang"), (-0.15, 0.0, "hole")],
)
def test_contours_are_of_three_kinds(bottom: float, top: float, kind: str) -> None:
    one = Contour(polygon=SQUARE, bottom=bottom, top=top)
    assert camera_drawing.contour_kind(one) == kind


def test_a_contour_is_a_prism_from_bottom_to_top_that_fades_with_its_age() -> None:
    def faces(age: float) -> bytes:
        one = Contour(polygon=SQUARE, bottom=0.4, top=0.7, age=age, track=5)
        world = WorldModel(scan_ok=True, obstacle_ahead=False, contours=(one,))
        (drawn,) = (d for d in Drawer().draw(WORLD, world) if d.topic == "/viz/contours")
        return drawn.data

    fresh = faces(0.0)
    for x, y in SQUARE:
        for z in (0.4, 0.7):
            assert fox.Point3(x=x, y=y, z=z).encode() in fresh
    red, green, blue = camera_drawing.CONTOUR_COLOURS["overhang"]
    for age, alpha in ((0.0, 1.0), (5.0, 0.5), (60.0, camera_drawing.MIN_ALPHA)):
        assert fox.Color(r=red, g=green, b=blue, a=alpha).encode() in faces(age)


def test_a_robot_without_cameras_draws_no_contours() -> None:
    world = WorldModel(scan_ok=True, obstacle_ahead=False)
    assert [d.topic for d in Drawer().draw(WORLD, world)] == [
        "/viz/obstacles",
        "/viz/world_numbers",
    ]


def test_a_forgotten_object_is_deleted_from_the_scene() -> None:
    def stands(number: int) -> MapObject:
        return MapObject(id=number, label="can", x=1.0, y=2.0, z=0.06, size=(0.07, 0.12),
                         confidence=0.9)  # fmt: skip

    drawer = Drawer()
    (both,) = drawer.draw(OBJECT_MAP, ObjectMap(objects=(stands(3), stands(4))))
    (one,) = drawer.draw(OBJECT_MAP, ObjectMap(objects=(stands(4),)))
    assert both.data.count(b"can 3") == 2  # the entity, and its text
    gone = fox.SceneEntityDeletion(
        timestamp=fox.Timestamp(0, 0), type=fox.SceneEntityDeletionType.MatchingId, id="can 3"
    )
    assert gone.encode() in one.data


def test_what_a_perceptor_finds_is_drawn_with_its_label() -> None:
    person = DetectedObject(id=1, x=2.0, y=1.0, radius=0.3, label="person")
    (drawn,) = Drawer().draw(PERCEIVED, Objects(objects=(person,)), "people")
    assert drawn.topic == "/viz/perceived/people"
    assert b"person" in drawn.data
    assert fox.Vector3(x=2.0, y=1.0, z=0.0).encode() in drawn.data


def test_boxes_without_depth_have_no_distance() -> None:
    thing = Detection(label="ball", confidence=0.5, box=(0, 0, 4, 4))
    assert camera_drawing.thing_label(thing) == "ball 50 %"
