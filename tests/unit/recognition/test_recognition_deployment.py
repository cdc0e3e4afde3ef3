"""Deployment of recognition: its host, net and tags."""

from pathlib import Path

import pytest

from gigabrain_zenoh.cli.cameras import check_recognizer
from gigabrain_zenoh.cli.config import merged_file, merged_values
from gigabrain_zenoh.config.settings import RecognitionConfig, RecognizerConfig, TagConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment, load_deployment
from gigabrain_zenoh.launch.processes import node_of, process_type
from gigabrain_zenoh.launch.specs import process_specs


def names(deployment: Deployment, tmp_path: Path, host: str = "robot") -> list[str]:
    return [spec.name for spec in process_specs(deployment, host, tmp_path, tmp_path)]


def write_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    return path


def test_it_runs_on_the_host_of_perception_if_there_are_cameras_unless_placed_or_off(tmp_path):
    assert "recognition" not in names(Deployment(), tmp_path)
    assert "recognition" in names(Deployment(cameras=True), tmp_path)
    assert "recognition" not in names(Deployment(cameras=True, recognition=False), tmp_path)
    split = Deployment(
        cameras=True,
        router="tcp/127.0.0.1:7447",
        hosts={"robot": ("router", "driver"), "brain": ("perception", "decision")},
    )
    assert "recognition" not in names(split, tmp_path)
    assert "recognition" in names(split, tmp_path, "brain")
    hosts = {"robot": ("router", "driver", "perception"), "eye": ("recognition",)}
    placed = Deployment(cameras=True, hosts=hosts)
    assert "recognition" not in names(placed, tmp_path)
    assert names(placed, tmp_path, "eye") == ["recognition"]


def test_the_robot_can_drive_without_it(tmp_path):
    (spec,) = (
        spec
        for spec in process_specs(Deployment(cameras=True), "robot", tmp_path, tmp_path)
        if spec.name == "recognition"
    )
    assert spec.optional
    assert process_type("recognition").roles == ("robot", "brain")


def test_paths_in_a_deployment_file_are_relative_to_the_file(tmp_path):
    path = write_file(
        tmp_path,
        "cameras: on\n"
        "recognizer: {onnx: my.onnx, labels: coco.txt, layout: yolo}\n"
        "tags: {family: 25h9, size: 0.1, sizes: {'7': 0.2}}\n",
    )
    for deployment in (load_deployment(path), merged_file(str(path), (), ()).deployment):
        assert deployment.recognizer.onnx == str(tmp_path / "my.onnx")
        assert deployment.recognizer.labels == str(tmp_path / "coco.txt")
        assert deployment.recognizer.layout == "yolo"
        assert deployment.tags == TagConfig(family="25h9", size=0.1, sizes={"7": 0.2})
    assert process_type("recognition").derive(deployment, None) == RecognitionConfig(
        recognizer=deployment.recognizer, tags=deployment.tags
    )


def test_paths_on_the_command_line_are_relative_to_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sets = ("recognizer.layout=detr", "recognizer.labels=my.txt", "recognizer.onnx=my.onnx")
    deployment = merged_values({"body": "turtlebot3_waffle"}, (), sets).deployment
    assert deployment.recognizer == RecognizerConfig(
        onnx=str(tmp_path / "my.onnx"), labels=str(tmp_path / "my.txt"), layout="detr"
    )


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("recognizer: {onnx: a.onnx, layout: yolov8}", "robot.yaml:1: .*'detr', 'things', 'yolo'"),
        ("recognizer: {rate_hz: 0}", "robot.yaml:1: "),
        ("tags: {family: 36h12}", "robot.yaml:1: .*36h11"),
        ("tags: {sizes: {dock: 0.1}}", "robot.yaml:1: "),
        ("tags: {size: 0}", "robot.yaml:1: "),
        ("recognition: maybe", "robot.yaml:1: .*true or false"),
    ],
)
def test_an_error_in_the_file_is_reported_with_its_line(tmp_path, line, expected):
    with pytest.raises(ConfigError, match=expected) as refused:
        load_deployment(write_file(tmp_path, line + "\n"))
    assert "\n" not in str(refused.value)


def test_a_missing_net_is_refused_before_any_process_starts(tmp_path):
    recognizer = RecognizerConfig(
        onnx=str(tmp_path / "my.onnx"), labels=str(tmp_path / "my.txt"), layout="yolo"
    )
    deployment = Deployment(cameras=True, recognizer=recognizer)
    with pytest.raises(ConfigError, match=r"my\.onnx"):
        check_recognizer(deployment, "robot")
    check_recognizer(Deployment(recognizer=recognizer), "robot")
    check_recognizer(Deployment(cameras=True, recognition=False, recognizer=recognizer), "robot")
    hosts = {"robot": ("router", "driver"), "brain": ("perception", "decision")}
    placed = Deployment(cameras=True, recognizer=recognizer, hosts=hosts)
    check_recognizer(placed, "robot")
    with pytest.raises(ConfigError, match=r"my\.onnx"):
        check_recognizer(placed, "brain")


def test_settings_of_the_process_have_defaults():
    from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig

    assert node_of(ProcessConfig(name="recognition", endpoint=Endpoint()))
    assert RecognitionConfig().recognizer.rate_hz == 5.0
    assert RecognitionConfig().tags.size == 0.16
