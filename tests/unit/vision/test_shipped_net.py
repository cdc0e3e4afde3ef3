"""The net in the package: its size, and what it finds in pictures that it was not trained on."""

import numpy as np
import pytest

from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.train import pictures, scores
from gigabrain_zenoh.vision.recognizer import WEIGHTS

FRESH = 5000  # number of a studio beyond those of the test set


def test_it_has_at_most_400_000_parameters_of_four_bytes():
    assert 1_000_000 < WEIGHTS.stat().st_size < 4 * 400_000 + 20_000


@pytest.mark.slow
def test_it_finds_things_in_rooms_with_textures_and_lights_that_it_does_not_know(tmp_path):
    try:
        open_graphics(64, 64).free()
    except ConfigError as error:
        pytest.skip(str(error))
    paths = [pictures.render_studio("test", FRESH + n, tmp_path, 20) for n in range(4)]
    labelled = list(pictures.read(paths))
    guesses, truths = scores.run(labelled, WEIGHTS)
    precisions = [value for value in scores.table(guesses, truths).values() if not np.isnan(value)]
    assert len(precisions) >= 8
    assert np.mean(precisions) > 0.8
