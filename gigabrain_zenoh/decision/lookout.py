"""Waits until a camera has seen a thing, and has the arm move out of its sight meanwhile."""

from gigabrain_schemas.body import BodyDescription

LOOK_TICKS = (
    75  # at rest, until a thing that is in sight is known: pictures come five times a second
)
ASIDE = 0.7  # of the first joint's range, to either side


class Lookout:
    """Where the arm goes while one command's thing is not seen."""

    def __init__(self) -> None:
        self._since: int | None = None
        self._gone = 0  # of the postures

    def reset(self) -> None:
        """Begin with another command, or once the thing is seen."""
        self._since, self._gone = None, 0

    def waits(self, tick: int) -> bool:
        """Return whether it may still come to be seen from where the arm rests."""
        if self._since is None or tick < self._since:
            self._since = tick
        return tick - self._since < LOOK_TICKS

    def aside(self, body: BodyDescription) -> dict[str, float] | None:
        """Return the next posture to look from [rad] or [m]; None after the last one."""
        assert body.arm
        first, places = body.joints[0], dict[str, float]()
        postures = [None, first.lower * ASIDE, first.upper * ASIDE]
        if self._gone >= len(postures):
            return None
        for joint, place in zip(body.joints, body.arm.home, strict=True):
            if joint.part == "arm":
                places[joint.name] = place
        if (aside := postures[self._gone]) is not None:
            places[first.name] = aside
        self._gone += 1
        self._since = None
        return places
