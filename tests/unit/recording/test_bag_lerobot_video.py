"""Pictures of a recording as videos of a LeRobot dataset, read back frame by frame."""

import importlib.util
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_schemas.body import Body, BodyDescription, GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.examples import example
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh import codec
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording import lerobot, lerobot_video
from gigabrain_zenoh.recording.bag_writer import ReceivedMessage
from gigabrain_zenoh.recording.lerobot import convert
from gigabrain_zenoh.recording.lerobot_video import dequantized, quantized
from tests.unit.recording import bags

pytestmark = pytest.mark.skipif(
    not (importlib.util.find_spec("av") and importlib.util.find_spec("pyarrow")),
    reason="PyAV or pyarrow is not installed",
)

TICK_NS = 20_000_000
LATE_NS = 35_000_000  # from the exposure of a picture to its arrival
WIDTH, HEIGHT = 96, 64


def pixels(tick: int) -> NDArray[np.uint8]:
    """Return a picture that shows its tick: a bar that grows with it, and a shade."""
    picture = np.full((HEIGHT, WIDTH, 3), (90, 120, 60), np.uint8)
    picture[:, : 8 * (tick // 5 % 12)] = (200, 40 + tick % 200, 90)
    return picture


def image(tick: int, *, end: int | None = None, width: int = WIDTH) -> bytes:
    data = cv2.imencode(".jpg", pixels(tick), (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes()
    message = Image(
        stamp_ns=bags.BEGIN_NS + tick * TICK_NS, boot=7, basis=tick, tick=tick, frame_id="front",
        encoding="jpeg", width=width, height=HEIGHT, data=data[:end],
    )  # fmt: skip
    return codec.encode(message)


def distances(tick: int) -> NDArray[np.uint16]:
    """Return a slope of depth [mm] from 0.3 to 6 m that moves with the tick; a part is unknown."""
    depth = np.linspace(300, 6000, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) + tick
    depth[:8] = 0
    return depth.astype(np.uint16)


def depth_image(tick: int) -> bytes:
    message = DepthImage(
        boot=7, basis=tick, tick=tick, frame_id="front", width=WIDTH, height=HEIGHT,
        planes=pack_depth(distances(tick)),
    )  # fmt: skip
    return codec.encode(message)


def driving(states: int, boot: int = 7) -> Iterator[tuple[int, str, bytes]]:
    """Yield states of an enabled gate at 50 Hz, with a command before each."""
    for seq in range(1, states + 1):
        command = CmdVel(linear_x=seq / 1000, angular_z=seq / 500, source="control")
        yield seq * TICK_NS - 2, "robot/cmd_vel", codec.encode(command)
        state = msgspec.msgpack.decode(bags.state(seq, boot), type=RobotState)
        gate = GateStatus(mode="enabled", commander="control")
        state = msgspec.structs.replace(state, gate=gate)
        yield seq * TICK_NS, "robot/state", codec.encode(state)


def write(path: Path, *streams: Iterator[tuple[int, str, bytes]]) -> None:
    """Write messages in the order in which they arrive."""
    merged: list[tuple[int, str, bytes]] = sorted(each for stream in streams for each in stream)
    arrivals: list[ReceivedMessage] = [bags.arrival(*each) for each in merged]
    bags.write(path, iter(arrivals))


def pictures(ticks: range, key: str = "robot/image/front") -> Iterator[tuple[int, str, bytes]]:
    for tick in ticks:
        payload = depth_image(tick) if "depth" in key else image(tick)
        yield tick * TICK_NS + LATE_NS, key, payload


def frames_of(folder: Path, key: str, form: str) -> list[tuple[float, NDArray[Any]]]:
    """Decode a video of a dataset: time [s] and pixels of each frame."""
    import av

    file = folder / f"videos/{key}/chunk-000/file-000.mp4"
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        assert stream.time_base
        return [
            (float(frame.pts * stream.time_base), frame.to_ndarray(format=form))
            for frame in container.decode(stream)
        ]


def psnr(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Return the likeness of two pictures [dB]."""
    error = np.mean((one.astype(float) - other.astype(float)) ** 2)
    return float(10 * np.log10(255.0**2 / max(error, 1e-9)))


def info_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "meta/info.json").read_text())  # type: ignore[no-any-return]


@pytest.mark.long
def test_each_frame_has_the_picture_that_was_exposed_at_its_tick(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    write(path, driving(100), pictures(range(5, 101, 5)))
    summary = convert(path, folder)
    assert "front: 20 pictures, 0 frames repeat one" in summary
    found = frames_of(folder, "observation.images.front", "bgr24")
    assert [at for at, _ in found] == pytest.approx([number / 10 for number in range(20)])
    for number, (_, seen) in enumerate(found):
        tick = 5 * (number + 1)
        assert psnr(seen, pixels(tick)) > 33
        assert abs(seen.mean() - pixels(tick).mean()) < 2.0  # levels are kept, not stretched
        assert psnr(seen, pixels(tick - 5)) < 25  # its neighbours are others
        assert psnr(seen, pixels(tick + 5)) < 25


def test_a_dataset_that_failed_can_be_converted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    write(path, driving(50), pictures(range(5, 51, 5)))
    with monkeypatch.context() as without:
        without.setattr(lerobot_video, "find_spec", lambda _: None)
        with pytest.raises(ConfigError, match="videos need PyAV"):
            convert(path, folder)
    with monkeypatch.context() as full:
        full.setattr(lerobot, "write_videos", raising(OSError(28, "No space left on device")))
        with pytest.raises(ConfigError, match=r"cannot write .*dataset: the disk is full"):
            convert(path, folder)
    assert not folder.exists()
    convert(path, folder)
    with pytest.raises(ConfigError, match=r"cannot write .*dataset: that name is taken"):
        convert(path, folder)
    assert info_of(folder)["total_frames"] == 10


def raising(error: Exception) -> Callable[..., None]:
    def fail(*_: object) -> None:
        raise error

    return fail


def test_the_dataset_describes_its_videos(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    write(path, driving(100), pictures(range(5, 101, 5)))
    convert(path, folder)
    info = info_of(folder)
    assert info["video_path"].startswith("videos/{video_key}/")
    feature = info["features"]["observation.images.front"]
    assert (feature["dtype"], feature["shape"]) == ("video", [HEIGHT, WIDTH, 3])
    assert (feature["info"]["video.codec"], feature["info"]["is_depth_map"]) == ("h264", False)
    stats = json.loads((folder / "meta/stats.json").read_text())["observation.images.front"]
    assert np.shape(stats["mean"]) == (3, 1, 1)
    blue = [stats[name][2][0][0] for name in ("min", "max")]
    assert blue == pytest.approx([90 / 255, 200 / 255], abs=0.06)
    from pyarrow import parquet

    (episode,) = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert episode["videos/observation.images.front/from_timestamp"] == 0.0
    assert episode["videos/observation.images.front/to_timestamp"] == pytest.approx(2.0)
    data = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    assert "observation.images.front" not in data.column_names


def test_a_camera_at_the_wrist_is_a_video_beside_the_one_at_the_front(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    both = [pictures(range(5, 51, 5), f"robot/image/{name}") for name in ("front", "wrist")]
    write(path, driving(50), *both)
    convert(path, folder)
    features = info_of(folder)["features"]
    for key in ("observation.images.front", "observation.images.wrist"):
        assert (features[key]["dtype"], features[key]["shape"]) == ("video", [HEIGHT, WIDTH, 3])
        assert len(frames_of(folder, key, "bgr24")) == 10


def test_missing_pictures_are_repeated_and_counted(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    slow = pictures(range(25, 76, 25))  # 2 Hz; none for the first four frames and the last five
    write(path, driving(100), slow)
    assert "front: 3 pictures, 17 frames repeat one" in convert(path, folder)
    found = frames_of(folder, "observation.images.front", "bgr24")
    shown = [25] * 9 + [50] * 5 + [75] * 6
    assert [
        psnr(seen, pixels(tick)) > 30 for (_, seen), tick in zip(found, shown, strict=True)
    ] == ([True] * 20)


def test_broken_pictures_are_passed_over_and_counted(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    whole = list(pictures(range(5, 101, 5)))
    at, key, _ = whole[4]
    bad = {4: image(25, end=700), 9: image(50, end=20), 14: image(75, width=2 * WIDTH)}
    sent = [(at, key, bad.get(number, payload)) for number, (at, key, payload) in enumerate(whole)]
    sent.append((at + 1, key, b"garbage"))
    write(path, driving(100), iter(sent))
    assert "front: 17 pictures, 3 frames repeat one, 3 were broken" in convert(path, folder)
    found = frames_of(folder, "observation.images.front", "bgr24")
    assert psnr(found[4][1], pixels(20)) > 30
    assert psnr(found[5][1], pixels(30)) > 30


def test_a_camera_of_broken_pictures_only_is_left_out(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    sent = [(tick * TICK_NS, "robot/image/front", image(tick, end=30)) for tick in range(5, 50, 5)]
    write(path, driving(50), iter(sent))
    convert(path, folder)
    assert not [key for key in info_of(folder)["features"] if "images" in key]


def test_keys_that_name_no_camera_make_no_files(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    names = ["..", "a b", "a\0b", "x" * 40, *(f"cam{number}" for number in range(20))]
    sent = [
        (tick * TICK_NS, f"robot/image/{name}", image(tick)) for tick in (5, 10) for name in names
    ]
    write(path, driving(20), iter(sent))
    convert(path, folder)
    made = [each.name for each in (folder / "videos").iterdir()]
    assert len(made) == 16
    assert set(made) <= {f"observation.images.cam{number}" for number in range(20)}


def test_depth_comes_back_as_lerobot_reads_it(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    write(path, driving(50), pictures(range(5, 51, 5), "robot/depth/front"))
    assert "front_depth: 10 pictures, 0 frames repeat one" in convert(path, folder)
    feature = info_of(folder)["features"]["observation.images.front_depth"]
    assert (feature["dtype"], feature["shape"]) == ("video", [HEIGHT, WIDTH, 1])
    assert (feature["info"]["is_depth_map"], feature["info"]["video.pix_fmt"]) == (True, "gray12le")
    found = frames_of(folder, "observation.images.front_depth", "gray12le")
    for number, (_, codes) in enumerate(found):
        truth = distances(5 * (number + 1))
        known = truth > 0
        assert np.abs(1000 * dequantized(codes)[known] - truth[known]).max() < 2.0  # [mm]
        assert (codes[~known] == 0).all()


def test_the_scale_of_depth_is_that_of_lerobot() -> None:
    # computed with quantize_depth of lerobot 0.6.1
    depth = np.array([10, 500, 1000, 3000, 10000, 20000], np.uint16)
    assert quantized(depth).tolist() == [0, 397, 755, 1873, 4095, 4095]


def test_episodes_of_two_starts_follow_each_other_in_the_video(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    later = 3_000_000_000
    again = [(at + later, key, payload) for at, key, payload in driving(50, boot=8)]
    seen = pictures(range(5, 51, 5))
    of_the_second = [
        (
            tick * TICK_NS + later + LATE_NS,
            "robot/image/front",
            codec.encode(
                msgspec.structs.replace(
                    msgspec.msgpack.decode(image(100 - tick), type=Image), boot=8, basis=tick
                )
            ),
        )
        for tick in range(5, 51, 5)
    ]
    write(path, driving(50), seen, iter(again), iter(of_the_second))
    assert "front: 20 pictures, 0 frames repeat one" in convert(path, folder)
    found = frames_of(folder, "observation.images.front", "bgr24")
    assert psnr(found[9][1], pixels(50)) > 30
    assert psnr(found[10][1], pixels(95)) > 30
    from pyarrow import parquet

    table = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    starts = [one["videos/observation.images.front/from_timestamp"] for one in table]
    assert starts == pytest.approx([0.0, 1.0])


def test_the_speed_to_the_side_is_left_out_where_the_body_has_none(tmp_path: Path) -> None:
    path, folder = tmp_path / "a.mcap", tmp_path / "dataset"
    body = example(Body)
    description: BodyDescription = msgspec.structs.replace(
        body.description, max_lateral_speed=0.0, joints=(), arm=None
    )
    told = codec.encode(msgspec.structs.replace(body, description=description))
    write(path, driving(50), iter([(1, "robot/body", told)]))
    convert(path, folder)
    info = info_of(folder)
    assert info["features"]["action"]["names"] == ["linear_x", "angular_z"]
    assert info["features"]["observation.state"]["shape"] == [5]
    assert info["robot_type"] == description.robot_type
    from pyarrow import parquet

    data = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    assert data["action"][1].as_py() == pytest.approx([0.010, 0.020])
