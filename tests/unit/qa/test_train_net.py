"""The net gives the same result in TensorFlow and as ONNX; needs the extra `train`."""

import numpy as np
import pytest

pytest.importorskip("gigabrain_zenoh.qa.train.net", reason="needs the extra train")
pytest.importorskip("onnx")

import cv2

from gigabrain_zenoh.qa.train import learning, net
from gigabrain_zenoh.qa.train.export import export
from gigabrain_zenoh.qa.train.pictures import Labelled
from gigabrain_zenoh.vision.recognizer import Recognizer

MAX_PARAMETERS, MAX_BYTES = 400_000, 2_000_000


def net_with_moments():
    """Return a net with random moments, so that normalisation has an effect."""
    params, moments = net.init(0)
    rng = np.random.default_rng(0)
    for own in moments.values():
        own["mean"] = rng.normal(0, 0.1, own["mean"].shape).astype(np.float32)
        own["variance"] = rng.uniform(0.5, 2, own["variance"].shape).astype(np.float32)
    return params, moments


def test_the_exported_net_gives_the_same_output_and_is_small(tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    params, moments = net_with_moments()
    path = tmp_path / "net.onnx"
    export(params, moments, path)
    assert net.parameters(params) <= MAX_PARAMETERS
    assert path.stat().st_size <= MAX_BYTES
    picture = np.random.default_rng(1).random((1, 3, 240, 320), np.float32)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (theirs,) = session.run(None, {"picture": picture})
    runner = cv2.dnn.readNetFromONNX(str(path))
    runner.setInput(picture)
    assert np.abs(runner.forward() - theirs).max() < 1e-3
    ours, _ = net.apply(params, moments, picture.transpose(0, 2, 3, 1), False)
    assert np.abs(np.asarray(ours).transpose(0, 3, 1, 2) - theirs).max() < 1e-3


def test_training_and_the_recogniser_decode_the_same_boxes(tmp_path):
    raw = np.random.default_rng(2).normal(0, 1, (1, 30, 40, 4)).astype(np.float32)
    box = np.asarray(learning.corners(raw))[0, 15, 20]
    cells = np.full((13, 30, 40), -9.0, np.float32)
    cells[0, 15, 20], cells[9:, 15, 20] = 3.0, raw[0, 15, 20]
    from gigabrain_zenoh.vision.recognizer import decode

    assert decode(cells).boxes[0] == pytest.approx(np.clip(box, 0, [320, 240, 320, 240]), abs=1e-3)


def test_the_box_loss_is_zero_for_a_perfect_box_and_grows_with_the_error():
    wanted, weight = np.array([[[[0, 0, 10, 10]]]], np.float32), np.ones((1, 1, 1), np.float32)
    costs = [
        float(learning.box_loss(wanted + np.float32(shift), wanted, weight)) for shift in (0, 5, 50)
    ]
    assert costs[0] == pytest.approx(0, abs=1e-6)
    assert costs[0] < costs[1] < costs[2]


@pytest.mark.slow
def test_training_continues_from_a_checkpoint_and_learns_one_picture(tmp_path, monkeypatch):
    stages = (learning.Stage(0.5, 192, 144, 2), learning.Stage(1.0, 320, 240, 2))
    monkeypatch.setattr(learning, "STAGES", stages)
    monkeypatch.setattr(learning, "WARM_UP_STEPS", 5)
    picture = np.full((240, 320, 3), 90, np.uint8)
    picture[80:160, 100:180] = (250, 30, 30)
    jpeg = cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes()
    one = Labelled(
        jpeg,
        np.array([[100, 80, 180, 160]], np.float32),
        np.array([0]),
        np.ones(1, np.float32),
        np.zeros(1, bool),
    )
    learning.learn([one], 60, tmp_path)
    state = learning.learn([one], 120, tmp_path)
    path = tmp_path / "net.onnx"
    export(state.averaged, state.moments, path)
    found = Recognizer(path, min_confidence=0.1).find(picture)
    assert found.names()[0] == "cube"
    assert np.abs(found.boxes[0] - [100, 80, 180, 160]).max() < 16
