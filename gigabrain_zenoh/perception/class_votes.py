"""Which class a thing has, by all that was said of it."""

from collections import defaultdict, deque

NEAREST_M = 0.5  # from the camera; nets are trained on what stands farther off
NEWEST = 60  # pictures that count


class ClassVotes:
    """Confidences of the newest pictures of one thing, by class.

    From near by only a part of a thing is seen, and a can looks like a cylinder: what is said from
    there counts only as long as nothing was said from farther off.
    """

    def __init__(self) -> None:
        self._votes: deque[tuple[str, float]] = deque(maxlen=NEWEST)
        self._near = True  # they are all from near by

    def add(self, label: str, confidence: float, distance: float) -> None:
        """Count what was said from a `distance` [m]."""
        near = distance < NEAREST_M
        if near and not self._near:
            return
        if self._near and not near:
            self._votes.clear()
        self._near = near
        self._votes.append((label, confidence))

    @property
    def label(self) -> str:
        """The class for which most confidence speaks; empty where nothing was said."""
        sums = defaultdict[str, float](float)
        for label, confidence in self._votes:
            sums[label] += confidence
        return max(sums, key=sums.__getitem__, default="")
