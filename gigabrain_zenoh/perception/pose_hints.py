"""Hints about the robot's pose, from requests on `robot/pose_set` and from tags."""

import logging
import math
from collections.abc import Callable

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, Cause
from gigabrain_schemas.requests import PoseReply, PoseRequest
from gigabrain_schemas.topics import POSE_SET
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.geometry.se2 import between, compose
from gigabrain_zenoh.mapping.odometry import OdometrySample
from gigabrain_zenoh.mapping.pose_hint import PoseHint
from gigabrain_zenoh.perception import FIND_IT

log = logging.getLogger(__name__)

LOST_S = 10.0  # without localization, until `not_localized` is reported
LOST_TICKS = round(LOST_S * 1e9 / TICK_NS)
MAX_HINT_TICKS = round(2e9 / TICK_NS)  # age at which a hint expires
PERSON_M, PERSON_RAD = 0.3, 0.25  # standard deviations of a hint by a person
MIN_VARIANCE = 1e-6  # [m2], [rad2]
PERSON_REASON = "a person has set its pose"


class PoseHints:
    """The newest hint, moved along by odometry."""

    def __init__(
        self, bus: Bus, moment: Callable[[], OdometrySample | None], lose: Callable[[str], None]
    ) -> None:
        self._bus, self._moment, self._lose = bus, moment, lose
        self._hint: PoseHint | None = None
        self._sample: OdometrySample | None = None  # odometry at the time of the hint
        self._by_person = False
        self._lost: tuple[int, str] | None = None  # tick when localization was lost, and why
        bus.serve(POSE_SET, self._set)

    def clear(self) -> None:
        """Forget the hint, as the odometry restarts."""
        self._hint = self._lost = None

    def add(self, hint: PoseHint, sample: OdometrySample) -> None:
        """Use a tag's hint at `sample`, unless a person's hint is still valid."""
        if not (self._by_person and self.at(sample)):
            self._hint, self._sample, self._by_person = hint, sample, False

    def found(self) -> None:
        """Forget a person's hint, as the robot is localized. A tag's hint is kept.

        It shows at once where the robot is after it was carried away.
        """
        self._lost = None
        if self._by_person:
            self._hint, self._by_person = None, False

    def missed(self, tick: int, why: str) -> None:
        """Record that the scan of `tick` did not localize the robot, and why."""
        self._lost = self._lost[0] if self._lost else tick, why

    def problems(self) -> tuple[Cause, ...]:
        """Return the cause if the robot has not been localized for LOST_S."""
        moment = self._moment()
        if moment is None or self._lost is None or moment.tick - self._lost[0] < LOST_TICKS:
            return ()
        text = f"the robot has not been found in the map for {LOST_S:g} s: {self._lost[1]}"
        return (Cause(code="not_localized", text=text[:500], remedy=FIND_IT),)

    def at(self, moment: OdometrySample) -> PoseHint | None:
        """Return the hint moved to `moment`; None without a hint, or if it has expired."""
        hint, sample = self._hint, self._sample
        if hint is None or sample is None:
            return None
        if moment.tick - sample.tick > MAX_HINT_TICKS or moment.jumps != sample.jumps:
            self._hint = None
            return None
        pose = compose(hint.pose, between(sample.fused, moment.fused))
        return PoseHint(pose, hint.covariance)

    async def _set(self, request: PoseRequest) -> PoseReply:
        moment = self._moment()
        if moment is None:
            return PoseReply(ok=False, text="no map and no scan yet; try again in a moment")
        log_accepted(self._bus, POSE_SET.key, request, moment.tick)
        yaw = 0.0 if request.yaw is None else math.remainder(request.yaw, math.tau)
        covariance = _covariance(request)
        if covariance is None:
            return PoseReply(ok=False, text="invalid covariance: it has negative eigenvalues")
        self._lose(PERSON_REASON)
        self._hint = PoseHint(np.array((request.x, request.y, yaw)), covariance)
        self._sample, self._by_person = moment, True
        text = f"looking for the robot round ({request.x:.2f}, {request.y:.2f})"
        log.info("%s, by %s", text, request.source, extra={"data": {"event": "pose"}})
        return PoseReply(ok=True, text=text)


def _covariance(request: PoseRequest) -> Floats | None:
    """Return the covariance (3, 3) of a request; None if it has negative eigenvalues."""
    turn = math.pi / 2 if request.yaw is None else PERSON_RAD
    if not request.covariance:
        return np.diag((PERSON_M, PERSON_M, turn)) ** 2
    given = np.array(request.covariance).reshape(3, 3)
    covariance = (given + given.T) / 2
    if np.linalg.eigvalsh(covariance).min() < -MIN_VARIANCE:
        return None
    if request.yaw is None:
        covariance[2], covariance[:, 2] = 0.0, 0.0
        covariance[2, 2] = turn**2
    return np.asarray(covariance + MIN_VARIANCE * np.eye(3), np.float64)
