"""Commands of the training program: `python -m gigabrain_zenoh.qa.train COMMAND`.

`all` renders, learns, exports and scores, as for the shipped net. `sheet` shows hits and misses.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import cyclopts

from gigabrain_zenoh.vision.recognizer import WEIGHTS

app = cyclopts.App(name="python -m gigabrain_zenoh.qa.train", help="Train the shipped recogniser.")
TRAIN_PICTURES, TEST_PICTURES, STEPS = 28_000, 1_040, 44_000
FOLDER = Path("things")


@cyclopts.Parameter(name="*")
@dataclass(frozen=True)
class Plan:
    """The amount of rendering and learning, and the folder for it."""

    folder: Path = FOLDER
    "Where the sets and the checkpoint are; what is there is not made again."
    pictures: int = TRAIN_PICTURES
    "Pictures to train on."
    tests: int = TEST_PICTURES
    "Pictures of each test set."
    steps: int = STEPS
    "Steps of training, of 16 pictures each (first 24 small ones)."
    processes: int = 2
    "Processes that render."


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


@app.command
def sheet(
    path: Path,
    plan: Plan = Plan(),
    *,
    weights: Path = WEIGHTS,
    count: int = 12,
    worst: bool = False,
) -> None:
    """Write a JPEG of test pictures with what was found; `worst` takes those with most mistakes."""
    import cv2

    from gigabrain_zenoh.qa.train import pictures, scores
    from gigabrain_zenoh.qa.train import sheet as sheets

    labelled = list(pictures.read(sorted(plan.folder.glob("test-*.npz"))))
    pairs = list(zip(labelled, scores.run(labelled, weights)[0], strict=True))
    if worst:
        pairs.sort(key=lambda pair: -sheets.mistakes(*pair))
    else:
        pairs = pairs[:: max(1, len(pairs) // count)]  # from many studios
    picture = sheets.sheet(*zip(*pairs[:count], strict=True))
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


@app.command(name="all")
def everything(plan: Plan = Plan(), *, seed: int = 0, weights: Path = WEIGHTS) -> None:
    """Render, learn, export, and score."""
    render(plan)
    learn(plan, seed=seed, weights=weights)
    score(plan, weights=weights)


if __name__ == "__main__":
    app()
