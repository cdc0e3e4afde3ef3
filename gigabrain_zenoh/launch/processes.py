"""The processes of a robot, and how one of them is run.

A supervisor starts each as `python -m gigabrain_zenoh.launch.processes CONFIG`, with a
ProcessConfig in JSON.
"""

import os
import sys

import msgspec

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.renames import renamed_settings
from gigabrain_zenoh.config.settings import ProcessConfig
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.signals import interrupts
from gigabrain_zenoh.runtime import process
from gigabrain_zenoh.runtime.process import MakeBus, Node, ProcessType

PROCESSES = {
    "router": ProcessType(
        "gigabrain_zenoh.runtime.router:run",
        "gigabrain_zenoh.config.settings:RouterConfig",
        stops=True,
    ),
    "relay": ProcessType(
        "gigabrain_zenoh.runtime.router:run_relay",
        "gigabrain_zenoh.config.settings:RelayConfig",
        stops=True,
    ),
    "driver": ProcessType(
        "gigabrain_drivers.driver.process:run",
        "gigabrain_zenoh.config.settings:DriverConfig",
        stops=True,
    ),
    "emulator": ProcessType(
        "gigabrain_drivers.emulators.process:run",
        "gigabrain_zenoh.config.settings:EmulatorConfig",
        stops=True,
    ),
    "button": ProcessType(
        "gigabrain_drivers.driver.button:run",
        "gigabrain_zenoh.config.settings:ButtonConfig",
        stops=True,
    ),
    "perception": ProcessType(
        "gigabrain_zenoh.perception.node:run",
        "gigabrain_zenoh.config.settings:PerceptionConfig",
        repeats=True,
    ),
    "decision": ProcessType(
        "gigabrain_zenoh.decision.node:run",
        "gigabrain_zenoh.config.settings:DecisionConfig",
        repeats=True,
    ),
    "control": ProcessType("gigabrain_zenoh.control.node:run", stops=True, repeats=True),
    "safety": ProcessType("gigabrain_zenoh.safety.node:run", stops=True, repeats=True),
    "recorder": ProcessType(
        "gigabrain_zenoh.recording.node:run",
        "gigabrain_zenoh.config.settings:RecorderConfig",
        looks_on=True,
    ),
    "page": ProcessType(
        "gigabrain_zenoh.ui.page.node:run",
        "gigabrain_zenoh.config.settings:PageConfig",
        looks_on=True,
    ),
    "foxglove": ProcessType(
        "gigabrain_zenoh.ui.foxglove.node:run",
        "gigabrain_zenoh.config.settings:FoxgloveConfig",
        looks_on=True,
    ),
}


def node_of(config: ProcessConfig) -> Node:
    """Return the node of a process with its settings filled in. Raises ValidationError."""
    return PROCESSES[config.name].node(renamed_settings(config.settings, config.name))


def run_process(config: ProcessConfig, make_bus: MakeBus = Bus) -> int:
    """Run one process until it ends, and return its exit code."""
    return process.run(config, PROCESSES, make_bus)


def main() -> None:
    """Run a supervised process, configured by its first argument, and exit."""
    this_process.die_with_supervisor()
    this_process.map_large_blocks()
    interrupts.install()
    code = run_process(msgspec.json.decode(sys.argv[1], type=ProcessConfig))
    sys.stdout.flush()
    os._exit(code)  # Zenoh's threads must not keep a finished process alive


if __name__ == "__main__":
    main()
