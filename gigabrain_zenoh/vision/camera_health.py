"""Checks of a camera's pictures, one exposure after the other. Pure.

A camera that shows nothing new or nothing at all counts as blind. A sensor has noise, so two
exposures never have the same bits. A surface that is nearer than the camera can measure takes all
depth as a hand does, but a robot comes near it slowly.
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
DARK = "covered, or in the dark"  # without depth the two look alike

WINDOW_S = 0.4  # that is looked at, or 2.5 periods of a slow camera
BAD_SHARE = 0.4  # of the exposures of a window, and two of them at least: a fault
REMEMBERED = 64  # exposures that a newer one may repeat
SUDDEN_S = 0.25  # in which a cover takes all depth, or 1.5 periods
SEEN, UNSEEN, SEEN_AGAIN = 0.4, 0.05, 0.1  # share of pixels with depth
BLACK, WHITE = 30, 250  # of 255
DARK_SHARE, BRIGHT_SHARE = 0.98, 0.6  # of pixels
FLAT, SMOOTH = 0.7, 4.0  # mean step between neighbouring blocks, of 255
STEP_PX, BLOCK = 4, 5  # every fourth pixel is looked at, in blocks of 5 x 5


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

    With `repeats` a still scene may give the same bits twice, as compressed streams do; then the
    same picture is no fault. A camera on an arm may see nothing but what the gripper holds, so only
    its silence is a fault.
    """

    def __init__(self, camera: Camera, *, repeats: bool = False) -> None:
        period_s = 1 / camera.rate_hz
        self._repeats, self._on_arm = repeats, bool(camera.link)
        self._window_s = max(WINDOW_S, 2.5 * period_s)
        self._sudden_s = max(SUDDEN_S, 1.5 * period_s)
        self._came_s: float | None = None  # the newest exposure, or the first question
        self._prints: deque[int] = deque(maxlen=REMEMBERED)
        self._judged: deque[tuple[float, str, int]] = deque()  # when, its fault, its fingerprint
        self._shares: deque[tuple[float, float]] = deque()  # when, share of pixels with depth
        self._covered = False
        self._named = ""

    def take(
        self,
        now_s: float,
        picture: NDArray[np.uint8] | None,
        depth: NDArray[np.uint16] | None = None,
    ) -> bool:
        """Take one exposure; return whether it may be used.

        `picture` is (height, width) or (height, width, 3), `depth` (height, width) [mm], 0 unknown.
        """
        mark = _fingerprint(picture, depth)
        repeated = not self._repeats and mark in self._prints
        self._prints.append(mark)
        self._came_s = now_s
        fault = ""
        if not self._on_arm:
            fault = FROZEN if repeated else self._fault(now_s, picture, depth)
        self._judged.append((now_s, fault, mark))
        return not fault

    def problem(self, now_s: float) -> str:
        """Return why the camera is blind now; empty if it can be believed."""
        if self._came_s is None:
            self._came_s = now_s
        if now_s - self._came_s >= self._window_s - 1e-6:
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
