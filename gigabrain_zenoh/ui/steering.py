"""Parts that the operator page and the Foxglove bridge share: their messages, and steering."""

import functools
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.topics import LOG, MAP, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.requests import jog, steer
from gigabrain_zenoh.diagnostics.robot_view import SampledView
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of

M = TypeVar("M", bound=Message)
Wanted = Velocity | dict[str, float]  # of the base, or speeds of joints [rad/s or m/s]

LEASE_S = 0.5  # after this time without a command, another viewer may steer
MAX_STREAM_GAP_S = 0.2  # after a longer gap, commands count as a new stream
MAX_RECEIVED_HZ = 120  # messages that are processed per viewer; held keys send 25
SETTLE_S = 0.1  # a new stream is ignored for so long, as a network may have buffered commands


class ViewerScene(SampledView):
    """Messages for viewers: also map and log."""

    def __init__(self, bus: Bus) -> None:
        super().__init__(bus)
        bus.latest(MAP, functools.partial(self.on_rare, MAP))
        bus.subscribe(LOG, lambda _key, record: self.on_rare(LOG, record))

    @property
    def enables(self) -> int | None:
        """Return how often the gate was enabled; None while the robot sends nothing."""
        state = self.state.fresh()
        return state.gate.enables if state else None

    @property
    def latched(self) -> bool:
        """Return whether the gate is latched, as by an e-stop."""
        state = self.state.fresh()
        return state is not None and state.gate.mode == "latched"

    def publish(self, wanted: Wanted) -> None:
        """Publish the velocity or joint speeds that an operator wants, with the newest tick."""
        self.sampled[STATE].poll()
        if isinstance(wanted, Velocity):
            steer(self.bus, wanted)
        else:
            jog(self.bus, wanted)


class RateLimiter:
    """Limits the messages of each viewer to MAX_RECEIVED_HZ."""

    def __init__(self) -> None:
        self._second_s = 0.0
        self._received: Counter[int] = Counter()

    def is_exceeded(self, viewer: int, now_s: float) -> bool:
        """Count a message; return whether this viewer sent too many in the present second."""
        if now_s - self._second_s >= 1.0:
            self._second_s = now_s
            self._received.clear()
        self._received[viewer] += 1
        return self._received[viewer] > MAX_RECEIVED_HZ


class _Stream(NamedTuple):
    """Commands of one kind that arrive from the viewer that steers."""

    obey_from_s: float
    last_s: float
    rest: Wanted  # the command of zero speeds that ends the stream
    ignored: bool  # the gate was latched during the stream; a new one is obeyed


class TeleopArbiter:
    """Lets one viewer steer at a time, while its commands arrive. Commands are never repeated.

    The viewer may drive the base and move joints at once: each is a stream that ends by itself. A
    stream during which the gate is latched is ignored until its end. So a key held during an e-stop
    does not move the robot after the release.
    """

    def __init__(self, scene: ViewerScene) -> None:
        self._scene = scene
        self._viewer = 0
        self._lease_end_s = 0.0
        self._streams: dict[type, _Stream] = {}  # of that viewer, by the type of its commands
        self._enables: int | None = None  # the gate's count when a viewer last steered

    def driving(self, now_s: float) -> int:
        """Return the number of the viewer that steers, or 0."""
        return self._viewer if now_s < self._lease_end_s else 0

    def drive(self, viewer: int, wanted: Velocity, now_s: float) -> bool:
        """Pass on the velocity that a viewer (1, 2, …) wants; return False if another one steers.

        A zero velocity from another viewer is ignored, and returns True.
        """
        body = self._scene.body
        if body is None:
            return True
        return self._pass_on(viewer, clamp(wanted, limits_of(body.description)), ZERO, now_s)

    def jog(self, viewer: int, speeds: Mapping[str, float], now_s: float) -> bool:
        """Pass on speeds of joints [rad/s or m/s], like `drive`; unknown joints are left out."""
        joints = self._scene.body.description.joints if self._scene.body else ()
        limits = {joint.name: joint.max_speed for joint in joints if joint.name in speeds}
        if not limits:
            return True
        wanted = {name: max(-limits[name], min(limits[name], speeds[name])) for name in limits}
        return self._pass_on(viewer, wanted, dict.fromkeys(limits, 0.0), now_s)

    def _pass_on(self, viewer: int, wanted: Wanted, rest: Wanted, now_s: float) -> bool:
        if self.driving(now_s) not in (0, viewer):
            return wanted == rest
        if viewer != self._viewer:
            if wanted == rest:
                return True
            self._streams.clear()
        stream = self._streams.get(type(wanted))
        continues = stream is not None and now_s - stream.last_s <= MAX_STREAM_GAP_S
        obey_from_s = stream.obey_from_s if stream and continues else now_s + SETTLE_S
        self._viewer, self._lease_end_s = viewer, now_s + LEASE_S
        ignored = self._scene.latched or bool(stream and continues and stream.ignored)
        self._streams[type(wanted)] = _Stream(obey_from_s, now_s, rest, ignored)
        if wanted == rest:
            self._end(type(wanted))
        elif now_s >= obey_from_s and not ignored:
            self._enables = self._scene.enables
            self._scene.publish(wanted)
        return True

    def leave(self, viewer: int) -> None:
        """Stop the robot if `viewer`, which leaves, steers it."""
        if viewer == self._viewer:
            self.clear()

    def clear(self) -> None:
        """End steering by any viewer, for example after an e-stop."""
        for kind in tuple(self._streams):
            self._end(kind)

    def _end(self, kind: type) -> None:
        """Publish zero speeds, unless the gate was enabled again since the last command.

        In that case they would take the body back from its new commander.
        """
        rest = self._streams.pop(kind).rest
        if not self._streams:
            self._viewer = 0
        if self._scene.enables in (None, self._enables):
            self._scene.publish(rest)
