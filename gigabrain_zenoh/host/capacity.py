"""Notices a machine that is too small for its robot, or too busy, and says so in one line."""

LOOK_S = 1.0
SHORT_LOOKS = 5  # so many in a row, for a pause of the machine passes
KEPT = 0.95  # share of real time that a simulation keeps on a machine that can carry it


class Capacity:
    """Judges a run in real time by the robot's clock, and by why it stands."""

    def __init__(self) -> None:
        self.problem = ""  # for people; stays once it is there
        self._began: tuple[float, float] | None = None  # of a row of bad looks: wall, robot [s]
        self._last: tuple[float, float] | None = None
        self._short, self._held = 0, False

    def restart(self) -> None:
        """Count from the next look on: a process is starting, and time may wait for it."""
        self._last, self._short, self._held = None, 0, False

    def look(self, now_s: float, robot_s: float, *, held: bool) -> None:
        """Compare the wall clock with the robot's.

        `held` says that the brain is held back while the processors have no time to spare.
        """
        if self._last is None:
            self._last = self._began = now_s, robot_s
        self._held |= held
        passed_s, gained_s = now_s - self._last[0], robot_s - self._last[1]
        if passed_s < LOOK_S:
            return
        lost = 0.0 < gained_s < KEPT * passed_s  # a clock that stands still is another fault
        if not (lost or self._held):
            self._began, self._short = (now_s, robot_s), 0
        else:
            self._short += 1
        self._last, self._held = (now_s, robot_s), False
        if self._short >= SHORT_LOOKS and not self.problem:
            self.problem = self._in_words(now_s, robot_s)

    def _in_words(self, now_s: float, robot_s: float) -> str:
        assert self._began
        share = (robot_s - self._began[1]) / (now_s - self._began[0])
        what = f"its time runs at {share:.0%} of real time" if share < KEPT else "the brain is late"
        return (
            f"this machine is too small for the robot, or too busy: {what}; "
            "run fewer robots on it, or end what else needs its processors"
        )
