"""Records the events of a link."""

from gigabrain_drivers.links.link import Link


class LinkRecorder:
    """The bytes, openings and losses that a link reported."""

    def __init__(self, link: Link) -> None:
        self.data, self.opened, self.lost = b"", 0, list[str]()
        link.on_bytes, link.on_open, link.on_lost = self._bytes, self._opened, self.lost.append

    def _bytes(self, data: bytes) -> None:
        self.data += data

    def _opened(self) -> None:
        self.opened += 1
