"""Sets of rendered pictures with their labels, one file per studio."""

import multiprocessing
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.qa.train.looks import Random

PER_STUDIO = 16
QUALITY = (80, 97)  # of JPEG


@dataclass(frozen=True)
class Labelled:
    """A picture as JPEG, and the things in it.

    boxes: float32 (n, 4), left, top, right, bottom [px]; labels: int64 (n,);
    fractions: float32 (n,), visible shares; ignored: bool (n,), true if too little is visible.
    """

    jpeg: bytes
    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    fractions: NDArray[np.float32]
    ignored: NDArray[np.bool_]

    def picture(self) -> NDArray[np.uint8]:
        """Decode the picture, RGB."""
        decoded = cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), cv2.IMREAD_COLOR)
        if decoded is None:
            raise ValueError("a set's picture is no JPEG")
        return np.asarray(decoded[..., ::-1], np.uint8)


def degrade(rng: Random, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Add the errors of a camera: exposure, colour cast, blur, and noise."""
    levels = np.linspace(0, 1, 256)[:, None] ** rng.uniform(0.8, 1.25)
    levels = 255 * levels * rng.uniform(0.85, 1.2) * rng.uniform(0.94, 1.06, 3)
    out = cv2.LUT(picture, np.clip(levels, 0, 255).astype(np.uint8)[:, None])
    if rng.random() < 0.5:
        out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.3, 0.7))
    if rng.random() < 0.1:
        out = cv2.blur(out, (int(rng.integers(3, 6)), 1))  # the robot turns
    noise = np.empty(out.shape, np.int16)
    cv2.setRNGSeed(int(rng.integers(2**31)))
    cv2.randn(noise, np.zeros(3), np.full(3, rng.uniform(0.0, 6.0)))
    return np.asarray(cv2.add(out, noise, dtype=cv2.CV_8U), np.uint8)


def render_studio(split: str, number: int, folder: Path, count: int = PER_STUDIO) -> Path:
    """Render the pictures of one studio to a file, unless it exists."""
    from gigabrain_zenoh.qa.train.scene import SPLITS, StudioScene, Truth
    from gigabrain_zenoh.qa.train.studio import Studio

    path = folder / f"{split}-{number:05d}.npz"
    if path.exists():
        return path
    rng = np.random.default_rng([zlib.crc32(split.encode()), number])
    studio = Studio(rng, SPLITS[split].families, SPLITS[split].wide)
    jpegs: list[bytes] = []
    truths: list[list[Truth]] = []
    for _ in range(count):
        scene = StudioScene(studio, SPLITS[split], rng)
        scene.draw()
        picture, truth = scene.render()
        if split != "train":  # in training, noise is new each time
            picture = degrade(rng, picture)
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*QUALITY))]
        jpegs.append(cv2.imencode(".jpg", picture[..., ::-1], quality)[1].tobytes())
        truths.append(truth)
    studio.close()
    flat = [one for truth in truths for one in truth]
    part = path.with_suffix(".part.npz")
    np.savez(
        part,
        jpegs=np.frombuffer(b"".join(jpegs), np.uint8),
        sizes=[len(jpeg) for jpeg in jpegs],
        counts=[len(truth) for truth in truths],
        boxes=np.array([one.box for one in flat], np.float32).reshape(-1, 4),
        labels=np.array([one.label for one in flat], np.int64),
        fractions=np.array([one.fraction for one in flat], np.float32),
        ignored=np.array([one.ignored for one in flat], bool),
    )
    part.replace(path)
    return path


def render(split: str, count: int, folder: Path, processes: int = 2, first: int = 0) -> list[Path]:
    """Render at least `count` pictures; existing files are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = range(first, first + -(-count // PER_STUDIO))
    jobs = [(split, number, folder) for number in numbers]
    if processes == 1:
        return [render_studio(*job) for job in jobs]
    with multiprocessing.get_context("spawn").Pool(processes, maxtasksperchild=20) as pool:
        return pool.starmap(render_studio, jobs, chunksize=1)


def read(paths: Sequence[Path]) -> Iterator[Labelled]:
    """Yield the pictures of some files."""
    for path in paths:
        with np.load(path) as file:
            part = {name: file[name] for name in file.files}
        jpegs, ends = part["jpegs"].tobytes(), np.cumsum(part["sizes"])
        lasts = np.cumsum(part["counts"])
        for size, end, count, last in zip(part["sizes"], ends, part["counts"], lasts, strict=True):
            own = slice(last - count, last)
            names = ("boxes", "labels", "fractions", "ignored")
            yield Labelled(jpegs[end - size : end], *(part[name][own] for name in names))
