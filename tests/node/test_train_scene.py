"""Rendered pictures of the training sets, and their labels."""

from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.train import pictures
from gigabrain_zenoh.qa.train.scene import SPLITS, StudioScene
from gigabrain_zenoh.qa.train.studio import RGB, Studio
from gigabrain_zenoh.vision.labels import CLASSES


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    try:
        made = Studio(np.random.default_rng(5), SPLITS["train"].families, 0)
    except ConfigError as error:
        pytest.skip(str(error))
    yield made
    made.close()


def place_thing(studio: Studio, label: str, x: float, y: float) -> int:
    """Move the first thing of a class to (x, y); return its number."""
    number = next(n for n, thing in enumerate(studio.things) if thing.look.label == label)
    studio.data.mocap_pos[studio.things[number].mocap] = (x, y, 0)
    return number


def look_ahead(studio: Studio) -> None:
    """Put the camera at the origin, 0.2 m high, looking along x."""
    studio.model.cam_pos[0], studio.model.cam_fovy[0] = (0, 0, 0.2), 45
    studio.model.cam_quat[0] = (0.5, 0.5, -0.5, -0.5)
    mujoco.mj_kinematics(studio.model, studio.data)
    mujoco.mj_camlight(studio.model, studio.data)


def test_a_thing_farther_left_is_farther_left_in_the_picture(studio: Studio) -> None:
    left, right = place_thing(studio, "ball", 2, 0.5), place_thing(studio, "cube", 2, -0.5)
    look_ahead(studio)
    studio.show([studio.things[left], studio.things[right]])
    owners = studio.owners()
    columns = {n: np.flatnonzero((owners == n).any(axis=0)) for n in (left, right)}
    assert columns[left].max() < 160 < columns[right].min()


def test_a_thing_behind_another_is_partly_hidden(studio: Studio) -> None:
    front, back = place_thing(studio, "robot", 1.0, 0.0), place_thing(studio, "charger", 1.6, 0.2)
    look_ahead(studio)
    studio.show([studio.things[front], studio.things[back]])
    seen = int((studio.owners() == back).sum())
    studio.show([studio.things[back]], room=False, labelled=True)
    assert 0 < seen < int((studio.owners() == back).sum())


def test_plain_paint_has_no_texture(studio: Studio) -> None:
    number = place_thing(studio, "cube", 1.0, 0.0)
    look_ahead(studio)
    thing = studio.things[number]
    studio.show([thing], room=False)
    kinds = []
    for texture in (-1, studio.cube_textures[0]):
        for material in thing.paints.values():
            studio.model.mat_texid[material, RGB] = texture
        seen = studio.owners() == number
        kinds.append(len(np.unique(studio.picture()[seen], axis=0)))
    assert kinds[0] < 10 < kinds[1]


def test_the_label_of_a_door_excludes_its_wall(studio: Studio) -> None:
    door = place_thing(studio, "door", 3.0, 0.0)
    thing = studio.things[door]
    look_ahead(studio)
    studio.show([thing])
    assert len(thing.labelled) < len(thing.geoms)
    assert (studio.owners() == door).any(axis=0).sum() < 160


def test_scenes_have_labelled_things_with_boxes_inside_the_picture(studio: Studio) -> None:
    rng = np.random.default_rng(8)
    counted = 0
    for _ in range(6):
        scene = StudioScene(studio, SPLITS["train"], rng)
        scene.draw()
        picture, truths = scene.render()
        assert picture.shape == (240, 320, 3)
        assert picture.std() > 5
        for truth in truths:
            x0, y0, x1, y1 = truth.box
            assert 0 <= x0 < x1 <= 320
            assert 0 <= y0 < y1 <= 240
            assert 0 < truth.fraction <= 1
            counted += not truth.ignored
    assert counted >= 6


def test_a_picture_set_is_repeatable_and_not_rendered_twice(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    try:
        for folder in (first, second):
            folder.mkdir()
            pictures.render_studio("other", 3, folder, 4)
    except ConfigError as error:
        pytest.skip(str(error))
    (path,) = first.iterdir()
    ones, others = (list(pictures.read(sorted(folder.iterdir()))) for folder in (first, second))
    assert [one.jpeg for one in ones] == [other.jpeg for other in others]
    assert len(ones) == 4
    assert sum(len(one.labels) for one in ones) > 0
    assert all(0 <= label < len(CLASSES) for one in ones for label in one.labels)
    path.write_bytes(b"kept")
    assert pictures.render_studio("other", 3, first, 4).read_bytes() == b"kept"
