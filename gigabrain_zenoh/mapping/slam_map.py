"""A map that grows while the robot drives, and is redrawn after loop closures."""

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

DRAW_INTERVAL_SCANS = 5  # keyframes are drawn in addition
MAX_SWEEPS_PER_SCAN = 8  # to draw, of those that wait after the map was redrawn
LOOP_SCANS, KEYFRAME_SCANS, SWEEPS_PER_SCAN = 5, 2, 200  # deadline of background work
SHIFT_M, SHIFT_RAD = 0.02, 0.004  # the map is redrawn if a keyframe moved farther
RATES = DriftRates(away=0.008, turn=0.002)  # of scans every few centimetres, guided by odometry
HINT_INTERVAL_SCANS = 5  # between checks of hints
FITTING_KINDS = ("matched", "recovered")  # other scans are not drawn

SEARCHING = "looking for the robot in the map"
SAVE_AND_GO_ON = "save the map, and start perception with it (map: NAME)"
FULL = Cause(
    code="map_full",
    text=f"the map is full: {MAX_CELLS * CELL:g} m long; what lies beyond is left out",
    remedy="map a large site in parts",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSnapshot:
    """A copy of a map at one scan; another thread may convert it to arrays."""

    pose: Floats | None  # (3,), of the robot by odometry, if known
    lost: bool  # the robot was searched for
    slam: Slam
    sweeps: GridScans
    grid: LogOddsGrid
    drawn: list[Floats]  # poses of the keyframes in the grid
    waiting: list[GridScan]  # not yet drawn

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
        """Numbers that differ if the map differs."""
        return len(self.slam.keyframes), self.slam.revision, self.sweeps.seen


class SlamMap:
    """A map that SLAM makes; see RobotMap."""

    def __init__(self, patience_s: float = PATIENCE_S, in_time: InTime = done) -> None:
        self._background = ScheduledWorker(patience_s, in_time)
        self._slam, self._sweeps, self._grid = Slam(rates=RATES), GridScans(), LogOddsGrid()
        self._drawn: list[Floats] = []  # poses of the keyframes in the grid
        self._undrawn_sweeps: list[GridScan] = []
        self._scans_since_drawn = 0
        self._settling = False
        self._finder: BackgroundLocalizer | None = None
        self._kidnap_detector = KidnapDetector()
        self._motion = IDENTITY  # since the last scan that SLAM added
        self._kidnap_suspected = False  # since then as well
        self._just_resumed = False  # no scan since it was thawed
        self._last_place = Place(IDENTITY, NOWHERE, False, "no scan yet")
        self._loops = self._renewals = 0
        self._hint: PoseHint | None = None  # of the next scan
        self._scans_since_hint = HINT_INTERVAL_SCANS  # that was checked
        self._snapshot_wanted = False  # as soon as no background work runs
        self._snapshot: MapSnapshot | None = None

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

        The robot is at `last` (3,) if its odometry continued since. If it was `lost`, or the next
        scan does not fit there, the whole map is searched. Raises ConfigError for invalid arrays.
        """
        slam_map = cls(patience_s, in_time)
        try:
            slam_map._slam = Slam.thaw(arrays, rates=RATES)
            slam_map._sweeps = GridScans.thaw(arrays, slam_map._slam.poses)
            if "grid_odds" in arrays:
                slam_map._thaw_grid(arrays)
            else:
                slam_map._drawn = list(slam_map._slam.poses)
                slam_map._grid = _drawn_grid(slam_map._sweeps.all(), slam_map._drawn)
        except KeyError as error:
            raise ConfigError(f"no pose graph: it has no {error}") from None
        except (ValueError, IndexError, TypeError, RuntimeError) as error:  # RuntimeError: gtsam
            text = " ".join(str(error).split())[:200]
            raise ConfigError(f"no pose graph: {text}") from None
        if last is None or lost:
            slam_map.lose(SEARCHING)
            if slam_map._finder:
                slam_map._finder.last = last
        else:
            slam_map._motion, slam_map._just_resumed = between(slam_map._slam.pose, last), True
        return slam_map

    def _thaw_grid(self, arrays: Arrays) -> None:
        """Restore the grid; KeyError or ValueError if the arrays do not belong together."""
        odds, known = arrays["grid_odds"], arrays["grid_known"]
        if odds.ndim != 2 or odds.shape != known.shape or max(odds.shape) > MAX_CELLS:
            raise ValueError(f"a grid of shape {odds.shape}")
        x, y = shaped(arrays, "grid_origin", 2).tolist()
        self._grid = LogOddsGrid.of(odds, known.astype(np.bool_), (x, y))
        self._drawn = list(shaped(arrays, "drawn", len(self._slam.keyframes), 3))
        sweeps = self._sweeps.all()
        self._undrawn_sweeps = [sweeps[k] for k in arrays["undrawn"].astype(int)]

    def step(self, view: View, motion: Floats, noise: Floats) -> Place:
        """See RobotMap."""
        self._background.at_scan()
        if self._snapshot_wanted and self._background.idle:
            self._snapshot_wanted, self._snapshot = False, self._copy()
        self._draw_waiting()
        hint, self._hint = self._hint, None
        if hint and not self._finder:
            self._check_hint(view, hint, compose(self._motion, motion))
        if self._finder:
            if hint:
                self._finder.suggest(hint)
            self._last_place = self._search_robot(self._finder, view, motion, noise)
            return self._last_place
        self._motion = compose(self._motion, motion)
        resumed, self._just_resumed = self._just_resumed, False
        if self._contradicts_map(view):
            self._kidnap_suspected = True
            if resumed:
                self.lose(SEARCHING)
            return self._last_place
        estimate = self._slam.add(
            view.scan, self._motion, None if self._kidnap_suspected else noise
        )
        self._motion, self._kidnap_suspected = IDENTITY, False
        if estimate.lost:
            self.lose("the scans no longer match each other")
            return self._last_place
        self._draw_if_due(view, estimate)
        if self._slam.behind and self._background.idle and not self._settling:
            self._close_loops(self._slam.behind)
        self._last_place = Place(estimate.pose, estimate.covariance, True)
        return self._last_place

    def lose(self, why: str) -> None:
        """See RobotMap. The robot may still be at its pose by odometry."""
        if not self._slam.keyframes:
            return
        origin = (self._grid.origin_x, self._grid.origin_y)
        field = field_of(self._grid.percent(), CELL, origin)
        self._finder = BackgroundLocalizer(field, why, self._background, self._pose_by_odometry())
        self._last_place = Place(self._last_place.pose, NOWHERE, False, why)

    def suggest(self, hint: PoseHint) -> None:
        """See RobotMap."""
        self._hint = hint

    def _pose_by_odometry(self) -> Floats | None:
        """Return the robot's pose (3,) by odometry, if known."""
        if self._finder:
            return self._finder.last
        return compose(self._slam.pose, self._motion) if self._last_place.localized else None

    def keep(self) -> None:
        """Copy the map at the next scan without background work; see `kept`."""
        self._snapshot_wanted = True

    def kept(self) -> MapSnapshot | None:
        """Return the copy of the map before the last scan, once; None if none was made."""
        snapshot, self._snapshot = self._snapshot, None
        return snapshot

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
        """See RobotMap. Waits for background work."""
        self._settling = False
        if self._finder or not self._slam.keyframes:
            raise Refused(f"not saved: the robot is not localized ({self._last_place.why})")
        self._background.finish()
        return self._copy()

    def _copy(self) -> MapSnapshot:
        return MapSnapshot(
            pose=self._pose_by_odometry(),
            lost=self._finder is not None,
            slam=self._slam.still(),
            sweeps=self._sweeps.still(),
            grid=self._grid.still(),
            drawn=[*self._drawn, *self._slam.poses_from(len(self._drawn))],
            waiting=list(self._undrawn_sweeps),
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
            text = f"loops are no longer closed, as the optimiser fails: {self._slam.failure}"
            found.append(Cause(code="loops_open", text=text, remedy=SAVE_AND_GO_ON))
        return tuple(found)

    def close(self) -> None:
        """See RobotMap."""
        self._background.close()

    def _search_robot(
        self, finder: BackgroundLocalizer, view: View, motion: Floats, noise: Floats
    ) -> Place:
        place = finder.step(view, motion, noise)
        if place.localized:
            self._slam.relocate(place.pose)
            self._finder, self._kidnap_detector = None, KidnapDetector()
            self._motion, self._kidnap_suspected = IDENTITY, False
        return place

    def _check_hint(self, view: View, hint: PoseHint, moved: Floats) -> None:
        """Lose the robot if the scan fits better at the hint than at the robot's pose."""
        self._scans_since_hint += 1
        if not self._slam.keyframes or self._scans_since_hint < HINT_INTERVAL_SCANS:
            return
        pose = compose(self._slam.pose, moved)
        if not far_from(hint, pose):
            return
        self._scans_since_hint = 0
        field = field_of(self._grid.percent(), CELL, (self._grid.origin_x, self._grid.origin_y))
        if better(field, view.beams, hint, pose):
            self.lose(ELSEWHERE)

    def _contradicts_map(self, view: View) -> bool:
        """Return whether a scan contradicts the map; after some of them, lose the robot."""
        if not self._slam.keyframes:
            return False
        pose = compose(self._slam.pose, self._motion)
        if not self._kidnap_detector.look(self._grid, view, pose):
            return False
        if self._kidnap_detector.certain:
            self.lose("the scans do not fit the robot's place in the map")
        else:
            self._last_place = Place(pose, self._last_place.covariance, True)
        return True

    def _draw_if_due(self, view: View, estimate: Estimate) -> None:
        """Draw the scan if it is due and fits."""
        if len(self._drawn) < len(self._slam.keyframes):
            self._drawn += self._slam.poses_from(len(self._drawn))
        self._scans_since_drawn += 1
        if estimate.kind not in FITTING_KINDS or (
            self._scans_since_drawn < DRAW_INTERVAL_SCANS and not estimate.kept
        ):
            return
        self._scans_since_drawn = 0
        sweep = self._sweeps.add(view, estimate.keyframe, estimate.relative, estimate.pose)
        if self._undrawn_sweeps:
            self._undrawn_sweeps.append(sweep)
        else:
            sweep.draw(self._grid, self._drawn[sweep.keyframe])

    def _draw_waiting(self) -> None:
        for sweep in self._undrawn_sweeps[:MAX_SWEEPS_PER_SCAN]:
            sweep.draw(self._grid, self._drawn[sweep.keyframe])
        del self._undrawn_sweeps[:MAX_SWEEPS_PER_SCAN]

    def _close_loops(self, count: int) -> None:
        """Search for loops from `count` keyframes in the background, and redraw a corrected map."""
        slam, sweeps, drawn = self._slam, self._sweeps.all(), list(self._drawn)

        def work() -> Take:
            found = [slam.close_loops() for _ in range(count)]
            corrections = [one for one in found if one]
            grid = None
            if corrections and _has_shifted(np.array(drawn), corrections[-1].poses):
                poses = corrections[-1].poses
                corrected = [one for one in sweeps if one.keyframe < len(poses)]
                grid = _drawn_grid(corrected, poses)
            return lambda: self._apply_corrections(corrections, grid, sweeps)

        scans = LOOP_SCANS + KEYFRAME_SCANS * count + len(sweeps) // SWEEPS_PER_SCAN
        self._background.start(work, scans)

    def _apply_corrections(
        self, corrections: list[Correction], grid: LogOddsGrid | None, drawn: list[GridScan]
    ) -> None:
        for correction in corrections:
            self._slam.apply(correction)
            self._loops += len(correction.loops)
        if grid is not None:
            self._renewals += 1
            self._grid, self._drawn = grid, list(self._slam.poses)
            done = {id(one) for one in drawn if one.keyframe < len(corrections[-1].poses)}
            self._undrawn_sweeps = [one for one in self._sweeps.all() if id(one) not in done]
            if self._finder:
                self.lose(self._last_place.why)


def _drawn_grid(sweeps: Sequence[GridScan], poses: Sequence[Floats] | Floats) -> LogOddsGrid:
    grid = LogOddsGrid()
    for sweep in sweeps:
        sweep.draw(grid, poses[sweep.keyframe])
    return grid


def _has_shifted(before: Floats, after: Floats) -> bool:
    count = min(len(before), len(after))
    offsets = after[:count] - before[:count]
    moved = np.hypot(offsets[:, 0], offsets[:, 1]) > SHIFT_M
    return bool((moved | (np.abs(wrap(offsets[:, 2])) > SHIFT_RAD)).any())


def warm_up() -> None:
    """Compile the kernels that make a map, by calling each once."""
    warm_up_localizing()
    along = np.linspace(-3.0, 3.0, 60)
    walls = np.concatenate([np.c_[along, along * 0 + 3.0], np.c_[along * 0 + 3.0, along]])
    slam, scan = Slam(), Scan.of(walls)
    slam.add(scan, IDENTITY)
    slam.add(scan, IDENTITY)
    slam.add(Scan.of(walls / 2), IDENTITY)  # fits nowhere
