"""A map that grows while the robot drives, and is redrawn after a loop corrects it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Cause
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.geometry.se2 import IDENTITY, between, compose, wrap
from gigabrain_zenoh.host.threads import PATIENCE_S, InTime, ScheduledWorker, Take, done
from gigabrain_zenoh.mapping.keyframes import Scan, View, shaped
from gigabrain_zenoh.mapping.likelihood_field import field_of
from gigabrain_zenoh.mapping.localizer import (
    ELSEWHERE,
    NOWHERE,
    BackgroundLocalizer,
    KidnapDetector,
    Place,
)
from gigabrain_zenoh.mapping.map_file import Arrays
from gigabrain_zenoh.mapping.occupancy_grid import (
    CELL,
    MAX_CELLS,
    GridScan,
    GridScans,
    LogOddsGrid,
)
from gigabrain_zenoh.mapping.pose_graph import DriftRates
from gigabrain_zenoh.mapping.pose_hint import PoseHint, better, far_from
from gigabrain_zenoh.mapping.slam import Correction, Estimate, Slam
from gigabrain_zenoh.mapping.static_map import warm_up as warm_up_localizing

DRAWN_SCANS = 5  # every so many scans one is drawn, and every keyframe
DRAWN_AT_ONCE = 8  # sweeps, of those that wait after the map was redrawn
LOOP_SCANS, KEYFRAME_SCANS, SWEEPS_A_SCAN = 5, 2, 200  # how long the work beside may take
SHIFT_M, SHIFT_RAD = 0.02, 0.004  # keyframes that moved less need not be redrawn
RATES = DriftRates(away=0.008, turn=0.002)  # of scans every few centimetres, guided by odometry
LOOKED_SCANS = 5  # between two looks at where a hint says that the robot is
FITS = ("matched", "recovered")  # scans that were found otherwise are not drawn

LOOKING = "looking for the robot in the map"
SAVE_AND_GO_ON = "save the map, and start perception with it (map: NAME)"
FULL = Cause(
    code="map_full",
    text=f"the map is full: {MAX_CELLS * CELL:g} m long; what lies beyond is left out",
    remedy="map a large site in parts",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSnapshot:
    """A map as it was at one scan; it can be put into arrays in another thread."""

    pose: Floats | None  # (3,), of the robot at that scan, as far as odometry knows it
    lost: bool  # it was looked for
    slam: Slam
    sweeps: GridScans
    grid: LogOddsGrid
    drawn: list[Floats]  # poses of the keyframes, as they are in the grid
    waiting: list[GridScan]  # to be drawn

    def freeze(self) -> dict[str, NDArray[np.generic]]:
        """Return everything needed to continue exactly, as arrays."""
        grid, waiting = self.grid, {id(one) for one in self.waiting}
        undrawn = [k for k, one in enumerate(self.sweeps.all()) if id(one) in waiting]
        return {
            **self.slam.freeze(),
            **self.sweeps.freeze(),
            "drawn": np.array(self.drawn).reshape(-1, 3),
            "undrawn": np.array(undrawn, np.int32),
            "grid_odds": grid.log_odds,
            "grid_known": grid.known(),
            "grid_origin": np.array((grid.origin_x, grid.origin_y)),
        }

    def to_save(self) -> tuple[SavedMap, Arrays]:
        """Return the map for other programs, and the arrays needed to continue it."""
        grid = self.grid.still()
        for sweep in self.waiting:
            sweep.draw(grid, self.drawn[sweep.keyframe])
        saved = SavedMap(grid.percent(), CELL, grid.origin_x, grid.origin_y)
        return saved, {**self.slam.freeze(), **self.sweeps.freeze()}

    @property
    def changes(self) -> tuple[int, int, int]:
        """Differs from that of a copy in which something else is mapped."""
        return len(self.slam.keyframes), self.slam.revision, self.sweeps.seen


class SlamMap:
    """A map that SLAM makes; see RobotMap."""

    def __init__(self, patience_s: float = PATIENCE_S, in_time: InTime = done) -> None:
        self._background = ScheduledWorker(patience_s, in_time)
        self._slam, self._sweeps, self._grid = Slam(rates=RATES), GridScans(), LogOddsGrid()
        self._drawn: list[Floats] = []  # poses of keyframes, as they are in the grid
        self._waiting: list[GridScan] = []  # to be drawn
        self._undrawn = 0  # scans
        self._settling = False
        self._finder: BackgroundLocalizer | None = None
        self._doubt = KidnapDetector()
        self._moved = IDENTITY  # since the last scan that was taken
        self._doubted = False  # likewise
        self._resumed = False  # no scan has come since it was thawed
        self._last = Place(IDENTITY, NOWHERE, False, "no scan yet")
        self._loops = self._renewals = 0
        self._hint: PoseHint | None = None  # of the next scan
        self._unasked = LOOKED_SCANS  # scans since it has looked where a hint says it is
        self._wanted = False  # a copy, as soon as nothing is under way beside
        self._still: MapSnapshot | None = None

    @classmethod
    def thaw(
        cls,
        arrays: Arrays,
        patience_s: float = PATIENCE_S,
        in_time: InTime = done,
        last: Floats | None = None,
        *,
        lost: bool = False,
    ) -> "SlamMap":
        """Continue a saved map.

        The robot is at `last` (3,) if its odometry has continued since. If it was `lost`, or the
        next scan does not belong there, the whole map is searched. Raises ConfigError for invalid
        arrays.
        """
        grown = cls(patience_s, in_time)
        try:
            grown._slam = Slam.thaw(arrays, rates=RATES)
            grown._sweeps = GridScans.thaw(arrays, grown._slam.poses)
            if "grid_odds" in arrays:
                grown._thaw_grid(arrays)
            else:
                grown._drawn = list(grown._slam.poses)
                grown._grid = _rendered(grown._sweeps.all(), grown._drawn)
        except KeyError as error:
            raise ConfigError(f"no pose graph: it has no {error}") from None
        except (ValueError, IndexError, TypeError, RuntimeError) as error:  # the last is gtsam's
            text = " ".join(str(error).split())[:200]
            raise ConfigError(f"no pose graph: {text}") from None
        if last is None or lost:
            grown.lose(LOOKING)
            if grown._finder:
                grown._finder.last = last
        else:
            grown._moved, grown._resumed = between(grown._slam.pose, last), True
        return grown

    def _thaw_grid(self, arrays: Arrays) -> None:
        """Restore the grid; KeyError or ValueError if the arrays do not belong together."""
        odds, known = arrays["grid_odds"], arrays["grid_known"]
        if odds.ndim != 2 or odds.shape != known.shape or max(odds.shape) > MAX_CELLS:
            raise ValueError(f"a grid of shape {odds.shape}")
        x, y = shaped(arrays, "grid_origin", 2).tolist()
        self._grid = LogOddsGrid.of(odds, known.astype(np.bool_), (x, y))
        self._drawn = list(shaped(arrays, "drawn", len(self._slam.keyframes), 3))
        sweeps = self._sweeps.all()
        self._waiting = [sweeps[k] for k in arrays["undrawn"].astype(int)]

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """See RobotMap."""
        self._background.at_scan()
        if self._wanted and self._background.idle:
            self._wanted, self._still = False, self._copied()
        self._draw_waiting()
        hint, self._hint = self._hint, None
        if hint and not self._finder:
            self._look_elsewhere(view, hint, compose(self._moved, motion))
        if self._finder:
            if hint:
                self._finder.suggest(hint)
            self._last = self._find(self._finder, view, motion, noise)
            return self._last
        self._moved = compose(self._moved, motion)
        resumed, self._resumed = self._resumed, False
        if self._doubtful(view):
            self._doubted = True
            if resumed:
                self.lose(LOOKING)
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
        """See RobotMap. The robot may still be where odometry has it."""
        if not self._slam.keyframes:
            return
        origin = (self._grid.origin_x, self._grid.origin_y)
        field = field_of(self._grid.percent(), CELL, origin)
        self._finder = BackgroundLocalizer(field, why, self._background, self._here())
        self._last = Place(self._last.pose, NOWHERE, False, why)

    def suggest(self, hint: PoseHint) -> None:
        """See RobotMap."""
        self._hint = hint

    def _here(self) -> Floats | None:
        """Return the robot's pose as far as odometry knows it."""
        if self._finder:
            return self._finder.last
        return compose(self._slam.pose, self._moved) if self._last.localized else None

    def keep(self) -> None:
        """Copy the map at the next scan at which nothing is under way beside; see `kept`."""
        self._wanted = True

    def kept(self) -> MapSnapshot | None:
        """Return the copy of the map before the last scan, once; None if none was made."""
        still, self._still = self._still, None
        return still

    def grid(self) -> OccupancyGrid:
        """See RobotMap."""
        return self._grid.message()

    def keyframes(self) -> tuple[int, Floats]:
        """See RobotMap."""
        return self._renewals, np.array(self._drawn).reshape(-1, 3)

    def settle(self) -> bool:
        """See RobotMap."""
        self._settling = True
        return self._background.idle

    def to_save(self) -> tuple[SavedMap, Arrays]:
        """Return the present map to be saved. Raises Refused."""
        return self.still().to_save()

    def still(self) -> MapSnapshot:
        """See RobotMap. Waits for the work beside."""
        self._settling = False
        if self._finder or not self._slam.keyframes:
            raise Refused(f"not saved: where the robot is, is not known ({self._last.why})")
        self._background.finish()
        return self._copied()

    def _copied(self) -> MapSnapshot:
        return MapSnapshot(
            pose=self._here(),
            lost=self._finder is not None,
            slam=self._slam.still(),
            sweeps=self._sweeps.still(),
            grid=self._grid.still(),
            drawn=[*self._drawn, *self._slam.poses_from(len(self._drawn))],
            waiting=list(self._waiting),
        )

    def report(self) -> dict[str, int]:
        """See RobotMap."""
        return {
            "keyframes": len(self._slam.keyframes),
            "sweeps": len(self._sweeps),
            "loops": self._loops,
            "drawn_anew": self._renewals,
            "late": self._background.late,
            "optimiser_rebuilt": self._slam.rebuilt,
        }

    def problems(self) -> tuple[Cause, ...]:
        """See RobotMap."""
        found = [FULL] if self._grid.full else []
        if self._slam.failure:
            text = f"loops are closed no more, the optimiser fails: {self._slam.failure}"
            found.append(Cause(code="loops_open", text=text, remedy=SAVE_AND_GO_ON))
        return tuple(found)

    def close(self) -> None:
        """See RobotMap."""
        self._background.close()

    def _find(
        self, finder: BackgroundLocalizer, view: View, motion: Floats, noise: Floats
    ) -> Place:
        place = finder.step(view, motion, noise)
        if place.localized:
            self._slam.relocate(place.pose)
            self._finder, self._doubt = None, KidnapDetector()
            self._moved, self._doubted = IDENTITY, False
        return place

    def _look_elsewhere(self, view: View, hint: PoseHint, moved: Floats) -> None:
        """Lose the robot if the scan fits where a hint says, and better than where it is."""
        self._unasked += 1
        if not self._slam.keyframes or self._unasked < LOOKED_SCANS:
            return
        here = compose(self._slam.pose, moved)
        if not far_from(hint, here):
            return
        self._unasked = 0
        field = field_of(self._grid.percent(), CELL, (self._grid.origin_x, self._grid.origin_y))
        if better(field, view.beams, hint, here):
            self.lose(ELSEWHERE)

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
        """Draw the scan if it is due and fits."""
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

    def _draw_waiting(self) -> None:
        for sweep in self._waiting[:DRAWN_AT_ONCE]:
            sweep.draw(self._grid, self._drawn[sweep.keyframe])
        del self._waiting[:DRAWN_AT_ONCE]

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
        self, corrections: list[Correction], grid: LogOddsGrid | None, drawn: list[GridScan]
    ) -> None:
        for correction in corrections:
            self._slam.apply(correction)
            self._loops += len(correction.loops)
        if grid is not None:
            self._renewals += 1
            self._grid, self._drawn = grid, list(self._slam.poses)
            done = {id(one) for one in drawn if one.keyframe < len(corrections[-1].poses)}
            self._waiting = [one for one in self._sweeps.all() if id(one) not in done]
            if self._finder:
                self.lose(self._last.why)


def _rendered(sweeps: Sequence[GridScan], poses: Sequence[Floats] | Floats) -> LogOddsGrid:
    grid = LogOddsGrid()
    for sweep in sweeps:
        sweep.draw(grid, poses[sweep.keyframe])
    return grid


def _shifted(before: Floats, after: Floats) -> bool:
    count = min(len(before), len(after))
    off = after[:count] - before[:count]
    far = np.hypot(off[:, 0], off[:, 1]) > SHIFT_M
    return bool((far | (np.abs(wrap(off[:, 2])) > SHIFT_RAD)).any())


def warm_up() -> None:
    """Call every kernel of making a map once."""
    warm_up_localizing()
    along = np.linspace(-3.0, 3.0, 60)
    walls = np.concatenate([np.c_[along, along * 0 + 3.0], np.c_[along * 0 + 3.0, along]])
    slam, scan = Slam(), Scan.of(walls)
    slam.add(scan, IDENTITY)
    slam.add(scan, IDENTITY)
    slam.add(Scan.of(walls / 2), IDENTITY)  # fits nowhere
