"""Nets of one's own: the layouts that people export, and what is refused."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_zenoh.config.settings import RecognizerConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.vision import nets
from gigabrain_zenoh.vision.labels import COCO_IDS
from gigabrain_zenoh.vision.nets import Net, load_net, read_labels
from gigabrain_zenoh.vision.onnx_file import input_of
from tests.unit.vision.onnx_bytes import write_net

BLACK = np.zeros((240, 320, 3), np.uint8)
SIZE = (1, 3, 320, 320)


def labels(tmp_path: Path, *names: str) -> str:
    path = tmp_path / "labels.txt"
    path.write_text("\n".join(names) + "\n")
    return str(path)


def yolo(*boxes: tuple[float, ...], classes: int = 2) -> np.ndarray:
    """An answer (1, 4 + classes, n): middle, size and scores of each box."""
    empty = [(0.0,) * (4 + classes)] * 20
    return np.array([[*boxes, *empty]], np.float32).transpose(0, 2, 1).copy()


def load(tmp_path: Path, layout: str, *names: str, sure: float = 0.3) -> Net:
    config = RecognizerConfig(
        onnx=str(tmp_path / "my.onnx"), labels=labels(tmp_path, *names), layout=layout,
        min_confidence=sure,
    )  # fmt: skip
    net = load_net(config)
    assert net
    return net


def test_a_yolo_export_gives_boxes_of_the_picture_behind_its_grey_bars(tmp_path):
    answer = yolo((160, 160, 40, 20, 0.1, 0.9), (60, 200, 20, 30, 0.6, 0.2))
    write_net(tmp_path / "my.onnx", SIZE, answer)
    found = load(tmp_path, "yolo", "cat", "dog").find(BLACK)
    assert found.names() == ("dog", "cat")
    assert found.confidences == pytest.approx([0.9, 0.6])
    # 320 x 240 lies in the middle of 320 x 320, 40 pixels down
    assert found.boxes == pytest.approx(np.array([[140, 110, 180, 130], [50, 145, 70, 175]]))


def test_of_overlapping_boxes_of_one_class_one_is_kept(tmp_path):
    answer = yolo((160, 160, 40, 20, 0.0, 0.9), (162, 160, 40, 20, 0.0, 0.8))
    write_net(tmp_path / "my.onnx", SIZE, answer)
    assert len(load(tmp_path, "yolo", "cat", "dog").find(BLACK)) == 1


def test_an_export_that_drops_overlaps_itself_is_read_too(tmp_path):
    rows = [[10, 50, 60, 90, 0.8, 1], [10, 50, 60, 90, 0.7, 1], [0, 0, 1, 1, 0.1, 0]]
    write_net(tmp_path / "my.onnx", SIZE, np.array([rows], np.float32))
    found = load(tmp_path, "yolo", "cat", "dog").find(BLACK)
    assert found.names() == ("dog", "dog")
    assert found.boxes[0] == pytest.approx([10, 10, 60, 50])


def test_a_net_gets_red_first_and_values_from_0_to_1(tmp_path):
    answer, red = yolo((160, 160, 40, 20, 0.0, 0.1)), yolo((0, 0, 0, 0, 0.0, 0.8))
    write_net(tmp_path / "my.onnx", SIZE, answer, red)
    net = load(tmp_path, "yolo", "cat", "dog")
    colours = np.zeros((320, 320, 3), np.uint8)
    colours[..., 0] = 255
    assert net.find(colours).confidences == pytest.approx([0.9], abs=1e-3)
    assert len(net.find(np.roll(colours, 1, axis=2))) == 0


def test_a_net_of_dynamic_size_is_run_at_the_picture_s(tmp_path):
    answer = yolo((160, 128, 40, 20, 0.0, 0.9))
    write_net(tmp_path / "my.onnx", ("batch", 3, "height", "width"), answer)
    assert input_of(tmp_path / "my.onnx") == ("images", (None, 3, None, None))
    net = load(tmp_path, "yolo", "cat", "dog")
    assert net.find(BLACK).boxes == pytest.approx(np.array([[140, 110, 180, 130]]))  # 320 x 256
    assert nets._rounded(BLACK) == (256, 320)
    assert nets._rounded(np.zeros((1080, 1920, 3), np.uint8)) == (384, 640)


def test_answers_of_nonsense_give_nothing(tmp_path):
    answer = yolo((np.nan, 0, 10, 10, 0.9, 0.0), (0, 0, np.inf, 1, 0.0, 0.9))
    write_net(tmp_path / "my.onnx", SIZE, answer)
    assert len(load(tmp_path, "yolo", "cat", "dog").find(BLACK)) == 0


def test_a_class_whose_line_is_empty_is_not_reported(tmp_path):
    answer = yolo((160, 160, 40, 20, 0.9, 0.1, 0.0), (60, 200, 20, 30, 0, 0.8, 0), classes=3)
    write_net(tmp_path / "my.onnx", SIZE, answer)
    found = load(tmp_path, "yolo", "cat", "", "dog").find(BLACK)
    assert found.names() == ("cat",)


def test_the_own_layout_may_have_other_classes(tmp_path):
    answer = np.full((1, 6, 30, 40), -9.0, np.float32)
    answer[0, 1, 15, 20], answer[0, 2:, 15, 20] = 3.0, np.log(10 / 16)
    write_net(tmp_path / "my.onnx", (1, 3, 240, 320), answer)
    found = load(tmp_path, "things", "mug", "shoe").find(BLACK)
    assert found.names() == ("shoe",)
    assert found.boxes[0] == pytest.approx([154, 114, 174, 134], abs=0.01)


@pytest.mark.parametrize(
    ("layout", "names", "dims", "expected"),
    [
        ("yolo", ("cat",), SIZE, "2 classes, but its labels have 1"),
        ("yolo", ("cat", "dog", "cow"), SIZE, "2 classes, but its labels have 3"),
        ("yolo", ("cat", "dog"), (4, 3, 320, 320), "one picture"),
        ("yolo", ("cat", "dog"), (1, 1, 320, 320), "one picture"),
        ("yolo", ("cat", "dog"), (1, 300), "one picture"),
        ("things", ("cat", "dog"), SIZE, "layout: yolo"),
        ("things", ("cat", "dog"), (1, 3, 240, 320), "expected 1 x 6"),
    ],
)
def test_a_net_that_does_not_fit_is_refused_in_one_line(tmp_path, layout, names, dims, expected):
    write_net(tmp_path / "my.onnx", dims, yolo((160, 160, 40, 20, 0.0, 0.9)))
    with pytest.raises(ConfigError, match=expected) as refused:
        load(tmp_path, layout, *names)
    assert "\n" not in str(refused.value)
    assert "my.onnx" in str(refused.value)


@pytest.mark.parametrize("layout", ["things", "yolo", "detr"])
def test_a_file_that_is_no_net_is_refused_in_one_line(tmp_path, layout):
    rng = np.random.default_rng(0)
    whole = write_net(tmp_path / "my.onnx", SIZE, yolo()).read_bytes()
    for data in (b"", b"no net", whole[:200], whole[:-3], rng.bytes(400), bytes(400)):
        (tmp_path / "my.onnx").write_bytes(data)
        with pytest.raises(ConfigError, match=r"my\.onnx") as refused:
            load(tmp_path, layout, "cat", "dog")
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [({"layout": "yolo"}, "`onnx`"), ({"layout": "detr", "onnx": "a.onnx"}, "labels: missing")],
)
def test_a_layout_needs_a_net_and_labels(settings, expected):
    with pytest.raises(ConfigError, match=expected):
        load_net(RecognizerConfig(**settings))


def test_any_bytes_are_a_net_or_are_refused(tmp_path):
    rng = np.random.default_rng(1)
    path = tmp_path / "my.onnx"
    whole = write_net(path, SIZE, yolo()).read_bytes()
    read = 0
    for _ in range(600):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 6)):
            data[at] = rng.integers(256)
        path.write_bytes(data[: rng.integers(1, len(data) + 1)] if rng.random() < 0.3 else data)
        with contextlib.suppress(ConfigError):
            read += bool(input_of(path).name)
    assert 100 < read < 600


def test_a_missing_net_or_list_of_labels_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"my\.onnx: no such file"):
        load(tmp_path, "yolo", "cat")
    write_net(tmp_path / "my.onnx", SIZE, yolo())
    config = RecognizerConfig(onnx=str(tmp_path / "my.onnx"), labels="none.txt", layout="yolo")
    with pytest.raises(ConfigError, match=r"none\.txt: no such file"):
        load_net(config)


def test_labels_are_lines_of_text(tmp_path):
    path = tmp_path / "labels.txt"
    path.write_text("person\n traffic light \r\n\ndog\n\n")
    assert read_labels(path) == ("person", "traffic light", "", "dog")
    path.write_bytes(b"\xef\xbb\xbfperson\r\n")  # with a byte-order mark
    assert read_labels(path) == ("person",)
    for data, expected in ((b"\n \n", "no class"), (b"\xff\xfe", "UTF-8"), (b"x" * 65, ":1: ")):
        path.write_bytes(data)
        with pytest.raises(ConfigError, match=expected):
            read_labels(path)


class Session:
    """ONNX Runtime with known answers."""

    def __init__(self, logits: np.ndarray, boxes: np.ndarray, names: tuple[str, str]) -> None:
        self.answers, self.names = [logits[None], boxes[None]], names
        self.got: list[np.ndarray] = []

    def get_inputs(self) -> list[Any]:
        return [type("Input", (), {"name": "images"})()]

    def get_outputs(self) -> list[Any]:
        return [type("Output", (), {"name": name})() for name in self.names]

    def run(self, _names: None, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        self.got.append(feed["images"])
        return self.answers


def detr(tmp_path, monkeypatch, names, logits, outputs=("logits", "pred_boxes")):
    boxes = np.tile(np.array((0.5, 0.5, 0.25, 0.5), np.float32), (len(logits), 1))
    session = Session(np.array(logits, np.float32), boxes, outputs)
    monkeypatch.setattr(nets, "_session", lambda _: session)
    write_net(tmp_path / "my.onnx", (1, 3, 384, 384), yolo())
    return load(tmp_path, "detr", *names), session


def test_detr_heads_have_none_as_their_last_class(tmp_path, monkeypatch):
    net, _ = detr(tmp_path, monkeypatch, ("cat", "dog"), [(0, 2, 0), (0, 1, 5), (1, 0, 0.5)])
    found = net.find(BLACK)
    assert found.names() == ("dog", "cat")
    e = np.exp([0, 2, 0])
    assert found.confidences[0] == pytest.approx(e[1] / e.sum())
    assert found.boxes[0] == pytest.approx([120, 60, 200, 180])


def test_rf_detr_scores_by_sigmoid(tmp_path, monkeypatch):
    names, outputs = ("cat", "dog"), ("dets", "labels")
    net, session = detr(tmp_path, monkeypatch, names, [(-9, 1, -9), (-9, -9, 9)], outputs)
    found = net.find(np.full((240, 320, 3), (255, 0, 0), np.uint8))
    assert found.names() == ("dog",)
    assert found.confidences[0] == pytest.approx(1 / (1 + np.exp(-1)))
    blob = session.got[-1]
    assert blob.shape == (1, 3, 384, 384)
    assert blob[0, :, 200, 200] == pytest.approx(
        [(1 - 0.485) / 0.229, -0.456 / 0.224, -0.406 / 0.225]
    )


@pytest.mark.parametrize(("outputs", "sigmoid"), [(91, True), (92, False)])
def test_80_labels_of_coco_are_spread_over_its_90_numbers(tmp_path, monkeypatch, outputs, sigmoid):
    names = tuple(f"class{number}" for number in range(80))
    logits = np.full((3, outputs), -9.0)
    logits[0, 1] = logits[1, 90] = logits[2, 12] = 4.0
    net, _ = detr(tmp_path, monkeypatch, names, logits)
    found = net.find(BLACK)
    assert sorted(found.names()) == ["class0", "class79"]
    assert (found.confidences[0] < 0.985) == sigmoid
    assert len(COCO_IDS) == 80


def test_detr_heads_of_other_shapes_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="5 classes, but its labels have 2"):
        detr(tmp_path, monkeypatch, ("cat", "dog"), [(0, 1, 2, 3, 4)])
    with pytest.raises(ConfigError, match="layout `detr` expects logits"):
        detr(tmp_path, monkeypatch, ("cat", "dog"), [[(0, 1, 2)]])


@pytest.mark.parametrize("outputs", [("logits", "pred_boxes"), ("labels", "dets")])
def test_of_four_logits_and_four_sides_the_name_tells_which_are_boxes(
    tmp_path, monkeypatch, outputs
):
    names = ("cat", "dog", "cow")
    net, _ = detr(tmp_path, monkeypatch, names, [(-9, -9, 3, -9), (-9, 1, -9, 2)], outputs)
    found = net.find(BLACK)
    assert found.names()[0] == "cow"
    assert found.boxes[0] == pytest.approx([120, 60, 200, 180])
    assert len(found) == (2 if "dets" in outputs else 1)  # with a sigmoid each class is by itself


def test_without_onnx_runtime_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(nets.importlib.util, "find_spec", lambda _: None)
    write_net(tmp_path / "my.onnx", SIZE, yolo())
    with pytest.raises(ConfigError, match="pip install onnxruntime"):
        load(tmp_path, "detr", "cat", "dog")
