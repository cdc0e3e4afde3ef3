"""The recorder as a process, and what it has in common with `gigabrain record`."""

import asyncio
import functools
import itertools
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

from gigabrain_schemas.body import Body
from gigabrain_schemas.topics import BODY, TOPICS
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import topic_named
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.logs import state_dir
from gigabrain_zenoh.recording.recorder import Recorder
from gigabrain_zenoh.recording.recover import recover_all

log = logging.getLogger(__name__)

ALL = "robot/**"
COUNT_S = 0.5


def patterns(names: tuple[str, ...]) -> list[str]:
    """The key expressions to listen on: topics by name, or as given. Raises UnknownName."""
    if not names:
        return [ALL]
    return [name if "*" in name else topic_named(name).at("**") for name in names]


def chosen(names: tuple[str, ...]) -> Callable[[str], bool]:
    """Whether a key is among those that `names` mean. Raises UnknownName."""
    heard = [pattern.replace("**", "*") for pattern in patterns(names)] if names else ["*"]

    def wanted(key: str) -> bool:
        return any(fnmatchcase(key, each) or f"{key}/*" == each for each in heard)

    return wanted


def file_name(label: str = "") -> str:
    """The name of a new recording: the time, and whose it is."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    return f"{stamp}-{label}.mcap" if label else f"{stamp}.mcap"


def path_of(config: RecorderConfig) -> Path:
    """Where to record. Raises ConfigError where there is no home folder."""
    if config.file:
        return Path(config.file).absolute()
    folder = Path(config.folder).absolute() if config.folder else state_dir() / "recordings"
    return folder / file_name()


def free(path: Path) -> Path:
    """`path`, or where it exists the first numbered one beside it that does not."""
    others = (path.with_name(f"{path.stem}_{n}{path.suffix}") for n in itertools.count(1))
    return path if not path.exists() else next(other for other in others if not other.exists())


@contextmanager
def listening(bus: Bus, recorder: Recorder, names: tuple[str, ...]) -> Iterator[None]:
    """Whatever comes over the bus goes to the recorder, while the block runs."""
    take = recorder.intake.take
    heard = patterns(names)
    taps = {pattern: bus.tap(pattern, take) for pattern in heard}

    def see(_key: str, body: Body) -> None:
        """A body may obey a key of its own, which is not below `robot`."""
        key = body.description.control_topic
        if not names and not key.startswith("robot/") and key not in taps:
            taps[key] = bus.tap(key, take)

    close = bus.subscribe(BODY, see)
    fetching = asyncio.ensure_future(_fetch_kept(bus, recorder, heard))
    try:
        yield
    finally:
        fetching.cancel()
        close()
        for end in taps.values():
            end()


async def _fetch_kept(bus: Bus, recorder: Recorder, heard: list[str]) -> None:
    """The map as it is, for a recording that begins after it was sent."""
    for topic in TOPICS:
        if topic.keep and (ALL in heard or topic.key in heard):
            for payload in await bus.kept(topic):
                if not recorder.intake.seen[topic.key]:
                    recorder.intake.take(topic.key, "", payload)


def recover_others(folder: Path) -> None:
    """Mend what earlier recordings have left unfinished, aside and in no hurry."""
    threading.Thread(target=functools.partial(recover_all, folder), daemon=True).start()


async def run(config: RecorderConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Record until the process ends."""
    path = free(path_of(config))  # after a restart it goes on in another file
    recorder = Recorder(path, config)
    recover_others(path.parent)
    with recorder, listening(bus, recorder, config.topics):
        ready()
        log.info("recording into %s", path)
        assert recorder.done
        writing = asyncio.wrap_future(recorder.done)
        counting = asyncio.ensure_future(_count(bus, recorder))
        try:
            await asyncio.wait((writing, counting, bus.failed), return_when=asyncio.FIRST_COMPLETED)
        finally:
            counting.cancel()
        for end in (writing, bus.failed):
            if end.done():
                end.result()


async def _count(bus: Bus, recorder: Recorder) -> None:
    """Show in the process's health how the recording is doing."""
    async for _ in bus.clock.every(round(COUNT_S * 1e9)):
        now = recorder.status()
        bus.counters.update(
            {
                "recorded": now.written - bus.counters["recorded"],
                "dropped": now.dropped - bus.counters["dropped"],
                "missing": now.missing - bus.counters["missing"],
                "bytes": now.size - bus.counters["bytes"],
            }
        )
