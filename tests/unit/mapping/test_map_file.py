"""Map files: saved maps are loaded, damaged ones are refused, and a good map is never lost."""

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_schemas.objects import MapTag
from gigabrain_schemas.requests import MapRequest
from gigabrain_schemas.zones import Place
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.host import files
from gigabrain_zenoh.mapping import map_file, object_file, zone_file
from gigabrain_zenoh.mapping.object_file import ObjectFile
from gigabrain_zenoh.mapping.zone_file import ZoneFile

DOOR = Place(name="door", x=1, y=2)
TAG = MapTag(id=5, x=0, y=0, z=0.2, yaw=0, size=0.16)
GRAPH = {"poses": np.arange(6.0).reshape(2, 3)}


def room() -> SavedMap:
    """Return a map of 6 x 5 m with walls all round; the last row is unknown."""
    cells = np.zeros((100, 120), np.int8)
    cells[0], cells[:, 0], cells[:, -1], cells[98] = 100, 100, 100, 100
    cells[99] = -1
    return SavedMap(cells, 0.05, -2.35, 1.1)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    map_path = tmp_path / "maps" / "room.yaml"
    map_file.save(map_path, room(), GRAPH)
    return map_path


def test_a_loaded_map_equals_the_saved_one(path: Path) -> None:
    found = map_file.load(path)
    assert np.array_equal(found.cells, room().cells)
    assert (found.resolution, found.origin_x, found.origin_y) == (0.05, -2.35, 1.1)
    assert np.array_equal(map_file.load_graph(path)["poses"], GRAPH["poses"])
    assert {file.name for file in path.parent.iterdir()} == {
        "room.yaml", "room.pgm", "room.graph.npz",
    }  # fmt: skip


def test_the_files_are_those_of_ros(path: Path) -> None:
    assert path.read_text() == (
        "image: room.pgm\nresolution: 0.05\norigin: [-2.35, 1.1, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    image = path.with_suffix(".pgm").read_bytes()
    assert image.startswith(b"P5\n120 100\n255\n")
    pixels = image.removeprefix(b"P5\n120 100\n255\n")
    assert set(pixels[:120]) == {205}  # the highest row comes first
    assert pixels[-1] == 0
    assert pixels[120 * 50 + 60] == 254


def test_a_ros_map_with_comments_another_cell_size_and_white_walls_is_read(
    tmp_path: Path,
) -> None:
    pixels = bytes((255, 0, 0, 128, 0, 0))
    (tmp_path / "hall.pgm").write_bytes(b"P5 # by hand\n3\n# rows\n2\n255\n" + pixels)
    (tmp_path / "hall.yaml").write_text(
        "image: hall.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 1\nmode: scale\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    found = map_file.load(tmp_path / "hall.yaml")
    assert found.cells.tolist() == [[-1, 0, 0], [100, 0, 0]]
    assert found.resolution == 0.1


def cut(image: bytes) -> bytes:
    return image[:5000]


def longer(image: bytes) -> bytes:
    return image + b"\0"


def other_maxval(image: bytes) -> bytes:
    return image.replace(b"\n255\n", b"\n65535\n", 1)


def ascii_pgm(image: bytes) -> bytes:
    return image.replace(b"P5", b"P2", 1)


def endless(image: bytes) -> bytes:
    return image.replace(b"120", b"1" * 5000, 1)


def enormous(image: bytes) -> bytes:
    return image.replace(b"120 100", b"120000 100000", 1)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut, "room.pgm: cut: 4985 of 120 x 100 pixels are there"),
        (longer, "room.pgm: of another size: 12001 of 120 x 100 pixels are there"),
        (other_maxval, "room.pgm: a maxval of 65535; expected 255"),
        (ascii_pgm, "room.pgm: no binary PGM; expected a header such as 'P5 640 480 255'"),
        (endless, "room.pgm: no binary PGM; expected a header such as 'P5 640 480 255'"),
        (enormous, "room.pgm: 120000 x 100000 pixels; expected 1 to 8000000 in all"),
    ],
)
def test_a_damaged_image_is_refused_in_one_line(damage: object, message: str, path: Path) -> None:
    image = path.with_suffix(".pgm")
    assert callable(damage)
    image.write_bytes(damage(image.read_bytes()))
    with pytest.raises(ConfigError) as error:
        map_file.load(path)
    assert str(error.value) == f"{path.parent}/{message}"


@pytest.mark.parametrize(
    ("line", "instead", "message"),
    [
        ("origin: [-2.35, 1.1, 0.0]\n", "", "room.yaml:1: missing field 'origin'"),
        ("resolution: 0.05", "resolution: 0", "room.yaml:2: resolution"),
        ("resolution: 0.05", "resolution: .nan", "room.yaml:2: .nan is not allowed"),
        ("resolution: 0.05", "resolution: 1e9", "room.yaml:2: resolution: expected a number >= 0."),
        ("room.pgm", '"room\\0.pgm"', "room.yaml:1: image: expected a string matching"),
        ("0.0]", "0.7]", "room.yaml: origin: turned by 0.7 rad; expected yaw 0"),
        (
            "[-2.35, 1.1, 0.0]",
            "[500000, 4500000, 0]",
            "room.yaml: origin: the map reaches to (500006, 4500005) m; expected within 100 km of "
            "(0, 0); shift a map in UTM, such as to 'origin: [0, 0, 0]'",
        ),
        ("-2.35", "99995", "room.yaml: origin: the map reaches to (100001, 6) m"),
        ("1.1", "-100001", "room.yaml: origin: the map reaches to (4, -100001) m"),
        ("0.196", "0.7", "room.yaml: free_thresh must be below occupied_thresh"),
        ("room.pgm", "gone.pgm", "gone.pgm: the map's image: no such file or folder"),
    ],
)
def test_a_wrong_description_is_refused_in_one_line(
    line: str, instead: str, message: str, path: Path
) -> None:
    path.write_text(path.read_text().replace(line, instead, 1))
    with pytest.raises(ConfigError) as error:
        map_file.load(path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_an_image_that_is_too_long_for_a_message_is_refused_in_one_line(path: Path) -> None:
    path.with_suffix(".pgm").write_bytes(b"P5 100001 1 255\n" + bytes(100_001))
    with pytest.raises(ConfigError, match=r"100001 x 1 pixels; expected at most 100000 a side$"):
        map_file.load(path)


@pytest.mark.parametrize("kept_bytes", [0, 100, 200])
def test_a_cut_graph_is_refused_in_one_line(kept_bytes: int, path: Path) -> None:
    graph = path.with_suffix(".graph.npz")
    graph.write_bytes(graph.read_bytes()[:kept_bytes])
    with pytest.raises(ConfigError) as error:
        map_file.load_graph(path)
    assert f"{graph}: cut or damaged" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "unusable", [np.array([math.nan, 0.0]), np.array(["x"]), np.array([1e300])]
)
def test_a_graph_with_other_values_than_numbers_is_refused_in_one_line(
    unusable: NDArray[Any], path: Path
) -> None:
    np.savez(path.with_suffix(".graph.npz"), poses=unusable, allow_pickle=False)
    with pytest.raises(
        ConfigError, match=r"npz: cut or damaged: poses holds data other than numbers"
    ):
        map_file.load_graph(path)


def test_a_graph_of_another_map_is_refused(path: Path) -> None:
    other = SavedMap(np.roll(room().cells, 3, axis=1), 0.05, -2.35, 1.1)
    elsewhere = path.with_name("other.yaml")
    map_file.save(elsewhere, other, GRAPH)
    elsewhere.with_suffix(".graph.npz").replace(path.with_suffix(".graph.npz"))
    with pytest.raises(ConfigError, match=r"npz: belongs to another map than .*room"):
        map_file.load_graph(path)


def test_a_graph_without_its_grid_is_refused(path: Path) -> None:
    image = path.with_suffix(".pgm")
    image.write_bytes(cut(image.read_bytes()))
    with pytest.raises(ConfigError, match="cut: 4985 of 120 x 100 pixels are there"):
        map_file.load_graph(path)


def empty() -> SavedMap:
    return SavedMap(np.full((200, 200), -1, np.int8), 0.05, 0.0, 0.0)


def without_walls() -> SavedMap:
    return SavedMap(np.zeros((200, 200), np.int8), 0.05, 0.0, 0.0)


@pytest.mark.parametrize(
    ("unusable", "message"),
    [
        (empty(), "not saved: the map is empty: 0.00 m² of it are free"),
        (without_walls(), "not saved: the map has no walls: 0.00 m of them"),
    ],
)
def test_an_unusable_map_does_not_replace_a_good_one(
    unusable: SavedMap, message: str, path: Path
) -> None:
    with pytest.raises(Refused) as error:
        map_file.save(path, unusable, {}, replace=True)
    assert str(error.value) == message
    assert np.array_equal(map_file.load(path).cells, room().cells)


def test_a_map_is_only_overwritten_on_request(path: Path) -> None:
    other = SavedMap(np.roll(room().cells, 3, axis=1), 0.05, 0.0, 0.0)
    with pytest.raises(Refused, match=r"there is a map .*room\.yaml already; --replace"):
        map_file.save(path, other, GRAPH)
    assert map_file.load(path).origin_x == -2.35
    map_file.save(path, other, GRAPH, replace=True)
    assert map_file.load(path).origin_x == 0.0


def test_a_map_without_zones_and_objects_removes_those_of_the_replaced_map(path: Path) -> None:
    zones, objects = ZoneFile(places=(DOOR,)), ObjectFile(tags=(TAG,))
    extra_files = {"zones": zone_file.encoded(zones), "objects": object_file.encoded(objects)}
    map_file.save(path, room(), GRAPH, replace=True, **extra_files)
    map_file.save(path, room(), GRAPH, replace=True, zones=extra_files["zones"], objects=None)
    assert (zone_file.load(path), object_file.load(path)) == (zones, objects)
    map_file.save(path, room(), GRAPH, replace=True)
    assert (zone_file.load(path), object_file.load(path)) == (ZoneFile(), ObjectFile())


def test_a_save_that_fails_half_way_keeps_the_old_map(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(Refused, match="No space left on device"):
        map_file.save(path, room(), GRAPH, replace=True)
    monkeypatch.undo()
    assert len(list(path.parent.iterdir())) == 3  # an unfinished save does not fill the disk
    assert np.array_equal(map_file.load(path).cells, room().cells)
    map_file.save(path, room(), GRAPH, replace=True)
    assert len(list(path.parent.iterdir())) == 3


def test_a_map_path_that_is_too_long_is_refused_in_one_line() -> None:
    for read in (map_file.load, map_file.load_graph):
        with pytest.raises(ConfigError, match=r"(?i)name (is )?too long"):
            read(Path("/" + "room" * 100 + ".yaml"))


def test_the_next_reader_finishes_a_save_that_a_crash_interrupted(path: Path) -> None:
    complete = path.with_name(".room.complete")
    complete.mkdir()
    image = path.with_suffix(".pgm").read_bytes()
    (complete / "room.pgm").write_bytes(image.replace(b"\xfe", b"\xcd"))  # free becomes unknown
    (complete / "room.yaml").write_text(path.read_text().replace("-2.35", "4.0"))
    found = map_file.load(path)
    assert found.origin_x == 4.0
    assert (found.cells == 0).sum() == 0
    assert not complete.exists()


def test_a_name_is_a_file_in_the_state_folder_and_a_path_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    assert map_file.path_of("office") == Path("/state/gigabrain/maps/office.yaml")
    assert map_file.path_of("maps/office.yaml") == Path("maps/office.yaml")
    assert map_file.path_of("office.yml") == Path("office.yml")


@pytest.mark.parametrize("name", ["office.yaml", "a.yml", "office\n", ".hidden", "../x", ""])
def test_a_map_name_that_would_be_a_file_elsewhere_is_refused(name: str) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"name": name}, MapRequest)
    assert msgspec.convert({"name": "office-2.b"}, MapRequest).name == "office-2.b"
