"""A user's own worlds: YAML, ROS maps and MJCF become geometry; invalid ones are refused."""

import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import sim_body
from gigabrain_drivers.sim.map_world import merge_cells
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.png import png, read_png
from gigabrain_drivers.sim.world import Box, Cylinder, Pose, clearance
from gigabrain_drivers.sim.world_file import WorldFile
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import load_deployment

ROOM = """
size: [6, 4]
start: [1, 0.5, 1.5]
walls:
  - from: [-3, 0]
    to: [3, 0]
    height: 1.0
    doors: [{at: 1.5, width: 1.0}, {at: 4.0, closed: true}]
boxes:
  - {at: [1, 1], size: [0.4, 0.2, 0.5], yaw: 0.5, material: wood}
  - {x: [2, 3], y: [-2, -1.5], z: [0.2, 0.8], material: mint}
cylinders:
  - {at: [-2, 1], radius: 0.2, height: 0.6}
materials: {mint: [0.6, 0.9, 0.7]}
people:
  - {path: [[-1, -1], [1, -1]], speed: 0.5}
  - {path: [[-1, -1.5], [1, -1.5]]}
"""
MODEL = """<mujoco><worldbody>
  <geom name="ground" type="plane" size="0 0 .1"/>
  <geom type="box" pos="0 2 .5" size="3 .1 .5"/>
  <geom type="box" pos="0 -2 .5" size="3 .1 .5"/>
  <geom type="box" pos="2.5 0 .5" size=".1 2 .5" euler="0 0 30"/>
  <body pos="1 1 .2"><freejoint/><geom type="box" size=".2 .2 .2" mass="2"/></body>
</worldbody></mujoco>"""


def write_file(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def simulated(world: str, seed: int = 0) -> Simulation:
    run = Run(folder=Path(), world=world, seed=seed)
    robot, driver = make_driver("turtlebot3_waffle", run)
    return Simulation(sim_body(robot, driver.options, driver.run), load_world(world, seed), seed)


def test_a_world_file_gives_walls_with_doors_boxes_and_persons(tmp_path: Path) -> None:
    world = load_world(write_file(tmp_path / "room.yaml", ROOM), 3)
    left, between, leaf, right, box, shelf, pillar = world.shapes
    assert isinstance(left, Box)
    assert (left.x, left.half_x, left.half_y, left.height) == (-2.5, 0.5, 0.05, 1.0)
    assert (between.x, right.x) == pytest.approx((-0.25, 2.25))
    assert isinstance(leaf, Box)
    assert (leaf.x, leaf.half_y, leaf.material) == (pytest.approx(1.0), 0.02, "wood")
    assert box == Box(1, 1, 0.2, 0.1, 0.5, "wood", 0.5)
    assert shelf == Box(2.5, -1.75, 0.5, 0.25, pytest.approx(0.6), "mint", 0, 0.2)
    assert pillar == Cylinder(-2, 1, 0.2, 0.6, "orange")
    assert (world.half_x, world.half_y, world.start) == (3.0, 2.0, Pose(1, 0.5, 1.5))
    assert [walk.speed for walk in world.people] == [0.5, 0.8]
    assert all(0 <= walk.start <= 4.0 for walk in world.people)


def test_a_slanted_wall_lies_between_its_ends(tmp_path: Path) -> None:
    text = "size: [9, 9]\nwalls:\n  - {from: [0, 0], to: [3, 4], thickness: 0.2}\n"
    (wall,) = load_world(write_file(tmp_path / "slant.yaml", text), 0).shapes
    assert wall.distance(1.5, 2.0) == 0.0
    assert wall.distance(3.4, 4.0) == pytest.approx(math.hypot(0.24, 0.22))
    assert wall.distance(0.8, -0.6) == pytest.approx(0.9)


def test_all_persons_of_a_world_file_walk(tmp_path: Path) -> None:
    simulation = simulated(write_file(tmp_path / "room.yaml", ROOM))
    before = [pose.pose for pose in simulation.people()]
    for _ in range(50):
        simulation.advance()
    moved = [
        math.hypot(a.x - b.pose.x, a.y - b.pose.y)
        for a, b in zip(before, simulation.people(), strict=True)
    ]
    assert moved == pytest.approx([0.25, 0.4])
    assert simulation.scan()[0] < 1.6


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("size: [6, 4]\nwalls:\n  - {from: [0, 0], to: [1e9, 0]}\n", r":3: walls\[0\].to\[0\]: "),
        ("size: [.nan, 4]\n", r":1: .nan is not allowed"),
        ("size: [6, 4]\nwals: []\n", r":2: unknown field 'wals'; did you mean 'walls'"),
        ("wall_height: 1\n", r":1: size: missing"),
        ("size: [6, 4]\nboxes:\n  - {at: [0, 0]}\n", r":3: boxes\[0\]: expected either `at`"),
        (
            "size: [6, 4]\nboxes:\n  - {at: [0, 0], size: [1, 1, 1], material: wod}\n",
            r":3: boxes\[0\]: no material 'wod'; did you mean 'wood'",
        ),
        (
            "size: [6, 4]\nwalls:\n  - from: [0, 0]\n    to: [2, 0]\n    doors:\n    - {at: 1.9}\n",
            r":6: walls\[0\].doors\[0\]: it ends at 2.4 m",
        ),
        ("size: [6, 4]\npeople:\n  - path: [[1, 1], [1, 1]]\n", r":3: people\[0\].path: 0 m round"),
        ("size: [6, 4]\nwall_height: 0\n", r":2: wall_height: expected a number >= 0.05"),
        ("size: [6, 4]\nmaterials: {floor: [0, 0, 0]}\n", r":2: materials: 'floor' is there"),
        ("size: [1, 1]\n", r"bad.yaml:1: found no place for the robot"),
        ("size: [6, 4]\nmap: none.yaml\n", r":2: map: .*none.yaml: no such file"),
        ("size: [6, 4]\nmodel: none.xml\n", r":2: model: .*none.xml: the world's model: no such"),
    ],
)
def test_a_bad_world_file_is_refused_in_one_line(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=complaint) as raised:
        load_world(write_file(tmp_path / "bad.yaml", text), 0)
    assert "\n" not in str(raised.value)


def test_a_start_within_a_box_is_refused(tmp_path: Path) -> None:
    text = "size: [6, 4]\nstart: [0, 0, 0]\nboxes:\n  - {at: [0, 0], size: [1, 1, 1]}\n"
    with pytest.raises(ConfigError, match=r"full.yaml:2: the robot touches something at its start"):
        simulated(write_file(tmp_path / "full.yaml", text))


@pytest.mark.parametrize("place", ["50, 0", "0, -2.1"])
def test_a_start_outside_the_walls_is_refused(place: str, tmp_path: Path) -> None:
    world = write_file(tmp_path / "small.yaml", f"size: [6, 4]\nstart: [{place}, 0]\n")
    expected = r"small.yaml:2: .* outside its walls.* x from -3 to 3, and y from -2 to 2"
    with pytest.raises(ConfigError, match=expected):
        load_world(world, 0)
    assert load_world(write_file(Path(world), Path(world).read_text() + "outer_walls: false\n"), 0)


@pytest.mark.parametrize("head", ["", '<?xml version="1.0"?>\n<!-- <mujoco> -->\n'])
def test_a_urdf_is_refused_as_world(head: str, tmp_path: Path) -> None:
    world = write_file(tmp_path / "x.xml", f'{head}<robot name="x"/>\n')
    line = head.count("\n") + 1
    with pytest.raises(ConfigError, match=rf"x.xml:{line}: a URDF; expected an MJCF model"):
        load_world(world, 0)


def test_a_model_without_space_for_the_robot_is_refused(tmp_path: Path) -> None:
    text = '<mujoco><worldbody><geom type="box" size="1.5 1.5 0.5"/></worldbody></mujoco>'
    with pytest.raises(ConfigError, match=r"full.xml:1: found no place for the robot"):
        load_world(write_file(tmp_path / "full.xml", text), 0)


@pytest.mark.parametrize("part", WorldFile.__struct_fields__)
def test_every_field_refuses_a_value_of_another_type(part: str, tmp_path: Path) -> None:
    other = "{a: [b]}" if part != "materials" else "[1]"
    text = f"{part}: {other}\n" + ("" if part == "size" else "size: [6, 4]\n")
    with pytest.raises(ConfigError, match=r"bad.yaml:1: "):
        load_world(write_file(tmp_path / "bad.yaml", text), 0)


def test_a_deployment_finds_a_world_in_its_own_folder(tmp_path: Path) -> None:
    write_file(tmp_path / "robot.yaml", "world: ./room.yaml\n")
    assert load_deployment(tmp_path / "robot.yaml").world == str(tmp_path / "room.yaml")
    write_file(tmp_path / "robot.yaml", "world: house\n")
    assert load_deployment(tmp_path / "robot.yaml").world == "house"


def grid(tmp_path: Path, ending: str = "png") -> Path:
    """Write a map of a 4 x 3 m room with a pillar, as image and YAML; return the image's path."""
    grey = np.full((60, 80), 254, np.uint8)
    grey[[0, -1]] = grey[:, [0, -1]] = 0
    grey[20:25, 50:54] = 0
    grey[1:10, 1:10] = 205
    image = tmp_path / f"room.{ending}"
    pgm = b"P5\n80 60\n255\n" + grey.tobytes()
    image.write_bytes(pgm if ending == "pgm" else png(np.dstack([grey] * 3)))
    about = f"image: {image.name}\nresolution: 0.05\norigin: [-1, -0.5, 0]\n"
    write_file(tmp_path / "room.yaml", about)
    return image


@pytest.mark.parametrize("ending", ["png", "pgm"])
def test_occupied_cells_of_a_ros_map_become_walls(ending: str, tmp_path: Path) -> None:
    world = load_world(str(grid(tmp_path, ending)), 0)
    assert len(world.shapes) == 5
    pillar = min(world.shapes, key=lambda one: math.hypot(one.x - 1.6, one.y - 1.375))
    assert isinstance(pillar, Box)
    assert (pillar.x, pillar.y) == pytest.approx((1.6, 1.375))
    assert (pillar.half_x, pillar.half_y) == pytest.approx((0.1, 0.125))
    assert (world.half_x, world.half_y, *world.middle) == pytest.approx((2.0, 1.5, 1.0, 1.0))
    simulation = simulated(str(tmp_path / "room.yaml"))
    assert np.isfinite(simulation.scan()[[0, 90, 180, 270]]).all()


def test_a_random_start_is_in_free_space_of_the_map(tmp_path: Path) -> None:
    path = str(grid(tmp_path).with_suffix(".yaml"))
    for seed in range(20):
        world = load_world(path, seed)
        assert clearance(world.everything(), world.start.x, world.start.y) >= 0.6
        assert not (world.start.x < -0.5 and world.start.y > 2.0)


def test_a_world_file_adds_to_a_map(tmp_path: Path) -> None:
    grid(tmp_path)
    text = (
        "map: room.yaml\nwall_height: 0.8\ncylinders:\n  - {at: [0, 1], radius: 0.1, height: 1}\n"
    )
    world = load_world(write_file(tmp_path / "more.yaml", text), 0)
    assert len(world.shapes) == 6
    assert {shape.height for shape in world.shapes} == {0.8, 1.0}


def test_outer_walls_of_a_map_can_be_left_out(tmp_path: Path) -> None:
    grid(tmp_path)
    world = load_world(
        write_file(tmp_path / "open.yaml", "map: room.yaml\nouter_walls: false\n"), 0
    )
    assert world.walls() == ()
    assert len(world.shapes) == 5


@pytest.mark.parametrize("group", range(6))
def test_the_lidar_sees_solid_geoms_of_any_group(group: int, tmp_path: Path) -> None:
    text = MODEL.replace('type="box"', f'type="box" group="{group}"')
    ranges = simulated(write_file(tmp_path / "hall.xml", text)).scan()
    assert np.isfinite(ranges).mean() > 0.5


def test_merged_cells_cover_exactly_the_occupied_ones() -> None:
    random = np.random.default_rng(4)
    for share in (0.1, 0.5, 0.9):
        cells = random.random((40, 30)) < share
        covered = np.zeros(cells.shape, int)
        for row, column, rows, columns in merge_cells(cells, 4000) or ():
            covered[row : row + rows, column : column + columns] += 1
        assert np.array_equal(covered, cells)
    assert merge_cells(cells, 3) is None


def image(width: int, height: int, rows: bytes) -> bytes:
    """Return a grey PNG whose header and content may disagree."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + kind + content
        + struct.pack(">I", zlib.crc32(kind + content)) for kind, content in parts
    )  # fmt: skip


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (image(100, 100, b"\0" * 20_000_000), "it unpacks to more than its 100 x 100"),
        (image(40_000, 40_000, b""), "40000 x 40000 pixels; expected 1 to 8000000"),
        (image(0, 5, b""), "0 x 5 pixels"),
        (image(100, 100, b"\0" * 50), "not a PNG image"),
        (b"\x89PNG\r\n\x1a\n", "not a PNG image"),
        (b"\x89PNG\r\n\x1a\n" + b"\xff" * 100, "not a PNG image"),
    ],
)
def test_a_bad_png_is_refused(data: bytes, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        read_png(data, "map.png", 8_000_000)


def test_a_written_png_is_read_back_unchanged() -> None:
    colours: NDArray[np.uint8] = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    assert np.array_equal(read_png(png(colours), "x", 100), colours.mean(axis=2).round())


@pytest.mark.parametrize(
    ("about", "complaint"),
    [
        ("image: room.png\nresolution: 0.05\norigin: [0, 0, 1]\n", "turned by 1 rad"),
        ("image: none.png\nresolution: 0.05\norigin: [0, 0, 0]\n", "none.png: the map's image"),
        ("image: room.png\nresolution: 50\norigin: [0, 0, 0]\n", r":2: resolution: expected"),
    ],
)
def test_a_bad_map_is_refused(about: str, complaint: str, tmp_path: Path) -> None:
    grid(tmp_path)
    with pytest.raises(ConfigError, match=complaint):
        load_world(write_file(tmp_path / "bad.yaml", about), 0)


def test_a_map_of_noise_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 2, (300, 300), np.uint8) * 255
    (tmp_path / "noise.png").write_bytes(png(np.dstack([noise] * 3)))
    about = "image: noise.png\nresolution: 0.05\norigin: [0, 0, 0]\n"
    with pytest.raises(ConfigError, match="need more than 4000 boxes"):
        load_world(write_file(tmp_path / "noise.yaml", about), 0)


def test_an_mjcf_model_is_a_world(tmp_path: Path) -> None:
    path = write_file(tmp_path / "office.xml", MODEL)
    simulation = simulated(path, 2)
    for _ in range(200):
        simulation.advance()
    assert simulation.truth.contacts == 0  # a box that lies on the floor is no contact
    assert simulation.truth.min_clearance_m > 0.3
    world = load_world(path, 2)
    assert len(world.outlines) == 4
    assert clearance(world.obstacles(), world.start.x, world.start.y) >= 0.6


def test_a_model_may_have_an_upper_floor_and_a_tilted_box_named_floor(tmp_path: Path) -> None:
    upstairs = '<geom type="plane" size="0 0 .1" pos="0 0 3"/>'
    wall = '<geom name="floor2" type="box" size=".1 1 1" pos="9 0 1" euler="0 45 0"/>'
    text = MODEL.replace("<worldbody>", f"<worldbody>{upstairs}{wall}")
    assert load_world(write_file(tmp_path / "house.xml", text), 0)
    assert load_world(
        write_file(tmp_path / "wall.xml", f"<mujoco><worldbody>{wall}</worldbody></mujoco>"), 0
    )


def test_a_world_file_may_use_paths_with_a_tilde(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    grid(tmp_path)
    write_file(tmp_path / "office.xml", MODEL)
    (tmp_path / "worlds").mkdir()
    text = "map: ~/room.yaml\nmodel: ~/office.xml\nstart: [0, 0, 0]\n"
    world = load_world(write_file(tmp_path / "worlds" / "both.yaml", text), 0)
    assert (len(world.shapes), len(world.outlines)) == (5, 4)


@pytest.mark.parametrize(
    "real", ["", "<geom name='floor' type='cylinder' size='5 .05' pos='0 0 -.05'/>"]
)
def test_a_raised_plane_is_not_taken_for_the_floor(tmp_path: Path, real: str) -> None:
    plane = f"<geom type='plane' size='.2 .2 1' pos='0 0 .75' contype='{int(bool(real))}'/>"
    text = f"<mujoco><worldbody>{real}{plane}</worldbody></mujoco>"
    assert load_world(write_file(tmp_path / "table.xml", text), 0)


def test_the_floor_of_a_model_may_be_below_zero(tmp_path: Path) -> None:
    floor = "<geom type='plane' size='1 1 1' pos='0 0 -.75'/>"
    path = write_file(tmp_path / "table.xml", f"<mujoco><worldbody>{floor}</worldbody></mujoco>")
    assert load_world(path, 0)


def test_a_world_file_may_add_boxes_to_a_model(tmp_path: Path) -> None:
    write_file(tmp_path / "office.xml", MODEL)
    text = "model: office.xml\nstart: [0, 0, 0]\nboxes:\n  - {at: [1, 0], size: [0.2, 0.2, 0.5]}\n"
    scan = simulated(write_file(tmp_path / "both.yaml", text)).scan()
    assert scan[0] == pytest.approx(0.964, abs=0.05)
    assert scan[90] == pytest.approx(1.9, abs=0.05)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("<mujoco>\n<worldbody>\n<geom type='bx' size='1'/></worldbody></mujoco>", r"bad.xml:3: "),
        ("no XML", r"bad.xml:1: "),
        (
            "<mujoco><worldbody><geom type='box' pos='1e9 0 0' size='1 1 1'/></worldbody></mujoco>",
            "reaches further than 400 m",
        ),
        (
            "<mujoco><worldbody><replicate count='300000' offset='.1 0 0'>"
            "<geom size='.1'/></replicate></worldbody></mujoco>",
            "repeats parts more than 10000 times",
        ),
        (
            "<mujoco><worldbody><geom type='plane' size='1 1 1' pos='0 0 2'/></worldbody></mujoco>",
            "its floor is at a height of 2 m; expected 0",
        ),
        (
            "<mujoco><worldbody><geom name='ground' type='box' size='9 9 1'/></worldbody></mujoco>",
            "its floor is at a height of 1 m; expected 0",
        ),
    ],
)
def test_a_bad_model_is_refused_in_one_line(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=complaint) as raised:
        load_world(write_file(tmp_path / "bad.xml", text), 0)
    assert "\n" not in str(raised.value)
