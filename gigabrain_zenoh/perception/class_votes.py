"""Chooses the class of one thing from the classes that a net gave it in many pictures."""

from collections import defaultdict, deque

NEAREST_M = 0.5  # from the camera; nets are trained on what stands farther off
NEWEST = 60  # pictures that count


class ClassVotes:
    """Confidences of the newest pictures of one thing, by class.

    From near by a net takes a can for a cylinder, so pictures from nearer than NEAREST_M count only
    until there is one from farther off.
    """

    def __init__(self) -> None:
        self._votes: deque[tuple[str, float]] = deque(maxlen=NEWEST)
        self._near = True  # they are all from near by

    def add(self, label: str, confidence: float, distance: float) -> None:
        """Add the class of a picture that was taken from a `distance` [m]."""
        near = distance < NEAREST_M
        if near and not self._near:
            return
        if self._near and not near:
            self._votes.clear()
        self._near = near
        self._votes.append((label, confidence))

    @property
    def label(self) -> str:
        """The class with the largest sum of confidences; empty before the first picture."""
        sums = defaultdict[str, float](float)
        for label, confidence in self._votes:
            sums[label] += confidence
        return max(sums, key=sums.__getitem__, default="")
