"""Builds the list of processes that a supervisor runs on one host, with each process's settings."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from gigabrain_zenoh.bus.zenoh.config import router_config
from gigabrain_zenoh.config.settings import (
    DriverConfig,
    EmulatorConfig,
    Endpoint,
    ProcessConfig,
    RecorderConfig,
)
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.runtime.deployment import (
    ALL,
    BUTTON,
    EMULATOR,
    RELAY,
    Deployment,
    behind,
    between,
    has_relay,
    local_endpoint,
    relay_config,
)
from gigabrain_zenoh.runtime.managed_process import ProcessSpec

# -P: a package in the current folder must not shadow an installed one
COMMAND = (sys.executable, "-P", "-m", "gigabrain_zenoh.launch.processes")
LATER_S, SOON_S = 3600.0, 30.0  # a router on another host may start later
COMPILING_S = 600.0  # mapping and navigation compile their kernels at the first start


def process_specs(
    deployment: Deployment,
    host: str,
    run_dir: Path,
    state_dir: Path,
    *,
    seconds: float | None = None,
    level: str = "info",
) -> list[ProcessSpec]:
    """Build the specs of the processes of `host`, in readiness order: the router or relay first."""
    names = _names(deployment, host)
    settings = dict(_settings(deployment, run_dir, state_dir, seconds))
    specs = []
    for name in names:
        endpoint, more = _place(deployment, host, name, names, state_dir)
        process = ProcessConfig(
            name=name,
            endpoint=endpoint,
            settings=settings.get(name, {}) | more,
            run_dir=str(run_dir),
            json_console=True,
            level=level,
        )
        after = _after(deployment, name, names)
        specs.append(
            ProcessSpec(
                name=name,
                argv=(*COMMAND, msgspec.json.encode(process).decode()),
                after=after,
                beats=True,
                stop_last=name in ("router", RELAY, EMULATOR),
                ready_timeout_s=_patience_s(deployment, name) if after else LATER_S,
            )
        )
    return specs


def _patience_s(deployment: Deployment, name: str) -> float:
    """Return how long a process may take until it is ready [s]."""
    maps = name == "perception" and deployment.perception.mapping != "off"
    navigates = name == "decision" and behaviours.needs_map(deployment.decision.behaviour)
    return COMPILING_S if maps or navigates else SOON_S


def _names(deployment: Deployment, host: str) -> list[str]:
    """Return the processes of `host`, including those that deployment files need not name."""
    names: list[str] = sorted(deployment.hosts[host], key=(*ALL, BUTTON).index)
    placed = any(BUTTON in others for others in deployment.hosts.values())
    if deployment.button and "driver" in names and not placed:
        names.append(BUTTON)
    if deployment.link == "emulated" and "driver" in names:
        names.insert(names.index("driver"), EMULATOR)
    if has_relay(names):
        names.insert(0, RELAY)
    return names


def _place(
    deployment: Deployment, host: str, name: str, names: list[str], state_dir: Path
) -> tuple[Endpoint, dict[str, Any]]:
    """Return a process's endpoint, and the settings of a router or relay that depend on it."""
    endpoint = local_endpoint(deployment, host)
    if name == "router":
        door = msgspec.structs.replace(
            endpoint, listen=endpoint.connect[::-1], connect=(), fleet=deployment.fleet
        )
        return door, msgspec.to_builtins(router_config(door, state_dir))
    if name == RELAY:
        return between(endpoint), msgspec.to_builtins(relay_config(endpoint))
    return (behind(endpoint) if RELAY in names else endpoint), {}


def _after(deployment: Deployment, name: str, names: list[str]) -> tuple[str, ...]:
    """Return the processes that must be ready before this one starts."""
    first: tuple[str, ...] = ("router", EMULATOR) if name == "driver" else ("router", RELAY)
    if name == "driver" and deployment.recorder.file:  # to record the driver from its first tick
        first = (*first, "recorder")
    return tuple(other for other in first if other in names and other != name)


def _settings(
    deployment: Deployment, run_dir: Path, state_dir: Path, seconds: float | None
) -> Mapping[str, dict[str, Any]]:
    ports = str(run_dir / "ports") if deployment.link == "emulated" else ""
    driver = DriverConfig(
        body=deployment.body,
        link=deployment.link,
        world=deployment.world,
        seed=deployment.seed,
        speed=deployment.speed,
        lockstep_timeout_s=deployment.lockstep_timeout_s,
        seconds=seconds,
        resume=deployment.resume,
        state_dir=str(state_dir),
        emulator=ports,
        button=deployment.button is not None,
    )
    emulator = EmulatorConfig(
        body=deployment.body, world=deployment.world, seed=deployment.seed, folder=ports
    )
    return {
        "driver": msgspec.to_builtins(driver),
        EMULATOR: msgspec.to_builtins(emulator),
        BUTTON: msgspec.to_builtins(deployment.button) if deployment.button else {},
        "perception": msgspec.to_builtins(deployment.perception) | {"state_dir": str(state_dir)},
        "decision": msgspec.to_builtins(deployment.decision) | {"state_dir": str(state_dir)},
        "recorder": msgspec.to_builtins(with_notes(deployment)),
        "page": msgspec.to_builtins(deployment.page),
        "foxglove": msgspec.to_builtins(deployment.foxglove),
    }


def with_notes(deployment: Deployment) -> RecorderConfig:
    """Return the recorder's settings, with notes on the other processes that a replay needs."""
    about = {"perception": deployment.perception, "decision": deployment.decision}
    notes = {name: msgspec.json.encode(settings).decode() for name, settings in about.items()}
    plain = {"body": deployment.body, "link": deployment.link, "world": deployment.world}
    plain["speed"] = f"{deployment.speed:g}"
    return msgspec.structs.replace(
        deployment.recorder, notes=notes | plain | deployment.recorder.notes
    )
