"""Pictures, detections and findings for viewers; received only while there are viewers."""

import functools
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import MAX_CAMERAS
from gigabrain_schemas.objects import Detections
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import DETECTIONS, IMAGE, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.headers import header_of
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.host.bounded import put_newest

MAX_RECENT_PICTURES, MAX_RECENT_TICKS = 32, 25  # per camera; detections come up to 0.5 s later
_decode_image = Codec(IMAGE.type, IMAGE.max_bytes).decode


class CameraFeed:
    """Keeps the newest message of each camera or perceptor, and decodes it when it is read.

    A topic has at most MAX_CAMERAS keys here; further keys are ignored.
    """

    def __init__(self, bus: Bus, *topics: Topic[Any]) -> None:
        self._bus, self._topics = bus, topics
        self._sampled: dict[Topic[Any], dict[str, Sampled[Any]]] = {}
        self._detections: dict[str, Detections] = {}  # not read yet, by camera
        # basis and payload of the newest pictures, by camera
        self._recent: dict[str, deque[tuple[int, bytes]]] = {}
        self._closes: list[Callable[[], None]] = []

    def watch(self, on: bool) -> None:
        """Start or stop receiving."""
        if on == bool(self._closes):
            return
        for close in self._closes:
            close()
        self._closes = []
        self._detections.clear()
        self._recent.clear()
        self._sampled = {topic: {} for topic in self._topics if topic.many}
        if on:
            self._closes = [
                self._bus.tap(topic.at("*"), functools.partial(self._receive, topic))
                for topic in self._sampled
            ]
            if DETECTIONS in self._topics:
                self._closes.append(self._bus.subscribe(DETECTIONS, self._add_detections))

    def names(self, topic: Topic[Any]) -> list[str]:
        """Return the names below a topic that have been received."""
        return list(self._sampled.get(topic, ()))

    def poll(self, topic: Topic[Any], name: str) -> Message | None:
        """Return the newest message of a name; None if there is no new one since the last call."""
        sampled = self._sampled.get(topic, {}).get(name)
        return sampled.poll() if sampled else None

    def picture_at(self, camera: str, basis: int) -> Image | None:
        """Return the picture with this basis, if it is one of the newest."""
        for of, payload in reversed(tuple(self._recent.get(camera, ()))):
            if of == basis:
                with suppress(ValueError):
                    return _decode_image(payload)
        return None

    def new_detections(self) -> Iterator[Detections]:
        """Yield the newest detections of each camera since the last call."""
        found, self._detections = self._detections, {}
        yield from found.values()

    def _receive(self, topic: Topic[Any], key: str, encoding: str, payload: bytes) -> None:
        """Keep an encoded payload. Called in any thread."""
        by_name, name = self._sampled.get(topic), key.removeprefix(f"{topic.key}/")
        if by_name is not None and (name in by_name or len(by_name) < MAX_CAMERAS):
            sampled = by_name.setdefault(name, Sampled(self._bus, topic))
            sampled.receive(key, encoding, payload)
            if topic is IMAGE and DETECTIONS in self._topics:
                self._keep(name, header_of(payload).basis, payload)

    def _keep(self, camera: str, basis: int, payload: bytes) -> None:
        """Keep a picture, and drop those that are too old for detections."""
        recent = self._recent.setdefault(camera, deque(maxlen=MAX_RECENT_PICTURES))
        recent.append((basis, payload))
        while basis - recent[0][0] > MAX_RECENT_TICKS:
            recent.popleft()

    def _add_detections(self, _key: str, found: Detections) -> None:
        put_newest(self._detections, found.camera, found, MAX_CAMERAS)
