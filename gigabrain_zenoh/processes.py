"""The processes of a robot, and how one of them is run.

A supervisor starts each as `python -m gigabrain_zenoh.processes CONFIG`, with a ProcessConfig in
JSON.
"""

import os
import sys

import msgspec

from gigabrain_zenoh import heap, lifeline, process
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.interrupts import interrupts
from gigabrain_zenoh.process import MakeBus, Node, ProcessType
from gigabrain_zenoh.process_config import ProcessConfig

PROCESSES = {
    "router": ProcessType(
        "gigabrain_zenoh.router:run", "gigabrain_zenoh.settings:RouterConfig", stops=True
    ),
    "relay": ProcessType(
        "gigabrain_zenoh.relay:run", "gigabrain_zenoh.settings:RelayConfig", stops=True
    ),
    "driver": ProcessType(
        "gigabrain_drivers.process:run", "gigabrain_zenoh.settings:DriverConfig", stops=True
    ),
    "emulator": ProcessType(
        "gigabrain_drivers.emulators.process:run",
        "gigabrain_zenoh.settings:EmulatorConfig",
        stops=True,
    ),
    "button": ProcessType(
        "gigabrain_drivers.button:run", "gigabrain_zenoh.settings:ButtonConfig", stops=True
    ),
    "perception": ProcessType(
        "gigabrain_zenoh.perception:run", "gigabrain_zenoh.settings:PerceptionConfig", repeats=True
    ),
    "decision": ProcessType(
        "gigabrain_zenoh.decision:run", "gigabrain_zenoh.settings:DecisionConfig", repeats=True
    ),
    "control": ProcessType("gigabrain_zenoh.control:run", stops=True, repeats=True),
    "safety": ProcessType("gigabrain_zenoh.safety.node:run", stops=True, repeats=True),
    "recorder": ProcessType(
        "gigabrain_zenoh.recording.node:run",
        "gigabrain_zenoh.settings:RecorderConfig",
        looks_on=True,
    ),
    "page": ProcessType(
        "gigabrain_zenoh.page.node:run", "gigabrain_zenoh.settings:PageConfig", looks_on=True
    ),
    "foxglove": ProcessType(
        "gigabrain_zenoh.foxglove_bridge.node:run",
        "gigabrain_zenoh.settings:FoxgloveConfig",
        looks_on=True,
    ),
}


def node_of(config: ProcessConfig) -> Node:
    """Return the node of a process with its settings filled in. Raises ValidationError."""
    return PROCESSES[config.name].node(config.settings)


def run_process(config: ProcessConfig, make_bus: MakeBus = Bus) -> int:
    """Run one process until it ends, and return its exit code."""
    return process.run(config, PROCESSES, make_bus)


def main() -> None:
    """Run a supervised process, configured by its first argument, and exit."""
    lifeline.die_with_supervisor()
    heap.map_large_blocks()
    interrupts.install()
    code = run_process(msgspec.json.decode(sys.argv[1], type=ProcessConfig))
    sys.stdout.flush()
    os._exit(code)  # Zenoh's threads must not keep a finished process alive


if __name__ == "__main__":
    main()
