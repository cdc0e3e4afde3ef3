"""Records a short drive in each world, and one with a map, for the tests' process replay.

After an intended change, run `python -m gigabrain_zenoh.qa.drives FOLDER`.
"""

import asyncio
import sys
from pathlib import Path

from msgspec import Struct

import gigabrain_zenoh.recording.arithmetic  # noqa: F401  must precede numpy
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig, RecorderConfig
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.launch.demo import Demo, DemoOptions
from gigabrain_zenoh.launch.deployment import ROBOT, Deployment
from gigabrain_zenoh.launch.processes import node_of
from gigabrain_zenoh.recording.process_replay import OUTPUTS, replay_process, settings_for

AVOID_TOPICS = ("state", "body", "scan", "world", "intent", "cmd_vel", "safety")
NAVIGATE_TOPICS = (*AVOID_TOPICS, "pose", "map", "task", "request_log", "input_log")
ATTEMPTS = 5


class RecordedDrive(Struct, frozen=True):
    """World, duration and topics of a recorded drive."""

    world: str
    seed: int
    seconds: float = 3.2
    topics: tuple[str, ...] = AVOID_TOPICS
    perception: PerceptionConfig = PerceptionConfig()
    decision: DecisionConfig = DecisionConfig()


EXPLORES = RecordedDrive(
    "house", 1, 3.2, NAVIGATE_TOPICS,
    PerceptionConfig(mapping="slam"),
    DecisionConfig(behaviour="navigate", settings={"start": "explore"}),
)  # fmt: skip
DRIVES = {  # in each of the first four, the robot meets an obstacle
    "arena": RecordedDrive("arena", 10),
    "house": RecordedDrive("house", 1),
    "warehouse": RecordedDrive("warehouse", 10),
    "random_1": RecordedDrive("random:1", 6),
    "exploring": EXPLORES,
}


def file_of(folder: Path, name: str) -> Path:
    """Return the path of a recorded drive."""
    return folder / f"{name}.mcap"


def record(drive: RecordedDrive, to: Path) -> int:
    """Drive at twice real time, and record the brain's messages; return the exit code."""
    file = str(to.absolute())
    recorder = RecorderConfig(file=file, topics=drive.topics, viewers=False, flush_s=10.0)
    deployment = Deployment(
        world=drive.world,
        seed=drive.seed,
        speed=2.0,
        resume="auto",
        router="tcp/127.0.0.1:0",
        hosts={"robot": (*ROBOT, "recorder", "page", "foxglove")},
        recorder=recorder,
        perception=drive.perception,
        decision=drive.decision,
    )
    return asyncio.run(Demo(deployment, DemoOptions(seconds=drive.seconds, headless=True)).run())


def repeats(path: Path) -> bool:
    """Return whether a replay gives the same outputs; a busy machine may skip ticks."""
    replays = (replay_process(path, p, settings_for(path, p, None), node_of) for p in OUTPUTS)
    return all(asyncio.run(replayed).same for replayed in replays)


def renew(folder: Path, name: str) -> None:
    """Record one drive again. Raises GigabrainError if no attempt can be replayed."""
    fresh = file_of(folder, name).with_suffix(".new")
    for _ in range(ATTEMPTS):
        fresh.unlink(missing_ok=True)
        if record(DRIVES[name], fresh) == 0 and repeats(fresh):
            fresh.replace(file_of(folder, name))
            return
    raise GigabrainError(f"{name}: none of {ATTEMPTS} drives can be replayed")


def main(folder: Path) -> int:
    """Record all drives again; return the exit code."""
    for name in DRIVES:
        renew(folder, name)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
