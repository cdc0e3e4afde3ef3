"""Depth images in safety: low objects, steps, overhangs, memory and camera faults."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.cameras.depth_noise import NO_ERRORS
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.sensors import ImuData
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.safety.cameras import Picture, directions
from gigabrain_zenoh.safety.depth import sight, view_of
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step
from gigabrain_zenoh.testing.samples import BOOT, open_space, scan, state
from tests.unit.safety.depth_scene import CAMERA, LOW, SEEING, Eye, Scene, image

ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)
FRONT = 0.075  # [m], front of the body
REST, AHEAD, BACK, LEFT = (
    Velocity(),
    Velocity(linear_x=0.26),
    Velocity(linear_x=-0.2),
    Velocity(angular_z=1.0),
)
Spoil = Callable[[DepthImage], DepthImage | None]


class Drive:
    """A body with a camera in a scene, which follows the gate's output."""

    def __init__(
        self,
        scene: Scene,
        *,
        eye: Eye | None = None,
        body: BodyDescription = SEEING,
        lidar: bool = True,
    ) -> None:
        self.scene, self.eye, self.body = scene, eye or Eye(), body
        self.pose, self.tick, self.memory = ORIGIN, 0, SafetyMemory()
        self.verdict = SafetyState(verdict="stop")
        self.lidar = lidar
        self.imu: ImuData | None = None
        self.newest: DepthImage | None = None
        self.go(15)

    def go(
        self, ticks: int, asked: Velocity = REST, spoil: Spoil = lambda image: image
    ) -> list[str]:
        """Drive for some ticks; return the codes of the causes after the last one."""
        for _ in range(ticks):
            self.tick += 1
            moves = self.memory.tracking.commanded
            self.pose = _moved(self.pose, moves)
            now = replace(
                state(self.tick), pose=self.pose, velocity=moves, sent=moves, imu=self.imu
            )
            if self.tick % 5 == 0:
                seen = spoil(self.eye.picture(self.scene, self.pose, self.tick))
                self.newest = seen or self.newest
            command = CmdVel(
                linear_x=asked.linear_x, angular_z=asked.angular_z, source="control",
                boot=BOOT, tick=self.tick - 1,
            )  # fmt: skip
            basis = self.tick - self.tick % 5
            pictures = {"front": Picture(image=self.newest)} if self.newest else {}
            inputs = SafetyInputs(
                state=now,
                scan=scan(open_space(), basis) if basis and self.lidar else None,
                scan_age_ns=0,
                command=command,
                pictures=pictures,
            )
            self.memory, self.verdict = step(self.body, self.memory, inputs)
        return [cause.code for cause in self.verdict.causes]

    @property
    def marks(self) -> int:
        """Return the number of points that count as obstacles."""
        return int((self.memory.field.cameras.marks.level > 1).sum())


def _moved(pose: Pose, moves: Velocity) -> Pose:
    way = 0.02 * moves.linear_x
    return Pose(
        x=pose.x + way * math.cos(pose.yaw),
        y=pose.y + way * math.sin(pose.yaw),
        yaw=pose.yaw + 0.02 * moves.angular_z,
    )


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_the_body_stops_before_an_object_of_3_cm(seed: int) -> None:
    drive = Drive(Scene(boxes=(LOW,)), eye=Eye(seed=seed))
    assert drive.go(250, AHEAD) == ["zone_ahead"]
    assert 0.03 < LOW[0] - (drive.pose.x + FRONT) < 0.16
    assert drive.verdict.caps.backward is None
    assert "seen by a camera" in drive.verdict.causes[0].text


def test_the_body_stops_before_a_step_down() -> None:
    drive = Drive(Scene(edge=0.7, drop=0.05))
    assert drive.go(250, AHEAD) == ["zone_ahead"]
    assert 0.03 < 0.7 - (drive.pose.x + FRONT) < 0.13


def test_a_hole_too_deep_to_be_measured_is_no_floor() -> None:
    drive = Drive(Scene(edge=0.7, drop=90.0, room=300.0))
    drive.go(250, AHEAD)
    assert drive.verdict.caps.forward == 0.0
    assert 0.03 < 0.7 - (drive.pose.x + FRONT) < 0.3


@pytest.mark.parametrize(("bottom", "code"), [(0.12, ["zone_ahead"]), (0.22, [])])
def test_an_overhang_counts_up_to_the_height_of_the_body(bottom: float, code: list[str]) -> None:
    board = (0.7, 1.0, -0.4, 0.4, bottom, bottom + 0.02)
    drive = Drive(Scene(boxes=(board,)))
    assert drive.go(150, AHEAD) == code


@pytest.mark.long
def test_an_obstacle_that_left_the_picture_still_counts() -> None:
    drive = Drive(Scene(boxes=(LOW,)))
    drive.go(250, AHEAD)
    seen = sight(SEEING, CAMERA, view_of(SEEING, CAMERA), drive.newest.quarter())  # type: ignore[union-attr]
    assert not len(seen.points)  # the camera looks over it now
    assert drive.go(500, AHEAD) == ["zone_ahead"]


@pytest.mark.long
def test_the_body_does_not_back_into_an_obstacle_that_it_saw() -> None:
    """It turns around before the obstacle, and drives backwards."""
    drive = Drive(Scene(boxes=(LOW,)))
    drive.go(250, AHEAD)
    drive.go(60, BACK)
    drive.go(round(math.pi / 0.02), LEFT)
    assert drive.go(300, BACK) == ["zone_behind"]
    assert -drive.pose.x + LOW[0] - 0.2 > 0.03


@pytest.mark.long
def test_an_obstacle_is_forgotten_once_a_picture_shows_that_it_is_gone() -> None:
    drive = Drive(Scene(boxes=(LOW,)))
    drive.go(250, AHEAD)
    drive.go(120, BACK)
    assert drive.marks
    drive.scene = Scene()
    drive.go(25)
    assert drive.marks == 0
    assert drive.go(150, AHEAD) == []


@pytest.mark.long
def test_an_obstacle_out_of_reach_is_forgotten() -> None:
    drive = Drive(Scene(boxes=(LOW,)))
    drive.go(250, AHEAD)
    drive.scene = Scene()
    drive.go(400, BACK, spoil=lambda seen: image(np.zeros((240, 320)), seen.tick))
    assert drive.marks == 0


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_an_empty_floor_has_no_obstacles(seed: int) -> None:
    drive = Drive(Scene(), eye=Eye(seed=seed))
    for asked in (AHEAD, LEFT, AHEAD, BACK):
        for _ in range(40):
            assert drive.go(5, asked) == []
            assert drive.marks == 0


@pytest.mark.parametrize(("away", "tolerance"), [(0.5, 0.0096), (1.0, 0.0142), (2.0, 0.0233)])
def test_the_tolerance_of_heights_grows_with_the_distance(away: float, tolerance: float) -> None:
    view, column = view_of(replace(SEEING, max_linear_speed=2.0), CAMERA), 80
    depths = view.above[:, column] / 1000.0
    row = int(np.abs(depths - away).argmin())
    height = CAMERA.z + float(view.rays[row, column, 2]) * depths[row]
    assert height == pytest.approx(tolerance, rel=0.1)


def test_one_pixel_is_noise_and_a_group_is_an_object() -> None:
    floor = Scene().depth(CAMERA, ORIGIN) * 1000
    one, group = floor.copy(), floor.copy()
    one[200, 160] = 300
    group[196:206, 156:166] = 300
    view = view_of(SEEING, CAMERA)
    assert not len(sight(SEEING, CAMERA, view, image(one).quarter()).points)
    assert sight(SEEING, CAMERA, view, image(group).quarter()).sure.any()


def test_a_few_pixels_in_one_picture_only_do_not_count() -> None:
    """Three similar pixels in a row count only if the next picture has them as well."""
    floor = np.rint(Scene().depth(CAMERA, ORIGIN) * 1000)
    flash = floor.copy()
    flash[180, 160:165:2] = 350

    def flashing(at: int) -> Spoil:
        return lambda seen: image(flash if seen.tick <= at else floor, seen.tick)

    drive = Drive(Scene(), eye=Eye(errors=NO_ERRORS))
    assert drive.go(5, spoil=flashing(drive.tick + 5)) == []
    assert len(drive.memory.field.cameras.marks.level) == 1
    drive.go(20, spoil=flashing(drive.tick))
    assert len(drive.memory.field.cameras.marks.level) == 0
    drive.go(10, spoil=flashing(drive.tick + 10))
    assert drive.marks == 1


def test_for_a_body_on_a_sill_the_floor_is_no_obstacle() -> None:
    """Its front is 3 degrees up, as its IMU measures."""
    tilt = math.radians(3)
    eye = Eye(replace(CAMERA, pitch=-tilt), errors=NO_ERRORS)
    drive = Drive(Scene(), eye=eye)
    blindly = drive.marks
    drive = Drive(Scene(), eye=Eye(errors=NO_ERRORS))
    drive.eye = eye
    drive.imu = ImuData(
        orientation=(0.0, -math.sin(tilt / 2), 0.0, math.cos(tilt / 2)),
        angular_velocity=(0.0, 0.0, 0.0),
        linear_acceleration=(0.0, 0.0, 9.81),
    )
    drive.go(10)
    assert (blindly > 0, drive.marks) == (True, 0)


def _constant(value: int) -> Spoil:
    return lambda seen: image(np.full((240, 320), value), seen.tick)


FAULTS: dict[str, tuple[str, Spoil]] = {
    "silent": ("camera_lost", lambda _: None),
    "late": ("camera_lost", lambda seen: replace(seen, basis=max(1, seen.basis - 20))),
    "of the future": ("camera_lost", lambda seen: replace(seen, basis=seen.basis + 500)),
    "covered": ("camera_blind", _constant(0)),
    "far beyond its range": ("camera_blind", _constant(65535)),
    "of the wrong size": ("camera_wrong", lambda seen: image(np.ones((120, 160)), seen.tick)),
    "of another camera": ("camera_wrong", lambda seen: replace(seen, frame_id="rear")),
    "truncated": ("camera_wrong", lambda seen: _first_plane(seen, seen.planes[0][:99])),
    "empty": ("camera_wrong", lambda seen: _first_plane(seen, b"")),
    "no plane": ("camera_wrong", lambda seen: _first_plane(seen, b"x" * 1000)),
    "a bomb": ("camera_wrong", lambda seen: _first_plane(seen, BOMB)),
}


def _first_plane(seen: DepthImage, plane: bytes) -> DepthImage:
    return replace(seen, planes=(plane, *seen.planes[1:]))


BOMB = image(np.zeros((4096, 4096))).planes[0]  # 8 MB of zeros


@pytest.mark.long
@pytest.mark.parametrize(("code", "spoil"), FAULTS.values(), ids=FAULTS)
def test_a_camera_fault_stops_motion_in_its_direction_until_it_is_over(
    code: str, spoil: Spoil
) -> None:
    drive = Drive(Scene())
    assert drive.go(25, spoil=spoil) == [code]
    assert drive.verdict.caps == SpeedCaps(forward=0.0)
    assert "front" in drive.verdict.causes[0].text
    at = drive.pose
    assert drive.go(50, AHEAD, spoil) == [code]
    assert drive.pose == at
    assert drive.go(65) == []
    assert drive.verdict.caps == SpeedCaps()


def test_a_camera_with_often_late_pictures_stays_lost() -> None:
    drive = Drive(Scene())
    assert drive.go(25, spoil=lambda _: None) == ["camera_lost"]
    for _ in range(5):  # a busy machine lets one or two pictures through each second
        assert drive.go(10) == ["camera_lost"]
        assert drive.go(25, spoil=lambda _: None) == ["camera_lost"]
    assert drive.go(45) == ["camera_lost"]
    assert drive.go(15) == []


def test_a_repeated_picture_is_a_fault_once_the_body_moves() -> None:
    drive = Drive(Scene())
    kept = drive.newest
    assert kept

    def frozen(seen: DepthImage) -> DepthImage:
        return replace(kept, tick=seen.tick, basis=seen.basis)

    assert drive.go(25, Velocity(linear_x=0.05), frozen) == ["camera_frozen"]
    assert drive.go(10) == []


def test_a_dark_camera_that_moves_is_not_frozen() -> None:
    drive = Drive(Scene())
    assert drive.go(50, Velocity(linear_x=-0.2), _constant(0)) == ["camera_blind"]


def test_a_camera_may_repeat_its_picture_while_the_body_rests() -> None:
    drive = Drive(Scene(), eye=Eye(errors=NO_ERRORS))
    assert drive.go(100) == []


def test_before_the_first_picture_the_body_does_not_move_ahead() -> None:
    drive = Drive(Scene())
    fresh = Drive.__new__(Drive)
    fresh.__dict__.update(drive.__dict__, memory=SafetyMemory(), newest=None, tick=0)
    assert fresh.go(20, spoil=lambda _: None) == ["camera_lost"]
    assert fresh.verdict.caps == SpeedCaps(forward=0.0)


def test_a_flood_of_pictures_is_processed_at_most_at_twice_the_cameras_rate() -> None:
    drive = Drive(Scene())
    before = drive.memory.field.cameras.pictures
    for _ in range(50):
        drive.newest = drive.eye.picture(drive.scene, drive.pose, drive.tick)
        drive.go(1)
    assert drive.memory.field.cameras.pictures - before <= 18


def test_without_a_lidar_the_camera_stops_the_body() -> None:
    body = replace(SEEING, lidar=None)
    drive = Drive(Scene(boxes=(LOW,)), body=body, lidar=False)
    assert drive.go(250, AHEAD) == ["zone_ahead"]


def test_without_depth_cameras_no_picture_is_processed() -> None:
    body = replace(SEEING, cameras=(replace(CAMERA, depth=False),))
    drive = Drive(Scene(boxes=(LOW,)), body=body)
    assert drive.go(50, AHEAD) == []
    assert drive.memory.field.cameras.pictures == 0


@pytest.mark.parametrize(
    ("yaw", "ways"),
    [(0.0, {"forward"}), (math.pi, {"backward"}), (math.pi / 4, {"forward", "left"})],
)
def test_the_directions_that_a_camera_should_see(yaw: float, ways: set[str]) -> None:
    assert directions(replace(CAMERA, yaw=yaw)) == ways


@pytest.mark.long
def test_random_pictures_raise_no_error() -> None:
    drive, random = Drive(Scene()), np.random.default_rng(5)

    def noise(seen: DepthImage) -> DepthImage:
        high = int(random.choice((300, 2000, 65536)))
        pixels = random.integers(0, high, (240, 320))
        pixels[random.random(pixels.shape) < random.random()] = 0
        return image(pixels, seen.tick)

    for asked in (AHEAD, LEFT, BACK):
        drive.go(100, asked, noise)
        assert drive.verdict.verdict == "slow"
    drive.go(50)
    assert drive.verdict.verdict in ("ok", "slow")


@pytest.mark.long
def test_extreme_cameras_and_mountings_raise_no_error() -> None:
    """On the floor or above the body, looking up, back or down, with extreme distortion."""
    random = np.random.default_rng(3)
    for number in range(60):
        camera = replace(
            CAMERA,
            width=64,
            height=48,
            field_of_view=random.uniform(0.1, 3.0),
            distortion=tuple(random.uniform(-100.0, 100.0, number % 9).tolist()),
            depth_min=random.choice((0.0, 0.25, 5.0)),
            depth_max=random.choice((5.1, 1000.0)),
            x=random.uniform(-10, 10),
            z=random.choice((-10.0, 0.0, 0.1, 10.0)),
            roll=random.uniform(-4, 4),
            pitch=random.choice((0.0, 1.57, -1.57, random.uniform(-4, 4))),
            yaw=random.uniform(-4, 4),
        )
        body = replace(SEEING, cameras=(camera,))
        pixels = random.integers(0, random.choice((1000, 65536)), (48, 64))
        drive = Drive.__new__(Drive)
        drive.__dict__.update(Drive(Scene(), body=replace(SEEING, cameras=())).__dict__, body=body)
        drive.go(20, AHEAD, lambda seen, pixels=pixels: image(pixels, seen.tick))  # type: ignore[misc]
        assert drive.memory.field.cameras.pictures >= 4


@pytest.mark.long
def test_a_camera_rolled_by_90_degrees_sees_the_same() -> None:
    camera = replace(CAMERA, roll=math.pi / 2, width=240, height=320, intrinsics=None)
    body = replace(SEEING, cameras=(camera,))
    drive = Drive(Scene(boxes=(LOW,)), eye=Eye(camera), body=body)
    assert drive.go(250, AHEAD) == ["zone_ahead"]


def test_distortion_is_part_of_the_rays() -> None:
    camera = replace(CAMERA, distortion=(-0.05, 0.01, 0.001, -0.001, 0.0))
    body = replace(SEEING, cameras=(camera,))
    view, plain = view_of(body, camera), view_of(SEEING, CAMERA)
    assert 0.001 < float(np.abs(view.rays - plain.rays).max()) < 0.1
