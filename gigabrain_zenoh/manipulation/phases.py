"""Phases of a plan, and their execution: targets for the joints in each tick."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.brain import LONGEST_WINDOW_S, JointTarget
from gigabrain_schemas.brain import JointTrajectory as JointWindow
from gigabrain_zenoh.manipulation.joint_trajectory import JointTrajectory

PhaseName = Literal[
    "hover", "descend", "close", "squeeze", "lift", "traverse", "lower", "open", "retreat",
    "move", "grip", "press", "hold",
]  # fmt: skip
GRIP_TICKS = 40  # until a gripper has closed, or is stopped by an object
LATE_TICKS = 250  # longest extension, if safety slows the gripper down
SETTLE_TICKS = 12  # at rest after a trajectory
AHEAD_TICKS = 1  # from a state to the joints' first motion by a command that is based on it
LAG_TICKS = 1  # from that motion until a state shows it, if a process is late
MIN_MOVE = 1e-6  # [rad] or [m] per tick; a joint that moves less is at rest
WINDOW_TICKS = 100  # length of the trajectory in an intent
assert WINDOW_TICKS * TICK_S <= LONGEST_WINDOW_S


@dataclass(frozen=True, kw_only=True, eq=False)
class Phase:
    """A part of a plan: the arm moves, or the gripper does."""

    name: PhaseName
    arm: JointTrajectory | None = None
    gripper: float | None = None  # [rad] or [m], target of its joint

    @functools.cached_property
    def ticks(self) -> int:
        """The duration [ticks]."""
        if self.arm is None:
            return GRIP_TICKS
        return math.ceil(self.arm.duration / TICK_S) + 1 + SETTLE_TICKS

    def at(self, ticks: NDArray[np.int64]) -> Floats:
        """Return the postures (k, n) of the arm at `ticks` (k,) after the start."""
        return self._postures[np.clip(ticks, 0, len(self._postures) - 1)]

    @functools.cached_property
    def _postures(self) -> Floats:
        assert self.arm
        times = np.arange(self.ticks) * TICK_S
        columns = [np.interp(times, self.arm.times, column) for column in self.arm.positions.T]
        return np.stack(columns, axis=1)


class PhaseRun:
    """Executes phases one after the other, timed by the robot's ticks."""

    def __init__(self, phases: Sequence[Phase], gripper: str, tick: int) -> None:
        """Begin at `tick`; `gripper` names its joint."""
        self._phases, self._gripper = tuple(phases), gripper
        self._begun, self._at = tick, 0
        self._paced, self.waited = tick, 0  # `waited`: ticks without progress in the present phase
        self._total = sum(phase.ticks for phase in phases)

    @property
    def phase(self) -> Phase | None:
        """The present phase; None after the last one."""
        return self._phases[self._at] if self._at < len(self._phases) else None

    def advance(self, tick: int, *, grips: bool = False) -> Phase | None:
        """If a phase ends at `tick`, begin the next one and return the ended one; else None.

        While the gripper still moves (`grips`), as on a busy machine, its phase lasts longer.
        """
        phase = self.phase
        if phase is None:
            return None
        late = tick - self._begun - phase.ticks
        if late < 0 or (grips and phase.arm is None and late < LATE_TICKS):
            return None
        self._begun, self._at = tick, self._at + 1
        self.waited = 0
        return phase

    def wait(self, tick: int, sent: Mapping[str, float], spare: Mapping[str, float]) -> str:
        """Stretch time while the sent positions are behind the planned ones.

        So a trajectory waits for a gate that slows joints down, and all joints stay on it. Only
        sent positions count, not how well the joints follow them.

        Args:
            tick: Tick of the state.
            sent: Newest goals of the joints [rad] or [m].
            spare: Lag that control corrects itself [rad] or [m], by joint.

        Returns:
            The joint that it waits for, or an empty text.
        """
        phase, before, self._paced = self.phase, self._paced - self._begun, tick
        if phase is None or phase.arm is None:
            return ""
        names, late = phase.arm.names, AHEAD_TICKS + LAG_TICKS
        rows = phase.at(np.arange(before, tick - self._begun + 1) - late)
        ways = np.diff(rows, axis=0)
        off = np.sign(ways) * (rows[1:] - [sent[name] for name in names])
        behind = (off > [spare[name] for name in names]) & (np.abs(ways) > MIN_MOVE)
        (held,) = np.nonzero(behind.any(axis=1))
        if not len(held):
            self.waited = 0
            return ""
        gone = int(held[0])
        ticks = len(ways) - gone
        self._begun += ticks
        self.waited = ticks + (0 if gone else self.waited)
        return names[int(np.argmax(behind[gone]))]

    def insert(self, phase: Phase) -> None:
        """Execute another phase before the present one, which has just begun."""
        self._phases = (*self._phases[: self._at], phase, *self._phases[self._at :])
        self._total += phase.ticks

    def wish(self, tick: int) -> tuple[tuple[JointTarget, ...], JointWindow | None]:
        """Return targets, or a window of the trajectory, for an intent that is based on `tick`.

        After the last phase it is the end of that phase, which the joints may not have reached.
        """
        phase = self.phase or self._phases[-1]
        if phase.arm is None:
            assert phase.gripper is not None
            return (JointTarget(name=self._gripper, position=phase.gripper),), None
        first = max(0, tick - self._begun) if self.phase else phase.ticks
        rows = phase.at(first + np.arange(WINDOW_TICKS))
        return (), JointWindow(
            name=phase.arm.names,
            start=max(tick, self._begun) + AHEAD_TICKS,
            period=TICK_S,
            positions=rows.astype("<f4").tobytes(),
        )

    def expected(self, tick: int) -> dict[str, float]:
        """Return the planned positions of the arm's joints at `tick` [rad] or [m].

        Empty during a phase of the gripper.
        """
        phase = self.phase
        if phase is None or phase.arm is None:
            return {}
        (row,) = phase.at(np.array([tick - self._begun - AHEAD_TICKS]))
        return dict(zip(phase.arm.names, row.tolist(), strict=True))

    def over_for(self, tick: int) -> int:
        """Return the ticks since the last phase ended; 0 before."""
        return 0 if self.phase else tick - self._begun

    def left_ticks(self, tick: int) -> int:
        """Return the ticks until all phases are over."""
        left = sum(phase.ticks for phase in self._phases[self._at :])
        return max(0, left - (tick - self._begun)) if left else 0

    def progress(self, tick: int) -> float:
        """Return the done share, 0 to 1."""
        return 1.0 - self.left_ticks(tick) / self._total if self._total else 1.0
