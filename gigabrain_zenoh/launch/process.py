"""Common frame of every process: logs, a session, health, and a node that runs until stopped."""

import asyncio
import contextlib
import functools
import gc
import logging
import os
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from gigabrain_schemas.safety import LogRecord
from gigabrain_schemas.topics import INPUT_LOG, LOG, Role
from gigabrain_zenoh import logs
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import PublishedInputLogger
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.host.signals import interrupts, stop_signals
from gigabrain_zenoh.host.this_process import (
    go_first,
    join_in,
    start_first,
    step_aside,
    unmap_code,
)
from gigabrain_zenoh.plugins import find
from gigabrain_zenoh.runtime.connect import MakeBus, connect
from gigabrain_zenoh.runtime.heartbeat import STDOUT, beat
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.runtime.services import NameClaim, publish_health, serve_params
from gigabrain_zenoh.security.acl import check_write

if TYPE_CHECKING:
    from gigabrain_zenoh.launch.deployment import Deployment

log = logging.getLogger("gigabrain")


@dataclass(frozen=True)
class ProcessPlace:
    """The endpoint, folders and time limit of one process of a deployment."""

    endpoint: Endpoint
    run_dir: Path  # folder of this run's logs
    state_dir: Path  # folder of the robot's state
    seconds: float | None = None  # [s] of simulated time; None for no limit

    @property
    def ports(self) -> Path:
        """Return the folder of an emulator's ports."""
        return self.run_dir / "ports"

    @property
    def checkpoint(self) -> Path:
        """Return the path of a simulation's checkpoints."""
        return self.run_dir / "checkpoint"


@dataclass(frozen=True)
class ProcessType:
    """One row of the table of processes: start, place, settings and identity of a process.

    Its settings are the part of a deployment file with its name, or the result of `derive`. Their
    field `state_dir`, if they have one, is set to the robot's folder.
    """

    run: str  # "module:function" of its node, imported only when it runs
    settings: type[Struct] | None = None
    derive: Callable[["Deployment", ProcessPlace], Struct] | None = None
    default: bool = False  # runs if a deployment names no hosts
    named: bool = True  # `hosts` may name it
    # returns whether a host with these processes runs it, also if `hosts` does not name it
    joins: Callable[["Deployment", set[str]], bool] | None = None
    after: tuple[str, ...] = ("router", "relay")  # processes that must be ready before it starts
    compiles: Callable[["Deployment"], bool] | None = None  # its first start takes minutes
    forks: bool = False  # a fork server may import its module, which leaves no thread running
    stop_last: bool = False  # others need it for a clean end
    stops: bool = False  # carries commands and stops: gets a higher priority where permitted
    replayable: bool = False  # can be replayed, so it publishes a log of its inputs
    optional: bool = False  # the robot runs without it, also if its settings are wrong
    looks_on: bool = False  # the robot does not need it: receives in batches, at low priority
    prompt: bool = False  # carries requests for others: runs at normal priority, though `own`
    # roles of the identity of a host that may run it; with `process` it has its own identity, in
    # a subfolder of the host's identity with the name of the process
    roles: tuple[Role, ...] = ("process",)
    writes: tuple[str, ...] = ()  # keys that its own identity may publish, ask or serve

    def __post_init__(self) -> None:
        for key in self.writes:
            check_write(key)

    @property
    def own(self) -> bool:
        """Return whether the process has an identity of its own."""
        return "process" in self.roles

    def node(self, settings: Mapping[str, Any]) -> Node:
        """Return the process's node bound to its settings. Raises ValidationError."""
        node = find(self.run)
        if self.settings is None:
            return node  # type: ignore[no-any-return]
        return functools.partial(node, msgspec.convert(settings, self.settings))


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Return uvloop's event loop factory; None (asyncio's default) if uvloop is not installed."""
    try:
        return find("uvloop:new_event_loop")  # type: ignore[no-any-return]
    except ModuleNotFoundError:
        return None


Load = Callable[[ProcessConfig], tuple[ProcessType, Node]]


class _ReportedError(Exception):
    """An error that ended the node and is already logged."""

    def __init__(self, exit_code: int) -> None:
        super().__init__()
        self.exit_code = exit_code


def run(config: ProcessConfig, load: Load, make_bus: MakeBus = Bus) -> int:
    """Run one process until it ends, and return its exit code.

    `load` returns its row, and its node bound to its settings.
    """
    gc.disable()  # until ready: objects from imports and set-up are not garbage
    try:
        run_dir = Path(config.run_dir) if config.run_dir else None
        logs.setup(config.name, run_dir, json_console=config.json_console, level=config.level)
        process_type, node = load(config)
        if process_type.stops:
            go_first()  # each branch sets priorities before threads start, which inherit them
        elif process_type.looks_on or (process_type.own and not process_type.prompt):
            step_aside()
        else:
            start_first()
        with (
            interrupts.reacting(None),  # `stop_signals` handles a signal that arrives before it
            asyncio.Runner(loop_factory=loop_factory()) as runner,
        ):
            runner.run(_run(config, process_type, node, make_bus))
    except _ReportedError as error:
        return error.exit_code
    except Exception as error:  # noqa: BLE001 - logged, and the process ends
        return _report(error)
    finally:
        logs.flush()
        gc.enable()
    return 0


def _report(error: Exception) -> int:
    """Log the error that ends the process; return its exit code."""
    first = _first(error)
    if isinstance(first, GigabrainError):
        invalid = {"value": first.value} if isinstance(first, ConfigError) and first.value else {}
        log.error("%s", first, extra={"data": {"event": "failed"} | invalid})
        return first.exit_code
    frames = traceback.extract_tb(first.__traceback__)
    where = f", in {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    notes = "".join(f" ({note})" for note in getattr(first, "__notes__", ()))
    text = f"died of {type(first).__name__}: {first}{where}{notes}"
    log.critical("%s", text, exc_info=error, extra={"data": {"event": "died"}})
    return 1


def _first(error: BaseException) -> BaseException:
    """Return the first exception within nested exception groups."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


async def _run(
    config: ProcessConfig, process_type: ProcessType, node: Node, make_bus: MakeBus
) -> None:
    with stop_signals() as stop:
        work = asyncio.ensure_future(_work(config, process_type, node, make_bus))
        stopped = asyncio.ensure_future(stop.wait())
        await asyncio.wait((work, stopped), return_when=asyncio.FIRST_COMPLETED)
        work.cancel()
        stopped.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await work


async def _work(
    config: ProcessConfig, process_type: ProcessType, node: Node, make_bus: MakeBus
) -> None:
    endpoint, looks_on = config.endpoint, process_type.looks_on
    bus_of = connect(endpoint, config.name, timeout_s=None, looks_on=looks_on, make_bus=make_bus)
    async with bus_of as bus:

        def publish_log(record: LogRecord) -> None:
            bus.publish(LOG, record, stamp_ns=record.stamp_ns)

        handler = logs.BusHandler(publish_log, config.name)
        logging.getLogger().addHandler(handler)
        if process_type.replayable:
            publish = functools.partial(bus.publish, INPUT_LOG, name=config.name)
            bus.input_log = PublishedInputLogger(publish, bus.clock.unix_ns)
        try:
            claim = NameClaim(bus)
            await claim.acquire()
            serve_params(bus)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(publish_health(bus))
                tasks.create_task(claim.keep())
                if config.json_console:
                    out = os.dup(STDOUT)  # the router redirects its standard output to Zenoh's log
                    tasks.create_task(beat(bus.clock, lambda: bus.progress(), out))
                tasks.create_task(_failure(bus))
                tasks.create_task(_node(bus, node, process_type))
        except Exception as error:  # noqa: BLE001 - logged while the bus is still open
            bus.restore_traceback(_first(error))
            raise _ReportedError(_report(error)) from None
        finally:
            logging.getLogger().removeHandler(handler)
            bus.input_log.flush()


async def _failure(bus: Bus) -> None:
    """Raise the exception of a message handler, even while the node waits for something else."""
    await bus.failed


async def _node(bus: Bus, node: Node, process_type: ProcessType) -> None:
    await node(bus, functools.partial(_ready, process_type))


def _ready(process_type: ProcessType) -> None:
    if not process_type.stops:  # processes that stop the robot must not wait for the disk
        join_in()
        unmap_code()
    gc.collect()
    gc.freeze()  # objects from set-up stay; later collections check new objects only
    gc.enable()
    log.info("ready", extra={"data": {"event": "ready", "pid": os.getpid()}})
