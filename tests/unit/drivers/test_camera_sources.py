"""Pictures of files, and of recordings, come as those of a camera do."""

import contextlib
import itertools
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Container
from contextlib import closing
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

from gigabrain_drivers.cameras import opencv
from gigabrain_drivers.cameras.base import CameraLost, CameraSite, CameraSource
from gigabrain_drivers.cameras.opencv import OpenCvCamera, OpenCvOptions, fitted
from gigabrain_drivers.cameras.replay import ReplayedCamera, ReplayOptions
from gigabrain_schemas.body import Camera
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import DEPTH, IMAGE, Topic
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.headers import header_of
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.recording.bag_writer import BagWriter, ReceivedMessage
from gigabrain_zenoh.recording.recorder import Recorder

PLAIN = Camera(name="front", width=64, height=48)
RGBD = Camera(name="front", width=64, height=48, depth=True)
GREYS = (40, 120, 200)


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The pauses [s] that were asked for; none is made."""
    pauses: list[float] = []
    monkeypatch.setattr(time, "sleep", pauses.append)
    return pauses


def film(path: Path, width: int = 64, height: int = 48) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (width, height))
    for grey in GREYS:
        writer.write(np.full((height, width, 3), grey, np.uint8))
    writer.release()


def camera(tmp_path: Path, device: str, camera: Camera = PLAIN, **more: object) -> OpenCvCamera:
    options = OpenCvOptions(source="opencv", device=device, **more)  # type: ignore[arg-type]
    return OpenCvCamera(options, camera, CameraSite(str(tmp_path)))


def means(source: CameraSource, count: int) -> list[int]:
    pictures = [source.read().picture for _ in range(count)]
    assert all(one is not None and one.shape == (48, 64, 3) for one in pictures)
    return [round(float(one.mean()) / 40) * 40 for one in pictures if one is not None]


class Opening(threading.Thread):
    """Opens a source in a thread, and keeps the text of its error."""

    def __init__(self, source: CameraSource) -> None:
        super().__init__(daemon=True)
        self._source, self.error = source, ""
        self.start()

    def run(self) -> None:
        try:
            self._source.open()
        except CameraLost as error:
            self.error = str(error)


def waits_on(connection: socket.socket) -> bool:
    """Return whether the other end has not closed a connection."""
    connection.setblocking(False)
    try:
        while connection.recv(1000):
            pass
    except BlockingIOError:
        return True
    return False


def test_a_film_is_shown_at_the_camera_s_rate_and_ends(tmp_path: Path, slept: list[float]) -> None:
    film(tmp_path / "film.avi")
    source = camera(tmp_path, "film.avi")
    source.open()
    assert means(source, 3) == [*GREYS]
    assert slept[-1] == pytest.approx(0.3, abs=0.1)  # from its start
    with pytest.raises(CameraLost, match=r"film.avi has ended"):
        source.read()
    source.close()
    source.close()
    with pytest.raises(CameraLost, match=r"film.avi has ended"):
        source.open()  # as the process does after a loss


@pytest.mark.usefixtures("slept")
def test_what_cannot_be_rewound_is_opened_again_if_it_repeats(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "still.png"), np.full((48, 64, 3), GREYS[0], np.uint8))
    source = camera(tmp_path, "still.png", repeat=True)
    for _ in range(3):  # as the process does after a loss
        source.open()
        assert means(source, 1) == [GREYS[0]]
        with contextlib.suppress(CameraLost):
            source.read()
        source.close()


def test_a_film_goes_on_at_its_rate_after_the_process_was_stopped(
    tmp_path: Path, slept: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    film(tmp_path / "film.avi")
    source = camera(tmp_path, "film.avi", repeat=True)
    now_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0] + sum(slept))
    source.open()
    means(source, 2)
    now_s[0] += 60.0  # stopped, and continued
    means(source, 4)
    assert slept == pytest.approx([0.1, 0.1, 0.0, 0.1, 0.1, 0.1])
    source.close()


@pytest.mark.parametrize("repeat", [False, True])
def test_a_film_goes_on_behind_pictures_that_are_broken(
    tmp_path: Path, slept: list[float], repeat: bool
) -> None:
    path, random = tmp_path / "film.mp4", np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for grey in range(20, 220, 5):
        picture = np.full((48, 64, 3), grey, np.uint8)
        picture[:, :8] = random.integers(0, 255, (48, 8, 3))  # noise fills the file
        writer.write(picture)
    writer.release()
    data = bytearray(path.read_bytes())
    first, last = int(0.4 * len(data)), int(0.5 * len(data))
    data[first:last] = bytes(last - first)
    path.write_bytes(data)
    source = camera(tmp_path, "film.mp4", repeat=repeat)
    source.open()
    greys = [float(one.mean()) for _ in range(30) if (one := source.read().picture) is not None]
    assert greys[-1] > 150
    if not repeat:
        with pytest.raises(CameraLost, match=r"film.mp4 has ended"):
            means(source, 40)
    source.close()


def test_a_film_may_begin_again(tmp_path: Path, slept: list[float]) -> None:
    film(tmp_path / "film.avi")
    source = camera(tmp_path, "film.avi", repeat=True)
    source.open()
    assert means(source, 6) == [*GREYS, *GREYS]
    source.close()


def test_a_larger_picture_of_the_same_shape_is_scaled_and_another_refused(
    tmp_path: Path, slept: list[float]
) -> None:
    film(tmp_path / "large.avi", 640, 480)
    source = camera(tmp_path, "large.avi")
    source.open()
    assert means(source, 3) == [*GREYS]
    source.close()
    film(tmp_path / "wide.avi", 640, 360)
    source = camera(tmp_path, "wide.avi")
    source.open()
    with pytest.raises(CameraLost, match=r"gives pictures of 640 x 360 pixels; .* says 64 x 48"):
        source.read()
    source.close()


@pytest.mark.parametrize(
    ("device", "error"),
    [
        ("/dev/video97", "/dev/video97 is not there"),
        ("/dev/v4l/by-id/usb-none", "/dev/v4l/by-id/usb-none is not there"),
        ("99", "99 (is not there|cannot be opened)"),
        (str(2**31), f"{2**31} (is not there|cannot be opened)"),
        ("x" * 300, "x cannot be opened: File name too long"),
        ("null\0", "null\0 is not there"),
        ("film.avi/0", "film.avi/0 cannot be opened: Not a directory"),
        ("no.mp4", "no.mp4 is not there"),
        ("garbage.avi", "garbage.avi cannot be opened"),
        ("http://127.0.0.1:9/x.mjpg", "cannot be opened"),
    ],
)
def test_what_cannot_be_opened_is_named(tmp_path: Path, device: str, error: str) -> None:
    (tmp_path / "garbage.avi").write_bytes(bytes(range(256)) * 20)
    film(tmp_path / "film.avi")
    source = camera(tmp_path, device)
    with pytest.raises(CameraLost, match=error):
        source.open()
    source.close()
    with pytest.raises(CameraLost, match="is not open"):
        source.read()


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_a_pipe_and_a_folder_are_no_cameras(tmp_path: Path, make: Callable[[str], None]) -> None:
    make(str(tmp_path / "pictures"))
    with pytest.raises(CameraLost, match="pictures is no camera and no file"):
        camera(tmp_path, "pictures").open()


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("rtsp://admin:secret@127.0.0.1:9/live?token=secret", "rtsp://127.0.0.1:9"),
        ("http://127.0.0.1:9?to=me@x.org&pw=secret", "http://…"),
        ("rtsp://admin:se/cret@127.0.0.1:9/live", "rtsp://…"),
        ("rtsp://127.0.0.1:99999/live", "rtsp://127.0.0.1:99999"),
        ("rtsp://" + 70 * "x" + "/live", "rtsp://" + 70 * "x"),
        ("nothing://127.0.0.1", "nothing://127.0.0.1"),
    ],
)
def test_a_stream_is_named_by_its_host_alone(tmp_path: Path, address: str, shown: str) -> None:
    source = camera(tmp_path, address)
    with pytest.raises(CameraLost) as caught:
        source.open()
    assert str(caught.value) == f"{shown} cannot be opened"


@pytest.mark.parametrize(
    ("device", "shown"),
    [("rtsp:/admin:se@cret@cam/live", "…@cam/live"), ("admin:secret@cam", "…@cam"), ("a@b", "a@b")],
)
def test_an_address_without_slashes_is_named_without_its_password(
    tmp_path: Path, device: str, shown: str
) -> None:
    with pytest.raises(CameraLost) as caught:
        camera(tmp_path, device).open()
    assert str(caught.value) == f"{shown} is not there"


@pytest.mark.parametrize("scheme", ["rtsp", "http", "https"])
def test_a_silent_stream_does_not_keep_other_cameras_from_opening(
    tmp_path: Path, scheme: str
) -> None:
    film(tmp_path / "film.avi")
    server = socket.create_server(("127.0.0.1", 0))
    address = f"{scheme}://127.0.0.1:{server.getsockname()[1]}"
    opening = Opening(camera(tmp_path, f"{address}/live"))
    connection, _ = server.accept()  # it never answers
    with closing(connection), closing(camera(tmp_path, "film.avi")) as other:
        server.close()
        other.open()
        assert waits_on(connection)
    opening.join()
    assert opening.error == f"{address} cannot be opened"


class Stream(BaseHTTPRequestHandler):
    """Serves an endless stream of one picture."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        part = b"--next\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg(120) + b"\r\n"
        with contextlib.suppress(OSError):
            while self.wfile.write(part):
                pass

    def log_message(self, *_: object) -> None: ...


def test_a_stream_of_a_server_with_one_client_at_a_time_is_read(tmp_path: Path) -> None:
    with HTTPServer(("127.0.0.1", 0), Stream) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with closing(camera(tmp_path, f"http://127.0.0.1:{server.server_port}/live")) as source:
            source.open()
            assert means(source, 2) == [120, 120]
        server.shutdown()


def test_a_stream_that_answers_nothing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opencv, "TIMEOUT_MS", 50)
    with socket.create_server(("127.0.0.1", 0)) as server:
        silent = camera(tmp_path, f"rtsp://127.0.0.1:{server.getsockname()[1]}/live")
        with pytest.raises(CameraLost, match=r"rtsp://127.0.0.1:\d+ does not answer"):
            silent.open()


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 1)])
def test_grey_pictures_get_three_channels(shape: tuple[int, ...]) -> None:
    assert fitted(np.full(shape, 9, np.uint8), 64, 48).shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((5000, 5000, 3), "uint8"),
        ((48, 64), "uint16"),
        ((0, 0, 3), "uint8"),
        ((48, 0), "uint8"),
        ((48, 64, 2), "uint8"),
        ((48, 64, 4), "uint8"),
    ],
)
def test_pictures_of_an_impossible_kind_are_refused(shape: tuple[int, ...], kind: str) -> None:
    with pytest.raises(CameraLost, match=f"gives pictures of .* of {kind}; expected 1 or 3"):
        fitted(np.zeros(shape, kind), 64, 48)


class FakeCapture:
    """A cv2.VideoCapture that keeps its arguments, and gives the scripted reads."""

    reads: ClassVar[list[bool]] = []
    opens: ClassVar[list[tuple[object, int]]] = []
    works = True

    def __init__(self, target: object, backend: int, _: object) -> None:
        self.opens.append((target, backend))

    def isOpened(self) -> bool:
        return self.works

    def set(self, *_: object) -> bool:
        return False

    def get(self, _: int) -> float:
        return 0.0

    def read(self) -> tuple[bool, np.ndarray | None]:
        ok = self.reads.pop(0)
        return ok, np.full((48, 64, 3), 40, np.uint8) if ok else None

    def release(self) -> None: ...


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeCapture]:
    fresh = type("FreshCapture", (FakeCapture,), {"reads": [], "opens": []})
    monkeypatch.setattr(cv2, "VideoCapture", fresh)
    return fresh


@pytest.mark.skipif(sys.platform != "linux", reason="V4L2 is a part of Linux")
@pytest.mark.parametrize("device", ["/dev/null", "by-id/usb-camera", "stream", "film.avi"])
def test_a_device_is_opened_by_v4l2_and_a_stream_by_ffmpeg(
    tmp_path: Path, fake: type[FakeCapture], monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    film(tmp_path / "film.avi")
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "usb-camera").symlink_to("/dev/null")
    monkeypatch.setattr(opencv, "_unanswered", lambda _: "")
    device = "rtsp://127.0.0.1:9/live" if device == "stream" else device
    camera(tmp_path, device).open()
    expected = {
        "/dev/null": ("/dev/null", cv2.CAP_V4L2),
        "by-id/usb-camera": (str(tmp_path / "by-id" / "usb-camera"), cv2.CAP_V4L2),
        "rtsp://127.0.0.1:9/live": ("rtsp://127.0.0.1:9/live", cv2.CAP_FFMPEG),
        "film.avi": (str(tmp_path / "film.avi"), cv2.CAP_ANY),
    }
    assert fake.opens == [expected[device]]


def test_a_device_that_another_camera_uses_is_named(
    tmp_path: Path, fake: type[FakeCapture]
) -> None:
    fake.works = False
    with pytest.raises(CameraLost, match="/dev/null cannot be opened; check that nothing else"):
        camera(tmp_path, "/dev/null").open()


def test_single_broken_pictures_of_a_device_are_skipped(
    tmp_path: Path, fake: type[FakeCapture]
) -> None:
    fake.reads += [True, False, True, False, False, True, False, False, False]
    source = camera(tmp_path, "/dev/null")
    source.open()
    assert means(source, 3) == [40] * 3
    with pytest.raises(CameraLost, match="/dev/null gives no picture"):
        source.read()
    assert fake.reads == []


def test_a_read_that_times_out_is_not_repeated(
    tmp_path: Path, fake: type[FakeCapture], monkeypatch: pytest.MonkeyPatch
) -> None:
    fake.reads += [False, True]
    monkeypatch.setattr(time, "monotonic", itertools.count(0.0, 3.0).__next__)
    source = camera(tmp_path, "/dev/null")
    source.open()
    with pytest.raises(CameraLost, match="gives no picture"):
        source.read()
    assert fake.reads == [True]


def jpeg(grey: int) -> bytes:
    picture = np.full((48, 64, 3), grey, np.uint8)
    return bytes(cv2.imencode(".jpg", picture)[1].tobytes())


def recording(
    path: Path,
    *,
    broken: Container[int] = (),
    broken_depth: Container[int] = (),
    exposures: int = 3,
) -> None:
    """Up to three exposures at 10 Hz of the camera `front`, and as many of another."""
    file = BagWriter(path, viewers=False, notes={})
    with closing(file):
        for number, grey in enumerate(GREYS[:exposures]):
            header = {"basis": 5 * number + 5, "stamp_ns": 10**18 + number * 10**8}
            about = {"frame_id": "front", "height": 48, "width": 64}
            data = b"no jpeg" if number in broken else jpeg(grey)
            planes = pack_depth(np.full((48, 64), grey, np.uint16))
            if number in broken_depth:
                planes = (planes[0][:-4], *planes[1:])
            messages: list[tuple[Topic, str, object]] = [
                (IMAGE, "front", Image(**about, **header, encoding="jpeg", data=data)),
                (IMAGE, "rear", Image(**about, **header, encoding="jpeg", data=jpeg(0))),
                (DEPTH, "front", DepthImage(**about, **header, planes=planes)),
            ]
            for topic, name, message in messages:
                payload = codec.encode(message)  # type: ignore[type-var]
                encoding = codec.encoding_of(topic.type)
                file.add(
                    ReceivedMessage(
                        header["stamp_ns"], topic.at(name), encoding, payload, header_of(payload)
                    )
                )
        file.finish()


def replayed(tmp_path: Path, **more: object) -> ReplayedCamera:
    options = ReplayOptions(source="replay", file="drive.mcap", **more)  # type: ignore[arg-type]
    return ReplayedCamera(options, RGBD, CameraSite(str(tmp_path)))


def test_a_recording_gives_picture_and_depth_of_one_exposure_together(
    tmp_path: Path, slept: list[float]
) -> None:
    recording(tmp_path / "drive.mcap")
    source = replayed(tmp_path, repeat=True)
    source.open()
    frames = [source.read() for _ in range(6)]  # it begins again
    depths = [int(one.depth.max()) for one in frames if one.depth is not None]
    assert depths == [*GREYS, *GREYS]
    greys = [float(one.picture.mean()) for one in frames if one.picture is not None]
    assert greys == pytest.approx([*GREYS, *GREYS], abs=3)
    assert all(0 <= pause <= 0.3 for pause in slept)
    source.close()


def test_a_recording_of_one_exposure_repeats_it_at_the_camera_s_rate(
    tmp_path: Path, slept: list[float]
) -> None:
    recording(tmp_path / "drive.mcap", exposures=1)
    source = replayed(tmp_path, repeat=True)
    source.open()
    assert means(source, 4) == [GREYS[0]] * 4
    assert slept == pytest.approx([0.1] * 3)


@pytest.mark.parametrize("broken", [0, 1])
def test_a_broken_picture_of_a_recording_is_skipped(
    tmp_path: Path, slept: list[float], broken: int
) -> None:
    recording(tmp_path / "drive.mcap", broken=[broken])
    source = replayed(tmp_path, repeat=True)
    source.open()
    whole = [grey for number, grey in enumerate(GREYS) if number != broken]
    assert means(source, 4) == [*whole, *whole]
    assert slept[0] == pytest.approx(0.1 if broken == 0 else 0.2, abs=0.05)
    source.close()


def test_a_picture_with_broken_depth_comes_without_it(
    tmp_path: Path, slept: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    recording(tmp_path / "drive.mcap", broken_depth=[0, 1])
    source = replayed(tmp_path)
    source.open()
    frames = [source.read() for _ in GREYS]
    assert [one.depth is None for one in frames] == [True, True, False]
    greys = [float(one.picture.mean()) for one in frames if one.picture is not None]
    assert greys == pytest.approx([*GREYS], abs=3)
    (begun,) = caplog.messages
    assert begun.startswith("camera front: depth in drive.mcap is broken and left out: a plane of ")


def test_a_thinned_recording_gives_whole_exposures_at_their_rate(
    tmp_path: Path, slept: list[float]
) -> None:
    """Recorded at 10 Hz from 20: every second exposure, depth with its picture."""
    config = RecorderConfig(pictures=10.0, keep_free_mb=0, flush_s=0.05)
    shades = range(10, 90, 10)
    with Recorder(tmp_path / "drive.mcap", config) as recorder:
        for number, shade in enumerate(shades):
            at = 1 + 2.5 * number  # [ticks] of 20 ms
            header = {"boot": 7, "basis": round(at), "stamp_ns": 10**18 + round(at * 2e7)}
            about = header | {"frame_id": "front", "width": 64, "height": 48}
            data = np.full((48, 64, 3), shade, np.uint8).tobytes()
            planes = pack_depth(np.full((48, 64), 100 * shade, np.uint16))
            for topic, message in (
                (DEPTH, DepthImage(**about, planes=planes)),  # type: ignore[arg-type]
                (IMAGE, Image(**about, encoding="bgr8", data=data)),  # type: ignore[arg-type]
            ):
                recorder.intake.receive(topic.at("front"), "", codec.encode(message))
    source = replayed(tmp_path)
    source.open()
    frames = [source.read() for _ in range(len(shades) // 2)]
    with pytest.raises(CameraLost, match=r"has ended"):
        source.read()
    assert [int(one.picture.max()) for one in frames if one.picture is not None] == [10, 30, 50, 70]
    assert [int(one.depth.max()) for one in frames if one.depth is not None] == [
        1000, 3000, 5000, 7000,
    ]  # fmt: skip
    assert slept == pytest.approx([0.1, 0.2, 0.3], abs=0.05)  # from the first


def test_a_recording_may_end(tmp_path: Path, slept: list[float]) -> None:
    recording(tmp_path / "drive.mcap")
    source = replayed(tmp_path)
    source.open()
    for _ in GREYS:
        source.read()
    with pytest.raises(CameraLost, match=r"drive\.mcap has ended"):
        source.read()
    source.close()
    with pytest.raises(CameraLost, match=r"drive\.mcap has ended"):
        source.open()  # as the process does after a loss


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (None, "cannot read"),
        (b"no recording at all", "not a recording"),
        ("other camera", "drive.mcap has none"),
        ("broken", "not a JPEG"),
    ],
)
def test_a_recording_that_cannot_be_shown_is_a_lost_camera(
    tmp_path: Path, slept: list[float], content: str | bytes | None, error: str
) -> None:
    path = tmp_path / "drive.mcap"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        recording(path, broken=range(3) if content == "broken" else ())
    source = replayed(tmp_path, camera="top" if content == "other camera" else "front")
    source.open()
    with pytest.raises(CameraLost, match=error):
        source.read()
    source.close()
