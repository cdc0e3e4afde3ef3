"""Commands of the training program: `python -m gigabrain_zenoh.qa.train COMMAND`.

all: render, learn, export, score: what made the shipped net.
"""

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import cyclopts

from gigabrain_zenoh.vision.recognizer import WEIGHTS

os.environ.setdefault("MUJOCO_GL", "egl")
app = cyclopts.App(name="python -m gigabrain_zenoh.qa.train", help="Train the shipped recogniser.")
TRAIN_PICTURES, TEST_PICTURES, STEPS = 12_000, 1_200, 8_000
FOLDER = Path("things")


@dataclass(frozen=True)
class Plan:
    """How much is rendered and learned, and where it is kept."""

    folder: Path = FOLDER
    pictures: int = TRAIN_PICTURES
    tests: int = TEST_PICTURES
    steps: int = STEPS
    processes: int = 2


@app.command
def render(plan: Plan = Plan()) -> None:
    """Render the sets: train, test, and other (proportions beyond those of training)."""
    from gigabrain_zenoh.qa.train import pictures

    for split, count in (("test", plan.tests), ("other", plan.tests), ("train", plan.pictures)):
        paths = pictures.render(split, count, plan.folder, plan.processes)
        print(f"{split}: {len(paths) * pictures.PER_STUDIO} pictures in {plan.folder}")


@app.command
def learn(plan: Plan = Plan(), *, seed: int = 0, weights: Path = WEIGHTS) -> None:
    """Train on the rendered set, go on from a checkpoint, and export to `weights`."""
    from gigabrain_zenoh.qa.train import learning, pictures
    from gigabrain_zenoh.qa.train.export import export

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    files = sorted(plan.folder.glob("train-*.npz"))[: plan.pictures // pictures.PER_STUDIO]
    state = learning.learn(list(pictures.read(files)), plan.steps, plan.folder, seed)
    export(state.averaged, state.moments, weights)


@app.command
def score(plan: Plan = Plan(), *, weights: Path = WEIGHTS) -> None:
    """Print the average precision of each class on both test sets."""
    from gigabrain_zenoh.qa.train import pictures, scores

    columns = {}
    for split in ("test", "other"):
        labelled = list(pictures.read(sorted(plan.folder.glob(f"{split}-*.npz"))))
        guesses, truths = scores.run(labelled, weights)
        columns[split] = scores.table(guesses, truths)
        print(scores.describe(split, labelled))
    print(scores.text(columns))


@app.command(name="all")
def everything(plan: Plan = Plan(), *, seed: int = 0, weights: Path = WEIGHTS) -> None:
    """Render, learn, export, and score."""
    render(plan)
    learn(plan, seed=seed, weights=weights)
    score(plan, weights=weights)


if __name__ == "__main__":
    app()
