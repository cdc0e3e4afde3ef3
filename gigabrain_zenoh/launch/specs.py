"""Builds the list of processes that a supervisor runs on one host, with each process's settings."""

import sys
from pathlib import Path
from typing import Any

import msgspec
from msgspec import structs

from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.launch.deployment import Deployment, local_endpoint
from gigabrain_zenoh.launch.own_processes import own_config
from gigabrain_zenoh.launch.process import ProcessPlace, ProcessType
from gigabrain_zenoh.launch.processes import (
    deployed_type,
    grants,
    names_by_role,
    process_types,
)
from gigabrain_zenoh.runtime.fork_server import ForkRequest
from gigabrain_zenoh.runtime.managed_process import ProcessSpec
from gigabrain_zenoh.runtime.running import local_socket

# -P: a package in the current folder must not shadow an installed one
COMMAND = (sys.executable, "-P", "-m", "gigabrain_zenoh.launch.processes")
SHARED, KERNELS = "gigabrain_zenoh.launch.shared", "gigabrain_zenoh.kernels.shared"
FORKED = "gigabrain_zenoh.launch.processes:run_supervised"
READY_TIMEOUT_S = 30.0
ROUTER_TIMEOUT_S = 3600.0  # a router on another host may start later
COMPILE_TIMEOUT_S = 600.0  # mapping and navigation compile their kernels at the first start


def process_specs(
    deployment: Deployment,
    host: str,
    run_dir: Path,
    state_dir: Path,
    *,
    seconds: float | None = None,
    level: str = "info",
    file: str = "",
) -> list[ProcessSpec]:
    """Build the specs of the processes of `host`, in the order of their starts: the router first.

    `file` is the deployment file, for errors of the user's own processes.
    """
    names = _names(deployment, host)
    specs = []
    for name in names:
        row, after = deployed_type(deployment, name), _after(deployment, name, names)
        place = ProcessPlace(_endpoint(deployment, host, name, names), run_dir, state_dir, seconds)
        process = ProcessConfig(
            name=name,
            endpoint=place.endpoint,
            settings=_settings(deployment, name, row, place),
            run_dir=str(run_dir),
            json_console=True,
            level=level,
        )
        process = structs.replace(process, **own_config(deployment, name, file))
        compiles = row.compiles is not None and row.compiles(deployment)
        config = msgspec.json.encode(process).decode()
        about = msgspec.json.encode({"name": name, "run_dir": process.run_dir}).decode()
        specs.append(
            ProcessSpec(
                name=name,
                argv=(*COMMAND, about),
                config=config,
                fork=_fork(row, config, about, compiles=compiles),
                after=after,
                beats=True,
                shows_stack=True,
                stop_last=row.stop_last,
                optional=row.own or row.optional,
                ready_timeout_s=(COMPILE_TIMEOUT_S if compiles else READY_TIMEOUT_S)
                if after
                else ROUTER_TIMEOUT_S,
            )
        )
    return specs


def _fork(row: ProcessType, config: str, about: str, *, compiles: bool) -> ForkRequest | None:
    """Return the request to fork a process; None if a fork server may not start it."""
    if not row.forks:
        return None
    modules = SHARED, row.run.partition(":")[0]
    return ForkRequest(
        run=FORKED,
        argument=config,
        title=f"{FORKED} {about}",
        imports=(modules, (KERNELS,)) if compiles else (modules,),
    )


def _names(deployment: Deployment, host: str) -> list[str]:
    """Return the processes of `host`, including those that join without being named."""
    here, types = set(deployment.hosts[host]), process_types()
    joining = {name for name, row in types.items() if row.joins and row.joins(deployment, here)}
    order = list(types)
    own = [name for name in deployment.hosts[host] if name not in types]
    ours = (here | joining) - {*own}
    first = sorted(ours, key=lambda name: (not types[name].stop_last, order.index(name)))
    return [*first, *own]


def _endpoint(deployment: Deployment, host: str, name: str, names: list[str]) -> Endpoint:
    """Return a process's endpoint."""
    endpoint = local_endpoint(deployment, host)
    if name == "router":
        return structs.replace(
            endpoint,
            listen=endpoint.connect[::-1],
            connect=(),
            fleet=deployment.fleet,
            names=names_by_role() if endpoint.keys else {},
            grants=grants(deployment),
        )
    if name == "relay":  # listens on the socket, and connects to the robot's router
        return structs.replace(endpoint, listen=(local_socket(),))
    if endpoint.keys and deployed_type(deployment, name).own:
        keys = Path(endpoint.keys) / name
        return structs.replace(endpoint, connect=endpoint.connect[-1:], keys=str(keys))
    if "relay" in names:  # a Unix socket that only this user can open
        return structs.replace(endpoint, connect=(local_socket(),), keys="")
    return endpoint


def _after(deployment: Deployment, name: str, names: list[str]) -> tuple[str, ...]:
    """Return the processes that must be ready before this one starts."""
    first = deployed_type(deployment, name).after
    if name == "driver" and deployment.recorder.file:  # records the driver's first tick as well
        first = (*first, "recorder")
    return tuple(other for other in first if other in names and other != name)


def _settings(
    deployment: Deployment, name: str, row: ProcessType, place: ProcessPlace
) -> dict[str, Any]:
    part = row.derive(deployment, place) if row.derive else deployment.settings(name)
    settings: dict[str, Any] = msgspec.to_builtins(part)
    if "state_dir" in settings:
        settings["state_dir"] = str(place.state_dir)
    if deployment.speed != 1.0 and "compile_first" in settings:  # time waits in lock-step
        settings["compile_first"] = True
    return settings
