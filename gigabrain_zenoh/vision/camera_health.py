"""Checks a camera's pictures, exposure by exposure. Pure.

A camera whose pictures repeat or show nothing counts as blind. A sensor has noise, so two exposures
never have the same bits. A surface nearer than the camera can measure hides all depth like a hand,
but the robot approaches it slowly.
"""

import zlib
from collections import Counter, deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.body import Camera

FROZEN, REPEATS = "frozen", "repeats pictures"
COVERED, SILENT = "covered", "no picture"
UNDEREXPOSED, OVEREXPOSED = "underexposed", "overexposed"
DARK = "covered, or in the dark"  # not distinguishable without depth

WINDOW_S = 0.4  # of exposures that are judged; 2.5 periods for a slow camera
BAD_SHARE = 0.4  # of a window's exposures, and at least two, for a fault
MAX_FINGERPRINTS = 64  # of earlier exposures, to detect repetition
SUDDEN_S = 0.25  # a cover removes all depth within this time, or 1.5 periods
SEEN, UNSEEN, SEEN_AGAIN = 0.4, 0.05, 0.1  # share of pixels with depth
BLACK, WHITE = 30, 250  # of 255
DARK_SHARE, BRIGHT_SHARE = 0.98, 0.6  # of pixels
FLAT, SMOOTH = 0.7, 4.0  # mean step between neighbouring blocks, of 255
STEP_PX, BLOCK = 4, 5  # samples every fourth pixel, in blocks of 5 x 5


class PictureFigures(NamedTuple):
    """Figures of a picture as a whole."""

    dark: float  # share of pixels
    bright: float  # share of pixels
    detail: float  # mean step between neighbouring blocks, of 255


def figures_of(picture: NDArray[np.uint8]) -> PictureFigures:
    """Return the figures of a picture, (height, width) or (height, width, 3)."""
    few = picture[::STEP_PX, ::STEP_PX]
    least = few.min(axis=2) if few.ndim == 3 else few
    grey = few.mean(axis=2, dtype=np.float32) if few.ndim == 3 else few.astype(np.float32)
    rows, columns = (max(side // BLOCK, 1) for side in grey.shape)
    height, width = min(BLOCK, grey.shape[0]), min(BLOCK, grey.shape[1])
    blocks = grey[: rows * height, : columns * width].reshape(rows, height, columns, width)
    means = blocks.mean(axis=(1, 3))
    steps = [np.abs(np.diff(means, axis=axis)).ravel() for axis in (0, 1)]
    detail = np.concatenate(steps)
    return PictureFigures(
        dark=float((grey < BLACK).mean()),
        bright=float((least >= WHITE).mean()),
        detail=float(detail.mean()) if detail.size else 0.0,
    )


class CameraHealth:
    """Judges one camera. Times are of any clock [s], the same in all calls.

    With `repeats`, equal pictures are no fault: a compressed stream of a still scene may repeat
    them. A camera on an arm may see only the held thing, so only its silence is a fault.
    """

    def __init__(self, camera: Camera, *, repeats: bool = False) -> None:
        period_s = 1 / camera.rate_hz
        self._repeats, self._on_arm = repeats, bool(camera.link)
        self._window_s = max(WINDOW_S, 2.5 * period_s)
        self._sudden_s = max(SUDDEN_S, 1.5 * period_s)
        self._newest_s: float | None = None  # newest exposure, or first call of `problem`
        self._prints: deque[int] = deque(maxlen=MAX_FINGERPRINTS)
        self._judged: deque[tuple[float, str, int]] = deque()  # time, fault, fingerprint
        self._shares: deque[tuple[float, float]] = deque()  # time, share of pixels with depth
        self._covered = False
        self._named = ""

    def take(
        self,
        now_s: float,
        picture: NDArray[np.uint8] | None,
        depth: NDArray[np.uint16] | None = None,
    ) -> bool:
        """Judge one exposure; return whether it is usable.

        `picture` is (height, width) or (height, width, 3), `depth` (height, width) [mm], 0 unknown.
        """
        mark = _fingerprint(picture, depth)
        repeated = not self._repeats and mark in self._prints
        self._prints.append(mark)
        self._newest_s = now_s
        fault = ""
        if not self._on_arm:
            fault = FROZEN if repeated else self._fault(now_s, picture, depth)
        self._judged.append((now_s, fault, mark))
        return not fault

    def problem(self, now_s: float) -> str:
        """Return why the camera is blind now; empty if it is healthy."""
        if self._newest_s is None:
            self._newest_s = now_s
        if now_s - self._newest_s >= self._window_s - 1e-6:
            return SILENT
        while self._judged and now_s - self._judged[0][0] > self._window_s + 1e-6:
            self._judged.popleft()
        faults = [(fault, mark) for _, fault, mark in self._judged if fault]
        if not faults:
            self._named = ""
        elif len(faults) >= max(2.0, BAD_SHARE * len(self._judged)):
            self._named = Counter(fault for fault, _ in faults).most_common(1)[0][0]
            if self._named == FROZEN and len({mark for _, mark in faults}) > 1:
                self._named = REPEATS
        return self._named

    def _fault(
        self,
        now_s: float,
        picture: NDArray[np.uint8] | None,
        depth: NDArray[np.uint16] | None,
    ) -> str:
        """Return the fault of one exposure; empty for none."""
        look = None if picture is None else figures_of(picture)
        share = None if depth is None else float(np.count_nonzero(depth)) / depth.size
        if share is not None and self._covers(now_s, share, look):
            return COVERED
        if look is None:
            return ""
        if look.bright > BRIGHT_SHARE:
            return OVEREXPOSED
        if look.dark > DARK_SHARE:
            return DARK if share is None else UNDEREXPOSED
        return COVERED if share is None and look.detail < FLAT else ""

    def _covers(self, now_s: float, share: float, look: PictureFigures | None) -> bool:
        """Return whether something covers a camera with depth."""
        while self._shares and now_s - self._shares[0][0] > self._sudden_s + 1e-6:
            self._shares.popleft()
        before = max((one for _, one in self._shares), default=0.0)
        self._shares.append((now_s, share))
        if share >= SEEN_AGAIN:
            self._covered = False
        elif share < UNSEEN:
            smooth = look is None or look.detail < SMOOTH
            dark = look is not None and look.dark > DARK_SHARE
            self._covered |= dark or (smooth and before > SEEN)
        return self._covered


def _fingerprint(picture: NDArray[np.uint8] | None, depth: NDArray[np.uint16] | None) -> int:
    mark = 0
    for pixels in (picture, depth):
        if pixels is not None:
            mark = zlib.crc32(pixels[::STEP_PX].tobytes(), mark)
    return mark
