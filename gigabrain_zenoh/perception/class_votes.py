"""Chooses the class of one thing from the classes that a net gave it in many pictures."""

from collections import defaultdict, deque

NEAREST_M, FARTHEST_M = 0.5, 2.0  # from the camera, between which a net is surest
NEARER, FARTHER = 0.05, 0.25  # what a picture from elsewhere counts, beside one from there
NEWEST = 60  # pictures that count, from near by and from farther off


class ClassVotes:
    """Confidences of the newest pictures of one thing, by class.

    From near by a net may take a can for a cylinder, in as many pictures as the robot stands there.
    From far off it may take one for a robot now and then.
    """

    def __init__(self) -> None:
        self._near: deque[tuple[str, float]] = deque(maxlen=NEWEST)
        self._votes: deque[tuple[str, float]] = deque(maxlen=NEWEST)

    def add(self, label: str, confidence: float, distance: float) -> None:
        """Add the class of a picture that was taken from a `distance` [m]."""
        if distance < NEAREST_M:
            self._near.append((label, NEARER * confidence))
        else:
            share = FARTHER if distance > FARTHEST_M else 1.0
            self._votes.append((label, share * confidence))

    @property
    def label(self) -> str:
        """The class with the largest sum of confidences; empty before the first picture."""
        sums = defaultdict[str, float](float)
        for label, confidence in (*self._near, *self._votes):
            sums[label] += confidence
        return max(sums, key=sums.__getitem__, default="")
