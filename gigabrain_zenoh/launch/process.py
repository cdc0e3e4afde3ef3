"""Common frame of every process: logs, a session, health, and a node that runs until stopped."""

import asyncio
import contextlib
import functools
import gc
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from gigabrain_schemas.topics import INPUT_LOG, LOG, Role
from gigabrain_zenoh import logs
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import PublishedInputLogger
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.host.signals import interrupts, stop_signals
from gigabrain_zenoh.host.this_process import go_first, join_in, start_first, step_aside
from gigabrain_zenoh.plugins import find
from gigabrain_zenoh.runtime.connect import MakeBus, connect
from gigabrain_zenoh.runtime.heartbeat import STDOUT, beat
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.runtime.services import NameClaim, publish_health, serve_params

if TYPE_CHECKING:
    from gigabrain_zenoh.launch.deployment import Deployment

log = logging.getLogger("gigabrain")


@dataclass(frozen=True)
class ProcessPlace:
    """Where one process of a deployment runs."""

    endpoint: Endpoint
    run_dir: Path  # folder of this run's logs
    state_dir: Path  # folder of what the robot remembers
    seconds: float | None = None  # [s] of simulated time; None for no limit

    @property
    def ports(self) -> Path:
        """Return the folder of an emulator's ports."""
        return self.run_dir / "ports"


@dataclass(frozen=True)
class ProcessType:
    """One row of the table of processes: how a process is started, placed, set up and identified.

    Its settings are the part of a deployment file that has its name, or what `derive` makes of the
    whole deployment. A field `state_dir` of them gets the robot's folder.
    """

    run: str  # "module:function" of its node, imported only when it runs
    settings: type[Struct] | None = None
    derive: Callable[["Deployment", ProcessPlace], Struct] | None = None
    default: bool = False  # runs if a deployment names no hosts
    named: bool = True  # `hosts` may name it
    joins: Callable[["Deployment", set[str]], bool] | None = None  # added to such a host by itself
    after: tuple[str, ...] = ("router", "relay")  # which of these must be ready before it starts
    compiles: Callable[["Deployment"], bool] | None = None  # its first start takes minutes
    stop_last: bool = False  # the others need it in order to end well
    stops: bool = False  # carries commands and stops: gets a higher priority where permitted
    repeats: bool = False  # can be replayed, so it publishes which input it used
    looks_on: bool = False  # not needed by the robot: naps, and runs at low priority
    roles: tuple[Role, ...] = ("robot", "operator")  # identities with which a host may run it

    def node(self, settings: Mapping[str, Any]) -> Node:
        """Return the process's node with its settings filled in. Raises ValidationError."""
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


def run(
    config: ProcessConfig, type_of: Callable[[str], ProcessType], make_bus: MakeBus = Bus
) -> int:
    """Run one process until it ends, and return its exit code.

    `type_of` returns the row of a process, by name.
    """
    gc.disable()  # until ready: objects from imports and set-up are not garbage
    try:
        run_dir = Path(config.run_dir) if config.run_dir else None
        logs.setup(config.name, run_dir, json_console=config.json_console, level=config.level)
        process_type = type_of(config.name)
        node = process_type.node(config.settings)
        if process_type.stops:
            go_first()  # like the other branches, before any thread starts: threads inherit it
        elif process_type.looks_on:
            step_aside()
        else:
            start_first()
        with (
            interrupts.reacting(None),  # before `stop_signals` there is nothing to stop
            asyncio.Runner(loop_factory=loop_factory()) as runner,
        ):
            runner.run(_run(config, process_type, node, make_bus))
    except GigabrainError as error:
        invalid = {"value": error.value} if isinstance(error, ConfigError) and error.value else {}
        log.error("%s", error, extra={"data": {"event": "failed"} | invalid})
        return error.exit_code
    except Exception as error:
        first = _first(error)
        log.critical("died of %s: %s", type(first).__name__, first, exc_info=True)
        return 1
    finally:
        logs.flush()
        gc.enable()
    return 0


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
        handler = logs.BusHandler(functools.partial(bus.publish, LOG), config.name)
        logging.getLogger().addHandler(handler)
        if process_type.repeats:
            publish = functools.partial(bus.publish, INPUT_LOG, name=config.name)
            bus.input_log = PublishedInputLogger(publish, bus.clock.unix_ns)
        try:
            claim = NameClaim(bus)
            await claim.acquire()
            serve_params(bus)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(publish_health(bus))
                tasks.create_task(claim.settle())
                if config.json_console:
                    out = os.dup(STDOUT)  # the router redirects its standard output to Zenoh's log
                    tasks.create_task(beat(bus.clock, lambda: bus.progress(), out))
                tasks.create_task(_failure(bus))
                tasks.create_task(_node(bus, node, process_type))
        except* GigabrainError as group:
            raise group.exceptions[0] from None
        finally:
            logging.getLogger().removeHandler(handler)
            bus.input_log.flush()


async def _failure(bus: Bus) -> None:
    """Raise the exception of a message handler, even while the node waits for something else."""
    await bus.failed


async def _node(bus: Bus, node: Node, process_type: ProcessType) -> None:
    await node(bus, functools.partial(_ready, process_type))


def _ready(process_type: ProcessType) -> None:
    if not process_type.stops:
        join_in()
    gc.collect()
    gc.freeze()  # objects from set-up stay; later collections check new objects only
    gc.enable()
    log.info("ready", extra={"data": {"event": "ready", "pid": os.getpid()}})
