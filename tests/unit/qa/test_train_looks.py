"""Looks for training: classes differ in every draw, and the textures of tests are separate."""

import numpy as np
import pytest

from gigabrain_zenoh.qa.train import distractors, textures
from gigabrain_zenoh.qa.train.looks import MAKERS, box, can, cube, cylinder

DRAWS = range(50)


@pytest.mark.parametrize("wide", [0, 1])
@pytest.mark.parametrize("label", MAKERS)
def test_each_look_has_its_label_and_stands_on_the_floor(label, wide):
    for seed in DRAWS:
        for maker in MAKERS[label]:
            look = maker(np.random.default_rng(seed), wide)
            assert look.label == label
            assert min(part.at[2] for part in look.parts) >= 0
            assert any(part.labelled for part in look.parts)


@pytest.mark.parametrize("wide", [0, 1])
def test_a_box_is_never_as_high_as_wide(wide):
    for seed in DRAWS:
        x, y, z = box(np.random.default_rng(seed), wide).parts[0].size
        assert z < 0.85 * min(x, y) or z > 1.15 * max(x, y)


def test_a_box_in_training_is_clearly_not_a_cube():
    for seed in DRAWS:
        x, y, z = box(np.random.default_rng(seed), 0).parts[0].size
        assert z <= 0.62 * min(x, y) or z >= 1.6 * max(x, y)


def test_a_cube_has_equal_edges_and_one_paint():
    look = cube(np.random.default_rng(1), 0)
    assert len(look.parts) == 1
    assert len(set(look.parts[0].size)) == 1


def test_a_can_has_metal_rims_and_a_cylinder_has_none():
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        assert any(part.fixed for part in can(rng, 0).parts)
        assert not any(part.fixed for part in cylinder(rng, 0).parts)


def test_other_proportions_are_beyond_those_of_training():
    for seed in DRAWS:
        edge = cube(np.random.default_rng(seed), 1).parts[0].size[0]
        assert edge <= 0.03 or edge >= 0.12


def test_distractors_have_no_label():
    assert all(not look.label for look in distractors.draw_all(np.random.default_rng(1)))
    assert sum(map(distractors.is_table, distractors.draw_all(np.random.default_rng(1)))) == 2


def test_patterned_textures_of_tests_are_not_used_in_training():
    assert set(textures.TRAIN) & set(textures.TEST) == {textures.plain}


@pytest.mark.parametrize("family", dict.fromkeys((*textures.TRAIN, *textures.TEST)))
def test_a_texture_is_a_share_of_two_colours(family):
    share = family(np.random.default_rng(2), 48)
    assert share.shape == (48, 48)
    assert share.dtype == np.float32
    assert 0 <= share.min() <= share.max() <= 1.001
