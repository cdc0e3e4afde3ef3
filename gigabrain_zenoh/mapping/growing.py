"""A map that grows while the robot drives, and is drawn anew when a loop has corrected it."""

from collections.abc import Sequence

import numpy as np

from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.journal import done
from gigabrain_zenoh.mapping.background import PATIENCE_S, Background, InTime, Take
from gigabrain_zenoh.mapping.doubt import Doubt
from gigabrain_zenoh.mapping.drift import Rates
from gigabrain_zenoh.mapping.field import field_of
from gigabrain_zenoh.mapping.finder import Finder
from gigabrain_zenoh.mapping.grid import CELL, Grid
from gigabrain_zenoh.mapping.localizer import NOWHERE, Place, View
from gigabrain_zenoh.mapping.map_file import Arrays, SavedMap
from gigabrain_zenoh.mapping.se2 import IDENTITY, Floats, compose, wrap
from gigabrain_zenoh.mapping.slam import Correction, Estimate, Slam
from gigabrain_zenoh.mapping.sweeps import Sweep, Sweeps

DRAWN_SCANS = 5  # every so many scans one is drawn, and every keyframe
DRAWN_AT_ONCE = 8  # sweeps, of those that wait after the map was drawn anew
LOOP_SCANS, KEYFRAME_SCANS, SWEEPS_A_SCAN = 5, 2, 200  # how long the work beside may take
SHIFT_M, SHIFT_RAD = 0.02, 0.004  # keyframes that moved less need not be drawn anew
RATES = Rates(away=0.008, turn=0.002)  # of scans every few centimetres, guided by odometry
FITS = ("matched", "recovered")  # scans that were found otherwise are not drawn


class GrowingMap:
    """See Chart in known.py."""

    def __init__(self, patience_s: float = PATIENCE_S, in_time: InTime = done) -> None:
        self._background = Background(patience_s, in_time)
        self._slam, self._sweeps, self._grid = Slam(rates=RATES), Sweeps(), Grid()
        self._drawn: list[Floats] = []  # poses of keyframes, as they are in the grid
        self._waiting: list[Sweep] = []  # to be drawn
        self._undrawn = 0  # scans
        self._settling = False
        self._finder: Finder | None = None
        self._doubt = Doubt()
        self._moved = IDENTITY  # since the last scan that was taken
        self._doubted = False  # likewise
        self._last = Place(IDENTITY, NOWHERE, False, "no scan yet")
        self._loops = self._renewals = 0

    @classmethod
    def thaw(
        cls, arrays: Arrays, patience_s: float = PATIENCE_S, in_time: InTime = done
    ) -> "GrowingMap":
        """A saved map, to go on with. Raises ConfigError for arrays that are none."""
        grown = cls(patience_s, in_time)
        try:
            grown._slam = Slam.thaw(arrays, rates=RATES)
            grown._sweeps = Sweeps.thaw(arrays, len(grown._slam.keyframes))
        except KeyError as error:
            raise ConfigError(f"no pose graph: it has no {error}") from None
        except (ValueError, IndexError, TypeError, RuntimeError) as error:  # the last is gtsam's
            text = " ".join(str(error).split())[:200]
            raise ConfigError(f"no pose graph: {text}") from None
        grown._drawn = list(grown._slam.poses)
        grown._grid = _rendered(grown._sweeps.all(), grown._drawn)
        grown.lose("looking for the robot in the map")
        return grown

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """See Chart."""
        self._background.at_scan()
        self._draw_waiting()
        if self._finder:
            self._last = self._find(self._finder, view, motion, noise)
            return self._last
        self._moved = compose(self._moved, motion)
        if self._doubtful(view):
            self._doubted = True
            return self._last
        estimate = self._slam.add(view.scan, self._moved, None if self._doubted else noise)
        self._moved, self._doubted = IDENTITY, False
        if estimate.lost:
            self.lose("scans do not fit together any more")
            return self._last
        self._take(view, estimate)
        if self._slam.behind and self._background.idle and not self._settling:
            self._close_loops(self._slam.behind)
        self._last = Place(estimate.pose, estimate.covariance, True)
        return self._last

    def lose(self, why: str) -> None:
        """See Chart."""
        if not self._slam.keyframes:
            return
        origin = (self._grid.origin_x, self._grid.origin_y)
        field = field_of(self._grid.percent(), CELL, origin)
        if self._finder:
            last = self._finder.last
        else:
            last = compose(self._slam.pose, self._moved) if self._last.localized else None
        self._finder = Finder(field, why, self._background, last)
        self._last = Place(self._last.pose, NOWHERE, False, why)

    def grid(self) -> OccupancyGrid:
        """See Chart."""
        return self._grid.message()

    def settle(self) -> bool:
        """See Chart."""
        self._settling = True
        return self._background.idle

    def to_save(self) -> tuple[SavedMap, Arrays]:
        """See Chart. Waits for the work beside."""
        self._settling = False
        if self._finder or not self._slam.keyframes:
            raise Refused(f"not saved: where the robot is, is not known ({self._last.why})")
        self._background.finish()
        self._draw_waiting(all_of_them=True)
        saved = SavedMap(self._grid.percent(), CELL, self._grid.origin_x, self._grid.origin_y)
        return saved, {**self._slam.freeze(), **self._sweeps.freeze()}

    def report(self) -> dict[str, int]:
        """See Chart."""
        return {
            "keyframes": len(self._slam.keyframes),
            "loops": self._loops,
            "drawn_anew": self._renewals,
            "late": self._background.late,
        }

    def close(self) -> None:
        """See Chart."""
        self._background.close()

    def _find(self, finder: Finder, view: View, motion: Floats, noise: Floats) -> Place:
        place = finder.step(view, motion, noise)
        if place.localized:
            self._slam.relocate(place.pose)
            self._finder, self._doubt = None, Doubt()
            self._moved, self._doubted = IDENTITY, False
        return place

    def _doubtful(self, view: View) -> bool:
        """Leave out a scan that does not belong here; after some of them, the robot is lost."""
        if not self._slam.keyframes:
            return False
        pose = compose(self._slam.pose, self._moved)
        if not self._doubt.look(self._grid, view, pose):
            return False
        if self._doubt.certain:
            self.lose("what is seen is not where the robot was thought to be")
        else:
            self._last = Place(pose, self._last.covariance, True)
        return True

    def _take(self, view: View, estimate: Estimate) -> None:
        """Draw the scan, if it is time to and it fits."""
        if len(self._drawn) < len(self._slam.keyframes):
            self._drawn += self._slam.poses_from(len(self._drawn))
        self._undrawn += 1
        if estimate.kind not in FITS or (self._undrawn < DRAWN_SCANS and not estimate.kept):
            return
        self._undrawn = 0
        sweep = self._sweeps.add(view, estimate.keyframe, estimate.relative, estimate.pose)
        if self._waiting:
            self._waiting.append(sweep)
        else:
            sweep.draw(self._grid, self._drawn[sweep.keyframe])

    def _draw_waiting(self, *, all_of_them: bool = False) -> None:
        count = len(self._waiting) if all_of_them else DRAWN_AT_ONCE
        for sweep in self._waiting[:count]:
            sweep.draw(self._grid, self._drawn[sweep.keyframe])
        del self._waiting[:count]

    def _close_loops(self, count: int) -> None:
        """Beside the scans: look for loops from so many keyframes, and draw what they correct."""
        slam, sweeps, drawn = self._slam, self._sweeps.all(), list(self._drawn)

        def work() -> Take:
            found = [slam.close_loops() for _ in range(count)]
            corrections = [one for one in found if one]
            grid = None
            if corrections and _shifted(np.array(drawn), corrections[-1].poses):
                poses = corrections[-1].poses
                there = [one for one in sweeps if one.keyframe < len(poses)]
                grid = _rendered(there, poses)
            return lambda: self._correct(corrections, grid, sweeps)

        scans = LOOP_SCANS + KEYFRAME_SCANS * count + len(sweeps) // SWEEPS_A_SCAN
        self._background.start(work, scans)

    def _correct(
        self, corrections: list[Correction], grid: Grid | None, drawn: list[Sweep]
    ) -> None:
        for correction in corrections:
            self._slam.apply(correction)
            self._loops += len(correction.loops)
        if grid is None:
            return
        self._renewals += 1
        self._grid, self._drawn = grid, list(self._slam.poses)
        done = {id(one) for one in drawn if one.keyframe < len(corrections[-1].poses)}
        self._waiting = [one for one in self._sweeps.all() if id(one) not in done]
        if self._finder:
            self.lose(self._last.why)


def _rendered(sweeps: Sequence[Sweep], poses: Sequence[Floats] | Floats) -> Grid:
    grid = Grid()
    for sweep in sweeps:
        sweep.draw(grid, poses[sweep.keyframe])
    return grid


def _shifted(before: Floats, after: Floats) -> bool:
    count = min(len(before), len(after))
    off = after[:count] - before[:count]
    far = np.hypot(off[:, 0], off[:, 1]) > SHIFT_M
    return bool((far | (np.abs(wrap(off[:, 2])) > SHIFT_RAD)).any())
