"""Cameras in a robot's file, and where each link has its pictures from."""

import shutil
from pathlib import Path

import pytest

from gigabrain_drivers.cameras.catalog import cameras_of
from gigabrain_drivers.driver.catalog import load_link, load_robot, robot_files
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim import exposes
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.cli.cameras import with_cameras
from gigabrain_zenoh.config import loading
from gigabrain_zenoh.config.settings import DriverConfig, LinkName
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.launch.specs import process_specs

BODY = """summary: a box with eyes
robot_type: seer
drive_type: differential
wheel_separation: 0.287
wheel_radius: 0.033
max_linear_speed: 0.26
max_angular_speed: 1.82
footprint: [[0.075, 0.155], [-0.2, 0.155], [-0.2, -0.155], [0.075, -0.155]]
cameras:
  - {name: front, rate_hz: 15, depth: true, x: 0.06, z: 0.1}
  - {name: rear, width: 640, height: 480, yaw: 3.14}
sim:
  driver: mujoco
real:
  driver: opencr
  port: usb:0483:5740
"""


def file(tmp_path: Path, old: str = "", new: str = "") -> str:
    path = tmp_path / "robot.yaml"
    assert old in BODY
    path.write_text(BODY.replace(old, new, 1))
    return str(path)


def error_of(path: str, link: LinkName = "sim") -> str:
    with pytest.raises(ConfigError) as caught:
        cameras_of(path, link, {})
    return str(caught.value).replace(path, "robot.yaml")


def test_without_being_asked_for_a_body_has_no_cameras() -> None:
    assert len(load_robot("turtlebot3_waffle").cameras) == 1
    robot, *_ = load_link("turtlebot3_waffle", Run(folder=Path()))
    assert robot.description().cameras == ()
    robot, *_ = load_link("turtlebot3_waffle", Run(folder=Path(), cameras=True))
    assert [one.name for one in robot.description().cameras] == ["front"]
    assert not DriverConfig(body="x", state_dir="").cameras
    assert not Deployment().cameras


def test_the_waffle_has_the_camera_of_the_real_one() -> None:
    assert load_robot("turtlebot3_waffle").cameras == (
        Camera(name="front", width=320, height=240, rate_hz=10.0, depth=True, x=0.064, z=0.094),
    )


def test_every_shipped_body_has_its_own_height() -> None:
    heights = {name: load_robot(name).body_height for name in robot_files()}
    assert heights["turtlebot3_burger"] == 0.192
    assert heights["alpha"] == 0.40
    assert 0.5 not in heights.values()  # the default


@pytest.mark.parametrize("link", ["sim", "emulated"])
def test_a_simulated_world_is_rendered_where_the_file_says_nothing(
    tmp_path: Path, link: LinkName
) -> None:
    found = cameras_of(file(tmp_path), link, {})
    assert [(one.camera.name, one.options.source) for one in found] == [
        ("front", "mujoco"),
        ("rear", "mujoco"),
    ]


def test_a_link_may_name_a_source_for_each_camera(tmp_path: Path) -> None:
    part = "  cameras: {rear: {source: opencv, device: /dev/video9}, front: {source: mujoco}}\n"
    path = file(tmp_path, "  driver: mujoco\n", f"  driver: mujoco\n{part}")
    front, rear = cameras_of(path, "sim", {})
    assert (front.options.source, rear.options.source) == ("mujoco", "opencv")
    assert rear.options.device == "/dev/video9"  # type: ignore[attr-defined]


def test_the_real_link_names_all_sources(tmp_path: Path) -> None:
    assert error_of(file(tmp_path), "real") == (
        "robot.yaml:14: camera 'front' has no source on the link 'real'; name one that gives "
        "depth, or write `depth: false`"
    )
    assert error_of(file(tmp_path, "depth: true, "), "real") == (
        "robot.yaml:14: camera 'front' has no source on the link 'real'; add "
        "`cameras: {front: {source: opencv, device: /dev/video0}}` to it"
    )


def test_a_camera_with_depth_is_not_read_by_opencv(tmp_path: Path) -> None:
    part = "  cameras: {front: {source: opencv, device: /dev/video0}}\n"
    assert error_of(file(tmp_path, "  driver: mujoco\n", f"  driver: mujoco\n{part}")) == (
        "robot.yaml:12: camera 'front' gets no depth from the source 'opencv'; name one that "
        "gives depth, or write `depth: false`"
    )


@pytest.mark.parametrize(
    ("part", "wanted"),
    [
        ("cameras: {top: {source: mujoco}}", "robot.yaml:14: unknown field 'top'"),
        ("cameras: {rear: {source: opencv}}", "robot.yaml:14: sim.cameras.rear: missing field"),
        ("cameras: {rear: {source: opencw, device: x}}", "robot.yaml:14: no camera source"),
        ("cameras: {rear: {source: mujoco, quality: 0}}", "sim.cameras.rear.quality: expected"),
        ("cameras: {rear: {quality: 50}}", "missing field 'source'"),
        ("cameras: {rear: mujoco}", "robot.yaml:14: sim.cameras.rear: expected"),
        ("cameras: [rear]", "robot.yaml:14: sim.cameras: expected a mapping"),
    ],
)
def test_a_wrong_source_is_named_with_its_line(tmp_path: Path, part: str, wanted: str) -> None:
    path = file(tmp_path, "  driver: mujoco\n", f"  driver: mujoco\n  {part}\n")
    assert wanted in error_of(path)


@pytest.mark.parametrize(
    ("old", "new", "wanted"),
    [
        ("name: rear", "name: front", "robot.yaml:9: cameras: each needs a name of its own"),
        ("width: 640", "width: 641", "robot.yaml:11: cameras[1].width: expected a whole number"),
        ("height: 480", "hight: 480", "robot.yaml:11: unknown field 'hight'; did you mean"),
        ("rate_hz: 15", "rate_hz: 1e9", "robot.yaml:10: cameras[0].rate_hz: expected a number"),
        ("depth: true", "depth: 2", "robot.yaml:10: cameras[0].depth: expected true or false"),
        ("name: rear", "name: ../rear", "robot.yaml:11: cameras[1].name: expected"),
        ("name: rear", "name: rear²", "robot.yaml:11: cameras[1].name: expected"),
    ],
)
def test_a_wrong_camera_is_named_with_its_line(
    tmp_path: Path, old: str, new: str, wanted: str
) -> None:
    assert wanted in error_of(file(tmp_path, old, new))


@pytest.mark.parametrize(
    ("link", "wanted"),
    [
        (
            "griper",
            "robot.yaml:20: camera 'wrist': no link 'griper'; did you mean 'gripper'? known: ",
        ),
        ("base", "no link 'base'; known: gripper, jaw, lower_arm, shoulder, upper_arm, wrist"),
        ("tool", "no link 'tool'; known: "),  # a site of the model
        ("gripper, depth: true", "robot.yaml:21: cameras[1].link: a camera on an arm cannot "),
    ],
)
def test_a_link_that_can_carry_no_camera_is_named_with_its_line(
    tmp_path: Path, link: str, wanted: str
) -> None:
    folder = Path(shutil.copytree(robot_files()["so101"].parent, tmp_path / "arm"))
    path = folder / "robot.yaml"
    path.write_text(path.read_text().replace("link: gripper", f"link: {link}"))
    assert wanted in error_of(str(path))


def test_a_link_without_an_arm_is_refused(tmp_path: Path) -> None:
    path = file(tmp_path, "name: rear", "name: rear, link: hand")
    assert error_of(path) == "robot.yaml:9: cameras: link: the body has no arm; leave it out"


@pytest.mark.parametrize(("name", "link"), [("so101", "gripper"), ("lekiwi", "arm_gripper")])
def test_arms_have_a_small_camera_at_the_wrist_behind_the_others(name: str, link: str) -> None:
    robot, *_ = load_link(name, Run(folder=Path(), cameras=True))
    *others, wrist = robot.cameras
    assert (wrist.name, wrist.link, wrist.depth) == ("wrist", link, False)
    assert robot.fixed_cameras == tuple(others)
    assert load_link(name, Run(folder=Path()))[0].cameras == ()


def test_cameras_are_on_in_a_deployment() -> None:
    def on(text: str) -> Deployment:
        return loading.loads(text, Deployment, "robot.yaml")

    assert on("cameras: on").cameras
    assert on("cameras: true").cameras
    assert not on("cameras: off").cameras
    with pytest.raises(ConfigError, match=r"robot.yaml:1: .*expected true or false, got 'maybe'"):
        on("cameras: maybe")
    with pytest.raises(ConfigError, match="got off, which is read as false; quote it"):
        on("perception: {mapping: off}")


def test_the_camera_s_process_runs_beside_the_driver_unless_it_is_placed(tmp_path: Path) -> None:
    def names(deployment: Deployment, host: str = "robot") -> list[str]:
        return [spec.name for spec in process_specs(deployment, host, tmp_path, tmp_path)]

    assert "camera" not in names(Deployment())
    assert "camera" in names(Deployment(cameras=True))
    hosts = {"robot": ("router", "driver"), "eye": ("camera",)}
    placed = Deployment(cameras=True, hosts=hosts)
    assert "camera" not in names(placed)
    assert names(placed, "eye") == ["camera"]


def test_the_arguments_of_a_process_hold_no_password(tmp_path: Path) -> None:
    source = {"source": "opencv", "device": "rtsp://admin:secret@cam/live"}
    robot = {"real": {"cameras": {"rear": source}}}
    deployment = Deployment(cameras=True, link="real", robot=robot)
    specs = {one.name: one for one in process_specs(deployment, "robot", tmp_path, tmp_path)}
    assert all("secret" in specs[name].config for name in ("driver", "camera"))
    shown = [text for one in specs.values() for text in (*one.argv, one.fork and one.fork.title)]
    assert not any("secret" in text for text in shown if text)


def test_a_camera_takes_pictures_at_its_rate() -> None:
    def ticks(rate_hz: float) -> list[int]:
        return [tick for tick in range(1, 101) if exposes(rate_hz, tick)]

    assert ticks(10.0) == list(range(5, 101, 5))
    assert ticks(50.0) == ticks(120.0) == list(range(1, 101))
    assert len(ticks(30.0)) == 60
    assert len(ticks(0.5)) == 1


def test_a_camera_that_is_read_cannot_follow_another_speed(tmp_path: Path) -> None:
    part = "  cameras: {rear: {source: opencv, device: film.mp4}}\n"
    path = file(tmp_path, "  driver: mujoco\n", f"  driver: mujoco\n{part}")
    with pytest.raises(ConfigError, match="camera 'rear' runs in real time"):
        with_cameras(Deployment(body=path, cameras=True, speed=3.0), "robot")


def test_a_host_without_the_camera_s_process_checks_nothing() -> None:
    hosts = {"robot": ("router", "driver"), "eye": ("camera",)}
    deployment = Deployment(body="turtlebot3_burger", cameras=True, hosts=hosts)
    assert with_cameras(deployment, "robot") is deployment
    with pytest.raises(ConfigError, match="has no cameras"):
        with_cameras(deployment, "eye")
    off = Deployment(body="turtlebot3_burger")
    assert with_cameras(off, "robot") is off
