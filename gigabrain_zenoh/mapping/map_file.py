"""Maps on disk: ROS's PGM and YAML, and the pose graph beside them to go on with.

All files of a save come into being at once. They are written into a folder of their own, whose
renaming decides; whoever looks next finishes what a crash left between that and their own places.
"""

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import Finite, Fraction
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.host.files import make_folder, sync_folder, write_synced
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.mapping import arrays_file, pgm
from gigabrain_zenoh.mapping.arrays_file import Arrays

Cells = NDArray[np.int8]

OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # grey values, as ROS's map_server writes them
OCCUPIED_PERCENT, FREE_PERCENT = 65, 40  # from here on, and up to here
LEAST_FREE_M2, LEAST_WALL_M = 1.0, 1.0  # less than that is no map
GRAPH = ".graph.npz"
STAMP = "grid"  # in the graph's file: which grid it belongs to


class MapYaml(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """ROS's description of a map image."""

    image: Annotated[str, Meta(pattern=r"^[^\0]+$")]
    resolution: Annotated[float, Meta(ge=0.001, le=1.0)]  # [m] per pixel
    origin: tuple[Finite, Finite, Finite]  # x, y [m] of the lower left corner, yaw [rad]
    negate: Annotated[int, Meta(ge=0, le=1)] = 0  # 1 where white is occupied
    occupied_thresh: Fraction = 0.65
    free_thresh: Fraction = 0.196
    mode: Literal["trinary", "scale"] = "trinary"  # both are read as trinary


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A grid as it lies on disk."""

    cells: Cells  # (height, width), the lowest row first: 0 free, 100 occupied, -1 unknown
    resolution: float  # [m]
    origin_x: float  # [m], of the corner of cell (0, 0)
    origin_y: float  # [m]


def path_of(name: str) -> Path:
    """The YAML file of a map by its name, or by its path if it looks like one."""
    if "/" in name or name.endswith((".yaml", ".yml")):
        return Path(name)
    return saved_as(name)


def saved_as(name: str) -> Path:
    """The YAML file of a map that was saved, or is to be, under a name."""
    return state_dir() / "maps" / f"{name}.yaml"


def in_words(found: SavedMap) -> str:
    """How large a map is, for people."""
    height, width = (cells * found.resolution for cells in found.cells.shape)
    area = np.count_nonzero(_free(found)) * found.resolution**2
    return f"{width:.1f} x {height:.1f} m, {area:.1f} m² of it free"


def load(path: Path) -> SavedMap:
    """The map that a YAML file describes. Raises ConfigError, in one line."""
    _finish(path)
    about = config.load(path, MapYaml)
    if about.origin[2] != 0:
        raise ConfigError(f"{path}: origin: turned by {about.origin[2]:g} rad; expected yaw 0")
    if about.free_thresh >= about.occupied_thresh:
        raise ConfigError(f"{path}: free_thresh must be below occupied_thresh")
    grey = pgm.read(path.parent / about.image)
    share = grey / 255 if about.negate else (255 - grey.astype(np.float64)) / 255
    cells = np.full(grey.shape, -1, np.int8)
    cells[share > about.occupied_thresh] = 100
    cells[share < about.free_thresh] = 0
    upwards = np.ascontiguousarray(cells[::-1])
    return SavedMap(upwards, about.resolution, about.origin[0], about.origin[1])


def load_graph(path: Path) -> dict[str, NDArray[Any]]:
    """The pose graph beside the YAML file `path`. Raises ConfigError, in one line."""
    _finish(path)
    file = path.with_suffix(GRAPH)
    graph = arrays_file.read(file, "the pose graph to go on with; expected it beside the YAML file")
    stamp = graph.pop(STAMP, None)
    if stamp is not None and not np.array_equal(stamp, _stamp(load(path))):
        raise ConfigError(
            f"{file}: belongs to another map than {path}; bring back what was saved together, "
            "or find the way in that map as it is (mapping: localize)"
        )
    return graph


def save(path: Path, found: SavedMap, graph: Arrays, *, replace: bool = False) -> None:
    """Write `path`, a YAML file's, and its image and graph. All of it, or nothing.

    Raises Refused for what is no map, or where another one is and `replace` is not said.
    """
    problem = what_is_wrong(found)
    if problem:
        raise Refused(f"not saved: {problem}")
    try:
        make_folder(path.parent)
        _finish(path)
        if path.exists() and not replace:
            raise Refused(f"not saved: there is a map {path} already; --replace overwrites it")
        _commit(path, _files(path, found, graph))
    except ValueError as error:
        raise Refused(f"not saved: {error}") from None
    except OSError as error:
        raise Refused(f"not saved: {error.filename or path}: {error.strerror}") from None
    _finish(path)


def what_is_wrong(found: SavedMap) -> str:
    """Why this is no map worth keeping, or an empty text."""
    area = np.count_nonzero(_free(found)) * found.resolution**2
    if area < LEAST_FREE_M2:
        return f"the map is empty: {area:.2f} m² of it are free"
    length = np.count_nonzero(found.cells >= OCCUPIED_PERCENT) * found.resolution
    if length < LEAST_WALL_M:
        return f"the map has no walls: {length:.2f} m of them"
    return ""


def _free(found: SavedMap) -> NDArray[np.bool_]:
    return (found.cells >= 0) & (found.cells <= FREE_PERCENT)


def _stamp(found: SavedMap) -> NDArray[np.uint8]:
    """Tells a grid from others, as it is when it has been saved."""
    full = np.where(found.cells >= OCCUPIED_PERCENT, 100, -1)
    place = f"{found.resolution:.12g} {found.origin_x:.12g} {found.origin_y:.12g}"
    cells = np.where(_free(found), 0, full).astype(np.int8)
    whole = f"{place} {cells.shape}".encode() + cells.tobytes()
    return np.frombuffer(hashlib.sha256(whole).digest(), np.uint8)


def _files(path: Path, found: SavedMap, graph: Arrays) -> dict[str, bytes]:
    """What to write, by name."""
    height, width = found.cells.shape
    grey = np.full((height, width), UNKNOWN, np.uint8)
    grey[found.cells >= OCCUPIED_PERCENT] = OCCUPIED
    grey[_free(found)] = FREE
    image = path.with_suffix(".pgm").name
    about = (
        f"image: {image}\nresolution: {found.resolution:.12g}\n"
        f"origin: [{found.origin_x:.12g}, {found.origin_y:.12g}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return {
        image: b"P5\n%d %d\n255\n" % (width, height) + grey[::-1].tobytes(),
        path.with_suffix(GRAPH).name: arrays_file.written({**graph, STAMP: _stamp(found)}),
        path.name: about.encode(),
    }


def _commit(path: Path, files: Mapping[str, bytes]) -> None:
    """Bring all `files` safely to disk; after that they will be in their places, come what may."""
    draft = path.with_name(f".{path.stem}.draft")
    if draft.exists():  # of a save that was interrupted
        shutil.rmtree(draft)
    draft.mkdir()
    try:
        _write(draft, files)
    except OSError:
        shutil.rmtree(draft, ignore_errors=True)  # or a full disk would stay full
        raise
    draft.rename(_complete(path))
    sync_folder(path.parent)


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, data in files.items():
        write_synced(folder / name, data)
    sync_folder(folder)


def _finish(path: Path) -> None:
    """Put the files of a complete save in their places. Raises ConfigError where it cannot."""
    complete = _complete(path)
    if not complete.is_dir():
        return
    try:
        for file in complete.iterdir():
            file.rename(path.with_name(file.name))
        sync_folder(path.parent)
        complete.rmdir()
    except FileNotFoundError:  # somebody else was quicker, and has finished it
        return
    except OSError as error:
        raise ConfigError(f"{complete}: an unfinished save: {error.strerror}") from None


def _complete(path: Path) -> Path:
    return path.with_name(f".{path.stem}.complete")
