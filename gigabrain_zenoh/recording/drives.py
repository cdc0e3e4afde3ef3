"""A short drive in each world, for the process replay in the tests.

`python -m gigabrain_zenoh.recording.drives FOLDER` records them anew after a change that is meant.
"""

import asyncio
import sys
from pathlib import Path

from gigabrain_zenoh.demo import Demo, DemoOptions
from gigabrain_zenoh.deployment import ALL, Deployment
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.recording.process_replay import SAYS, replay_process, settings_for
from gigabrain_zenoh.settings import RecorderConfig

# world and seed: each of these drives meets something to turn away from
DRIVES = {"arena": 10, "house": 1, "warehouse": 10, "random:1": 6}
SECONDS = 3.2
ATTEMPTS = 5
TOPICS = ("state", "body", "scan", "world", "intent", "cmd_vel", "safety")


def file_of(folder: Path, world: str) -> Path:
    """Where the drive in `world` is kept."""
    return folder / f"{world.replace(':', '_')}.mcap"


def record(world: str, to: Path) -> int:
    """Drive, faster than in real time, and record what the brain hears and says; the exit code."""
    recorder = RecorderConfig(file=str(to.absolute()), topics=TOPICS, viewers=False, flush_s=10.0)
    deployment = Deployment(
        world=world,
        seed=DRIVES[world],
        speed=2.0,
        resume="auto",
        router="tcp/127.0.0.1:0",
        hosts={"robot": ALL},
        recorder=recorder,
    )
    return asyncio.run(Demo(deployment, DemoOptions(seconds=SECONDS, headless=True)).run())


def repeats(path: Path) -> bool:
    """Whether every process does the same again: no tick was given up on a busy machine."""
    outcomes = (asyncio.run(replay_process(path, p, settings_for(path, p, None))) for p in SAYS)
    return all(outcome.same for outcome in outcomes)


def renew(folder: Path, world: str) -> None:
    """Record one drive anew. Raises GigabrainError when it never went well."""
    fresh = file_of(folder, world).with_suffix(".new")
    for _ in range(ATTEMPTS):
        fresh.unlink(missing_ok=True)
        if record(world, fresh) == 0 and repeats(fresh):
            fresh.replace(file_of(folder, world))
            return
    raise GigabrainError(f"{world}: none of {ATTEMPTS} drives can be repeated")


def main(folder: Path) -> int:
    """Record all of them anew; the exit code."""
    for world in DRIVES:
        renew(folder, world)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
