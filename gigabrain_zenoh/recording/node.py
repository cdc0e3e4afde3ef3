"""Runs the recorder: as a process, and as the command `gigabrain record`."""

import asyncio
import contextlib
import functools
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from gigabrain_schemas.body import Body
from gigabrain_schemas.topics import BODY, TOPICS
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.key_expressions import key_expressions, matches
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.files import check_new_file
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.host.signals import stop_signals
from gigabrain_zenoh.recording.recorder import Recorder, Status, unused_path
from gigabrain_zenoh.recording.recovery import recover_all
from gigabrain_zenoh.runtime.connect import Where, connect

log = logging.getLogger(__name__)

ALL_KEYS = "robot/**"
HEALTH_INTERVAL_S = 0.5
STATUS_INTERVAL_S = 0.5
CLOSE_S = 10.0  # a slow disk may take this long to finish a recording


def key_filter(names: tuple[str, ...]) -> Callable[[str], bool]:
    """Return a test for keys that `names` select; empty names select all. Raises ConfigError."""
    patterns = key_expressions(names) if names else ["**"]
    return functools.cache(lambda key: any(matches(each, key) for each in patterns))


def file_name(label: str = "") -> str:
    """Return the name of a new recording: the time in UTC, and a label."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    return f"{stamp}-{label}.mcap" if label else f"{stamp}.mcap"


def recording_path(config: RecorderConfig) -> Path:
    """Return the path of a recording. Raises ConfigError if there is no home folder."""
    if config.file:
        return Path(config.file).absolute()
    folder = Path(config.folder).absolute() if config.folder else state_dir() / "recordings"
    return folder / file_name()


@contextmanager
def listening(bus: Bus, recorder: Recorder, names: tuple[str, ...]) -> Iterator[None]:
    """Pass all messages of the topics `names` to the recorder while the block runs.

    Raises ConfigError for a wrong name.
    """
    receive, expressions = recorder.intake.receive, key_expressions(names) or [ALL_KEYS]
    taps = {each: bus.tap(each, receive) for each in expressions}

    def record_control_topic(_key: str, body: Body) -> None:
        """Record the key that a body obeys, which may lie outside `robot/`."""
        key = body.description.control_topic
        if not names and not key.startswith("robot/") and key not in taps:
            taps[key] = bus.tap(key, receive)

    close = bus.subscribe(BODY, record_control_topic)
    fetching = asyncio.ensure_future(_fetch_kept(bus, recorder, expressions))
    try:
        yield
    finally:
        fetching.cancel()
        close()
        for end in taps.values():
            end()


async def _fetch_kept(bus: Bus, recorder: Recorder, expressions: list[str]) -> None:
    """Record messages kept for late subscribers, such as a map sent before the recording began."""
    for topic in TOPICS:
        if topic.keep and any(matches(each, topic.key) for each in expressions):
            for payload in await bus.kept(topic):
                if not recorder.intake.seen[topic.key]:
                    recorder.intake.receive(topic.key, "", payload)


def _recover_in_background(folder: Path, config: RecorderConfig) -> None:
    """Recover interrupted recordings, in a thread."""
    work = functools.partial(recover_all, folder, keep_free_mb=config.keep_free_mb)
    threading.Thread(target=work, daemon=True).start()


async def run(config: RecorderConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Record until the process ends."""
    path = unused_path(recording_path(config))  # after a restart it continues in another file
    recorder = Recorder(path, config)
    _recover_in_background(path.parent, config)
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
    """Report the recording's progress in the health of the process."""
    async for _ in bus.clock.every(round(HEALTH_INTERVAL_S * 1e9)):
        now = recorder.status()
        totals = {
            "recorded": now.written,
            "dropped": now.dropped,
            "missing": now.missing,
            "bytes": now.size,
        }
        for name, total in totals.items():
            bus.counters[name] = total


async def record(config: RecorderConfig, where: Where, seconds: float | None) -> int:
    """Record until Ctrl-C or for `seconds`; return the exit code. Raises GigabrainError."""
    path = recording_path(config)
    key_expressions(config.topics)  # raises before connecting
    check_new_file(path)
    async with connect(where, "record", looks_on=True) as bus:
        recorder = Recorder(path, config)
        recorder.begin()
        _recover_in_background(path.parent, config)
        with stop_signals(CLOSE_S) as stop, recorder, listening(bus, recorder, config.topics):
            print(f"recording into {path}; Ctrl-C ends it", flush=True)
            await _show_status(recorder, stop, seconds)
    end = recorder.status()
    print(status_line(end))
    for key in sorted(recorder.intake.seen | recorder.intake.left_out):
        print(_key_line(recorder, key))
    return 1 if end.dropped else 0


async def _show_status(recorder: Recorder, stop: asyncio.Event, seconds: float | None) -> None:
    from rich.console import Console  # takes 0.3 s, and the process does not need it
    from rich.live import Live
    from rich.text import Text

    with Live(console=Console(), auto_refresh=False, transient=True) as live:
        loop = asyncio.get_running_loop()
        end_s, before = loop.time() + (seconds or float("inf")), recorder.status()
        while not stop.is_set() and loop.time() < end_s and not _has_failed(recorder):
            with contextlib.suppress(TimeoutError):
                left_s = max(0.0, end_s - loop.time())
                await asyncio.wait_for(stop.wait(), min(STATUS_INTERVAL_S, left_s))
            now = recorder.status()
            if sys.stdout.isatty():
                live.update(Text(f"{status_line(now)}  {_rates(before, now)}"), refresh=True)
            before = now


def _has_failed(recorder: Recorder) -> bool:
    """Return whether the writer ended early; raise its error, if any."""
    done = recorder.done
    if done is None or not done.done():
        return False
    done.result()
    return True


def status_line(now: Status) -> str:
    """Format the progress of a recording as one line."""
    files = f" in {now.files} files" if now.files > 1 else ""
    line = (
        f"{now.path.name}  {now.seconds:.1f} s  {now.size / 1e6:.2f} MB{files}  "
        f"{now.written} messages  missing {now.missing}  dropped {now.dropped}"
    )
    return f"{line}  ({now.fault})" if now.fault else line


def _rates(before: Status, now: Status) -> str:
    seconds = max(now.seconds - before.seconds, 1e-3)
    messages, size = now.seen - before.seen, now.size - before.size
    return f"{messages / seconds:.0f}/s  {size / seconds / 1e3:.0f} kB/s"


def _key_line(recorder: Recorder, key: str) -> str:
    intake = recorder.intake
    line = f"  {printable(key):<28} {intake.seen[key]:>7} {intake.bytes[key] / 1e6:>8.2f} MB"
    for name, counts in (
        ("missing", intake.gaps.missing),
        ("dropped", intake.dropped),
        ("left out", intake.left_out),
        ("restarts", intake.gaps.restarts),
    ):
        if counts[key]:
            line += f"  {name} {counts[key]}"
    return line
