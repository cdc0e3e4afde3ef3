"""Runs fault tests in turn, grouped by the robot that they share, and judges them.

Speeds are 0.26 m/s unless a row says otherwise. Times are the robot's own (ticks of 20 ms) or the
simulation's; those marked `wall` are wall time. Travel and contacts are the physics' truth. From
0.26 m/s at 1 m/s2 a body brakes for 260 ms, and its own lag adds 100 ms: limits of zero are 360 ms
above those of braking. No run that counts may exceed a limit.
"""

import asyncio
import contextlib
import gc
import importlib
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import get_args

import msgspec
from msgspec import Struct

from gigabrain_zenoh.config.renames import FAULT_NAMES, renamed_word
from gigabrain_zenoh.errors import ConfigError, GigabrainError, unknown
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.files import cannot_read, cannot_write, read_bounded
from gigabrain_zenoh.qa.faults import rows as row_modules
from gigabrain_zenoh.qa.faults.rig import Options, Rig
from gigabrain_zenoh.qa.judging import (
    FaultResult,
    FaultRow,
    FaultRun,
    Skipped,
    Stage,
    conclude,
    judge,
)

MAX_DISTURBED = 3  # disturbed runs for each run that counts
LIMIT_S = 300.0  # timeout of a run in its short form
STAGES = get_args(Stage)
POLL_S = 0.1
DISTURBED_MS = 30.0  # of 100, in which a part of the robot could not run; 1.5 ticks
MAX_FILE_BYTES = 100_000_000

RowBegun = Callable[[FaultRow], None]
RunEnded = Callable[[FaultRow, FaultRun], None]
EarlierRuns = Mapping[int, Sequence[FaultRun]]


def _all_rows() -> Iterator[FaultRow]:
    """Yield the rows of all modules in the package `rows`."""
    for found in pkgutil.iter_modules(row_modules.__path__, f"{row_modules.__name__}."):
        module = importlib.import_module(found.name)
        yield from (row for row in vars(module).values() if isinstance(row, FaultRow))


FAULTS: tuple[FaultRow, ...] = tuple(sorted(_all_rows(), key=lambda row: row.number))


def choose(wanted: Iterable[str]) -> tuple[FaultRow, ...]:
    """Return the rows with these numbers or names, in order; all rows if `wanted` is empty.

    An old name prints a notice. Raises UnknownName.
    """
    names = {row.name: row for row in FAULTS}
    numbers = {str(row.number): row for row in FAULTS}
    chosen = set()
    for text in wanted:
        found = numbers.get(text) or names.get(renamed_word(text, FAULT_NAMES))
        if not found:
            raise unknown(f"fault (a name, or a number from 1 to {len(FAULTS)})", text, names)
        chosen.add(found.number)
    return tuple(row for row in FAULTS if not chosen or row.number in chosen)


async def run_suite(
    rows: Iterable[FaultRow],
    options: Options,
    folder: Path,
    repeat: int = 1,
    begun: RowBegun = lambda row: None,
    ended: RunEnded = lambda row, run: None,
    earlier: EarlierRuns = MappingProxyType({}),
) -> list[FaultResult]:
    """Run every row until `repeat` runs of it count; returns the results in order.

    `earlier` are previous runs, by the row's number: they count like new ones.
    """
    ordered = sorted(rows, key=lambda row: (STAGES.index(row.stage), row.number))
    results = []
    async with Rig(options, folder) as rig:
        for row in ordered:
            begun(row)
            before = earlier.get(row.number, ())
            results.append(conclude(row, await _runs(row, rig, repeat, ended, before)))
    return sorted(results, key=lambda result: result.number)


async def _runs(
    row: FaultRow, rig: Rig, repeat: int, ended: RunEnded, before: Sequence[FaultRun]
) -> list[FaultRun]:
    """Run one row; a disturbed run is followed by another, passed or failed.

    A long form always counts: within an hour some thread always waits for a core for a while.
    """
    runs, disturbed = list(before), sum(one.disturbed for one in before)
    while len(runs) - disturbed < repeat and disturbed < MAX_DISTURBED * repeat:
        runs.append(await _run(row, rig))
        ended(row, runs[-1])
        disturbed += runs[-1].disturbed
        if runs[-1].verdict == "skipped":
            break
    return runs


async def _run(row: FaultRow, rig: Rig) -> FaultRun:
    loop, watch = asyncio.get_running_loop(), RunQueueWatch(lambda: ("self", *rig.pids()))
    watch.start()
    began_s = loop.time()
    try:
        with without_garbage_collection():
            judged = await _judged(row, rig)
    finally:
        watch.close()
    return msgspec.structs.replace(
        judged,
        waited_ms=round(watch.longest_ms, 1),
        disturbed=watch.longest_ms >= DISTURBED_MS and not (row.loads or rig.long),
        seconds=round(loop.time() - began_s, 1),
    )


@contextlib.contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Collect garbage before the block, and none in it.

    A collection takes 35 ms and more, and that delay of the suite would count against the robot.
    """
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


async def _judged(row: FaultRow, rig: Rig) -> FaultRun:
    """Run one test and judge it. The robot of a failed run is not used again."""
    try:
        async with asyncio.timeout(None if rig.long else LIMIT_S):
            measured = await row.test(rig)
            await rig.check()
    except Skipped as error:
        return FaultRun(verdict="skipped", reason=str(error))
    except (GigabrainError, TimeoutError) as error:
        await rig.end_robot()
        return FaultRun(verdict="FAILED", reason=str(error) or f"not over after {LIMIT_S:g} s")
    verdict, reason = judge(row, measured, wall=rig.options.wall, long=rig.long)
    by_name = {figure.name: value for figure, value in measured.items()}
    return FaultRun(verdict=verdict, reason=reason, measured=by_name)


def failed(results: Sequence[FaultResult]) -> bool:
    """Return whether any test has failed."""
    return any(result.verdict == "FAILED" for result in results)


class RunQueueWatch:
    """Measures the longest that one thread of some processes has waited for a core within 0.1 s.

    A core that the host of a virtual machine gave to others counts as a waiting thread. A delay of
    this program's own event loop counts too: it plays the network and the operators.
    """

    def __init__(self, processes: Callable[[], Iterable[int | str]]) -> None:
        self._processes = processes
        self._before: dict[tuple[int | str, str], int] = {}
        self._task: asyncio.Task[None] | None = None
        self.longest_ms = 0.0

    def start(self) -> None:
        """Start to sample, ten times a second."""
        self._task = asyncio.create_task(self._watch())

    def close(self) -> None:
        """Stop sampling."""
        if self._task:
            self._task.cancel()

    def sample(self) -> None:
        """Compare with the last sample; new threads are not judged."""
        now = {
            (process, thread): waited_ns
            for process in self._processes()
            for thread, waited_ns in this_process.waited_ns_by_thread(process).items()
        }
        now |= {
            ("host", core): stolen_ns
            for core, stolen_ns in this_process.stolen_ns_by_core().items()
        }
        waits = (waited - self._before.get(thread, waited) for thread, waited in now.items())
        self.longest_ms = max(self.longest_ms, max(waits, default=0) / 1e6)
        self._before = now

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            self.sample()
            due_s = loop.time() + POLL_S
            await asyncio.sleep(POLL_S)
            self.longest_ms = max(self.longest_ms, (loop.time() - due_s) * 1e3)


class RunLine(Struct, frozen=True, kw_only=True):
    """One line of a file of runs."""

    number: int
    name: str
    options: Options
    run: FaultRun


_line = msgspec.json.Decoder(RunLine)


class RunsFile:
    """Appends runs to a file, and reads those that were made with the same options."""

    def __init__(self, path: Path, options: Options) -> None:
        self._path, self._options = path, options

    def read(self) -> dict[int, Sequence[FaultRun]]:
        """Return the runs in the file, by the row's number. Raises ConfigError."""
        runs: dict[int, list[FaultRun]] = {}
        try:
            text = read_bounded(self._path, MAX_FILE_BYTES) if self._path.exists() else b""
            for line in map(_line.decode, text.splitlines()):
                if line.options == self._options:
                    runs.setdefault(line.number, []).append(line.run)
        except OSError as error:
            raise cannot_read(self._path, error) from None
        except msgspec.MsgspecError as error:
            raise ConfigError(f"cannot continue {self._path}: {error}") from None
        return dict(runs)

    def append(self, row: FaultRow, run: FaultRun) -> None:
        """Append one run. Raises ConfigError."""
        line = RunLine(number=row.number, name=row.name, options=self._options, run=run)
        try:
            with self._path.open("ab") as file:
                file.write(msgspec.json.encode(line) + b"\n")
        except OSError as error:
            raise cannot_write(self._path, error) from None
