"""`gigabrain record` once its options are read: a recording, and a line that says how it goes."""

import asyncio
import contextlib
import sys
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.text import Text

from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.host.stop_signals import stop_signals
from gigabrain_zenoh.recording.node import listening, path_of, recover_others
from gigabrain_zenoh.recording.play import Player, PlayOptions, check_nobody_drives
from gigabrain_zenoh.recording.recorder import Recorder, Status
from gigabrain_zenoh.recording.records import check_magic
from gigabrain_zenoh.runtime.joining import Where, joined

LOOK_S = 0.5
CLOSE_S = 10.0  # a slow disk may take as long to take the rest of a recording


async def record(config: RecorderConfig, where: Where, seconds: float | None) -> int:
    """Record until Ctrl-C or for `seconds`; the exit code. Raises GigabrainError."""
    path = path_of(config)
    async with joined(where, "record", looks_on=True) as (bus, _):
        recorder = Recorder(path, config)
        recorder.begin()
        recover_others(path.parent)
        with stop_signals(CLOSE_S) as stop, recorder, listening(bus, recorder, config.topics):
            print(f"recording into {path}; Ctrl-C ends it", flush=True)
            await _watch(recorder, stop, seconds)
    end = recorder.status()
    print(in_words(end))
    for key in sorted(recorder.intake.seen):
        print(_of_key(recorder, key))
    return 1 if end.dropped else 0


async def _watch(recorder: Recorder, stop: asyncio.Event, seconds: float | None) -> None:
    console = Console()
    with Live(console=console, auto_refresh=False, transient=True) as live:
        loop = asyncio.get_running_loop()
        end_s, before = loop.time() + (seconds or float("inf")), recorder.status()
        while not stop.is_set() and loop.time() < end_s and not _failed(recorder):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), min(LOOK_S, max(0.0, end_s - loop.time())))
            now = recorder.status()
            if sys.stdout.isatty():
                live.update(Text(f"{in_words(now)}  {_rates(before, now)}"), refresh=True)
            before = now


def _failed(recorder: Recorder) -> bool:
    """Whether the writer has ended before its time; its error is raised then."""
    done = recorder.done
    if done is None or not done.done():
        return False
    done.result()
    return True


def in_words(now: Status) -> str:
    """How a recording is doing, in a line."""
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


def _of_key(recorder: Recorder, key: str) -> str:
    intake = recorder.intake
    line = f"  {key:<28} {intake.seen[key]:>7}"
    for name, counts in (
        ("missing", intake.gaps.missing),
        ("dropped", intake.dropped),
        ("restarts", intake.gaps.restarts),
    ):
        if counts[key]:
            line += f"  {name} {counts[key]}"
    return line


async def play(
    path: Path,
    options: PlayOptions,
    where: Where,
    *,
    beside_robot: bool,
) -> int:
    """Play to the end or until Ctrl-C; the exit code. Raises GigabrainError."""
    check_magic(path)
    async with joined(where, "play") as (bus, transport):
        if not beside_robot:
            await check_nobody_drives(bus)
        player = Player(path, options, transport)
        with stop_signals() as stop:
            playing = asyncio.ensure_future(player.play())
            stopped = asyncio.ensure_future(stop.wait())
            await asyncio.wait((playing, stopped), return_when=asyncio.FIRST_COMPLETED)
            stopped.cancel()
            if not playing.cancel():
                playing.result()
    print(f"{player.sent} messages sent, the latest {player.late_s * 1e3:.0f} ms after its time")
    return 0
