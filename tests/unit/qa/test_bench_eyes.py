"""The benchmark of eyes: its worlds, its judgement, and its table."""

import math

import numpy as np
import pytest
from rich.console import Console

from gigabrain_drivers.cameras.depth_noise import NO_ERRORS
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_schemas.base import Pose
from gigabrain_zenoh.cli.bench_eyes import _eyes_table, eyes
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.polygon import area
from gigabrain_zenoh.qa.bench import eyes as bench
from gigabrain_zenoh.qa.bench.eyes_worlds import (
    EyesWorld,
    Part,
    Renderer,
    bodies,
    distances,
    draw_world,
)

STILL = Pose(x=0.0, y=0.0, yaw=0.0)


@pytest.fixture
def _graphics() -> None:
    try:
        open_graphics(16, 16).free()
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.mark.long
def test_worlds_repeat_and_differ_by_seed() -> None:
    assert draw_world(3) == draw_world(3)
    assert len({draw_world(seed) for seed in range(20)}) == 20


@pytest.mark.long
def test_things_stand_apart_from_each_other_and_from_the_robot() -> None:
    for seed in range(30):
        world = draw_world(seed)
        for one in world.parts:
            others = [part.outline for part in world.parts if part.thing != one.thing]
            others += [world.pit.outline] if world.pit else []
            assert distances(others, one.outline).min() > 0.05
            assert distances([one.outline], np.zeros((1, 2)))[0] > 0.2


def test_the_width_is_measured_across_the_line_of_sight() -> None:
    along = np.column_stack((np.linspace(1, 2, 9), np.linspace(1, 2, 9), np.zeros(9)))
    assert bench._width(along, STILL) == pytest.approx(0.0, abs=1e-9)
    assert bench._width(along, Pose(x=3.0, y=0.0, yaw=1.0)) == pytest.approx(math.sqrt(2))


def test_outlines_are_counter_clockwise_and_of_the_right_size() -> None:
    box = Part(0, 1.0, 2.0, 0.3, 0.1, 0.5, yaw=0.7)
    assert area(box.outline) == pytest.approx(0.12)
    assert distances([box.outline], np.array([[1.0, 2.0], [1.0, 3.0]]))[0] == 0.0
    post = Part(0, 1.0, 2.0, 0.1, 0.1, 0.5, round=True)
    assert area(post.outline) == pytest.approx(math.pi * 0.01, rel=0.02)


def test_a_ghost_is_timed_from_the_first_view_of_the_empty_place() -> None:
    for kind in bench.GHOST_KINDS:
        story = list(bench._ghost_story(kind, STILL))
        times = [now for now, *_ in story]
        assert times == pytest.approx([number / 10 for number in range(len(story))])
        counted = [since for *_, since in story if since is not None]
        assert counted[0] == 0.0
        assert counted[-1] == pytest.approx(2.9)


@pytest.mark.long
@pytest.mark.usefixtures("_graphics")
def test_the_renderer_shows_parts_at_their_depth() -> None:
    camera = bodies()[0].cameras[0]
    world = EyesWorld((Part(0, 1.5, 0.0, 0.1, 0.1, 0.3), Part(1, 2.5, -0.6, 0.1, 0.1, 0.3)))
    with Renderer(world, camera) as renderer:
        renderer.move(STILL, camera)
        assert renderer.depth()[120, 160] == pytest.approx(1.4 - camera.x, abs=1e-4)
        assert renderer.parts()[120, 160] == 0
        assert set(np.unique(renderer.parts())) == {-1, 0, 1}
        renderer.move(STILL, camera, (0.5, 0.0))
        assert renderer.depth()[120, 160] == pytest.approx(1.9 - camera.x, abs=1e-4)


@pytest.mark.qa
@pytest.mark.usefixtures("_graphics")
def test_a_small_run_prints_every_figure() -> None:
    result = bench.measure_eyes(bodies()[:1], 1, 0.1, 3, 4, lambda text: None)
    sensor, ideal = result.figures
    assert (sensor.sensor, ideal.sensor) == ("sensor", "no errors")
    assert 0.0 < ideal.error_p50_m <= ideal.error_p95_m < 0.03
    assert sensor.recall == ideal.recall == 1.0
    assert sensor.false_per_min == 0.0
    assert max(sensor.ghost_max_s, ideal.ghost_max_s) <= 0.5
    console = Console(width=140)
    with console.capture() as output:
        console.print(_eyes_table(result))
    assert "1 worlds from seed 4" in output.get()


@pytest.mark.long
@pytest.mark.usefixtures("_graphics")
def test_wrong_contours_count_as_wrong() -> None:
    body = bodies()[0]
    seen = bench.Eyes(body, NO_ERRORS, 0)
    thing, elsewhere = Part(0, 1.5, 0.0, 0.1, 0.1, 0.3), Part(0, 1.0, 0.4, 0.1, 0.1, 0.3)
    with Renderer(EyesWorld((thing,)), seen.camera) as renderer:
        for number in range(3):
            contours = seen.see(renderer, STILL, number / 10)
        right = bench._Truth(seen, renderer, EyesWorld((thing,)), STILL)
        wrong = bench._Truth(seen, renderer, EyesWorld((elsewhere,)), STILL)
    assert bench._found_things(right, contours) == [True]
    assert bench._found_things(right, ()) == [False]
    scores = bench.ClutterScores()
    bench._judge_outlines(right, contours, scores)
    assert scores.wrong == 0
    bench._judge_outlines(wrong, contours, scores)
    assert scores.wrong == 1
    assert max(scores.beyond) > 0.3


@pytest.mark.parametrize("wrong", [{"worlds": 0}, {"seconds": 0.0}, {"ghosts": -1}])
def test_wrong_options_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="--"):
        eyes(**wrong)
