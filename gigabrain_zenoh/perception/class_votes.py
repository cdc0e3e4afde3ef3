"""Chooses the class of one thing from a network's classes of it in many pictures."""

from collections import defaultdict, deque

NEAREST_M, FARTHEST_M = 0.5, 2.0  # range of camera distances in which a network is most reliable
NEAR_WEIGHT, FAR_WEIGHT = 0.05, 0.25  # of pictures from outside that range; 1 inside
MAX_PICTURES = 60  # newest ones that count: as many near ones as others


class ClassVotes:
    """Confidences of the newest pictures of one thing, by class.

    Close to a can, a network may see a cylinder in every picture. From far away, it may
    sometimes see a robot. Such pictures count less.
    """

    def __init__(self) -> None:
        self._near: deque[tuple[str, float]] = deque(maxlen=MAX_PICTURES)
        self._votes: deque[tuple[str, float]] = deque(maxlen=MAX_PICTURES)

    def add(self, label: str, confidence: float, distance: float) -> None:
        """Add the class in a picture that was taken from `distance` [m]."""
        if distance < NEAREST_M:
            self._near.append((label, NEAR_WEIGHT * confidence))
        else:
            weight = FAR_WEIGHT if distance > FARTHEST_M else 1.0
            self._votes.append((label, weight * confidence))

    @property
    def label(self) -> str:
        """The class with the largest sum of confidences; empty before the first picture."""
        sums = defaultdict[str, float](float)
        for label, confidence in (*self._near, *self._votes):
            sums[label] += confidence
        return max(sums, key=sums.__getitem__, default="")
