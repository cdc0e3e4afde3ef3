"""Map files: ROS's PGM and YAML, and the pose graph as bounded .npz arrays.

All files of a save appear at once: they are written into a folder, which is then renamed. The next
reader finishes a save that a crash interrupted. Sizes are checked before arrays are read: a zip may
hold a thousand times its own size.
"""

import hashlib
import io
import math
import os
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.config import map_image
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.host.files import (
    make_folder,
    open_regular,
    sync_folder,
    write_synced,
)
from gigabrain_zenoh.host.run_folders import state_dir

OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # grey values, as ROS's map_server writes them
OCCUPIED_PERCENT, FREE_PERCENT = 65, 40  # occupied from 65 on, free up to 40
MIN_FREE_M2, MIN_WALL_M = 1.0, 1.0  # of a map that is worth saving
GRAPH = ".graph.npz"
ZONES = ".zones.yaml"  # see zone_file
OBJECTS = ".objects.json"  # see object_file
EMPTY_FILE = b"{}\n"  # without zones or objects
GRID_HASH = "grid"  # name in the graph's file, which belongs to this grid

Arrays = Mapping[str, NDArray[Any]]
MAX_ARRAY_BYTES = 80_000_000  # of all arrays in a file
MAX_ARRAYS = 64
DIRECTORY_BYTES = 512  # of a zip's directory, per array
ZIP_END, ZIP_END_BYTES, MAX_COMMENT_BYTES = b"PK\5\6", 22, 65_535  # of a zip's end record
MAX_NUMBER = 1e9  # as on the bus
NPY_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
# raised by zipfile, zlib and numpy's header readers for hostile input
READ_ERRORS = (
    ValueError, EOFError, KeyError, OSError, TypeError, NotImplementedError, RuntimeError,
    SyntaxError, OverflowError, MemoryError, struct.error, tokenize.TokenError, zlib.error,
    zipfile.BadZipFile,
)  # fmt: skip


def path_of(name: str) -> Path:
    """Return the path of a map's YAML file: of a saved map's name, or a path as it is."""
    if "/" in name or name.endswith((".yaml", ".yml")):
        return Path(name)
    return saved_map_path(name)


def folder() -> Path:
    """Return the folder of saved maps."""
    return state_dir() / "maps"


def saved_map_path(name: str) -> Path:
    """Return the path of a saved map's YAML file."""
    return folder() / f"{name}.yaml"


def in_words(found: SavedMap) -> str:
    """Return the size of a map as text."""
    height, width = (cells * found.resolution for cells in found.cells.shape)
    area = np.count_nonzero(_free_cells(found)) * found.resolution**2
    return f"{width:.1f} x {height:.1f} m, {area:.1f} m² of it free"


def load(path: Path) -> SavedMap:
    """Load the map of a YAML file. Raises ConfigError, in one line."""
    _finish_save(path)
    return map_image.load(path)


def load_graph(path: Path) -> dict[str, NDArray[Any]]:
    """Load the pose graph beside the YAML file `path`. Raises ConfigError, in one line."""
    _finish_save(path)
    file = path.with_suffix(GRAPH)
    graph = read_arrays(file, "the map's pose graph; expected it beside the YAML file")
    grid_hash = graph.pop(GRID_HASH, None)
    if grid_hash is not None and not np.array_equal(grid_hash, _grid_hash(load(path))):
        raise ConfigError(
            f"{file}: belongs to another map than {path}; restore the files that were saved "
            "together, or only localize in the map (mapping: localize)"
        )
    return graph


def save(
    path: Path,
    found: SavedMap,
    graph: Arrays,
    *,
    replace: bool = False,
    zones: bytes = b"",
    objects: bytes | None = b"",
) -> None:
    """Write the YAML file `path` and its image, graph, zones and objects: all of them, or none.

    If `objects` is None, existing ones stay; a replaced map leaves nothing else. Raises Refused
    for an unusable map, or if a map exists and `replace` is False.
    """
    problem = map_problem(found)
    if problem:
        raise Refused(f"not saved: {problem}")
    try:
        make_folder(path.parent)
        _finish_save(path)
        if path.exists() and not replace:
            raise Refused(f"not saved: there is a map {path} already; --replace overwrites it")
        endings = ((ZONES, zones), (OBJECTS, objects))
        beside = {path.with_suffix(end): data for end, data in endings if data is not None}
        more = {
            file.name: data or EMPTY_FILE for file, data in beside.items() if data or file.exists()
        }
        _write_all(path, {**_files(path, found, graph), **more})
    except ValueError as error:
        raise Refused(f"not saved: {error}") from None
    except OSError as error:
        raise Refused(f"not saved: {error.filename or path}: {error.strerror}") from None
    _finish_save(path)


def map_problem(found: SavedMap) -> str:
    """Return the reason why a map is not worth saving, or an empty text."""
    area = np.count_nonzero(_free_cells(found)) * found.resolution**2
    if area < MIN_FREE_M2:
        return f"the map is empty: {area:.2f} m² of it are free"
    length = np.count_nonzero(found.cells >= OCCUPIED_PERCENT) * found.resolution
    if length < MIN_WALL_M:
        return f"the map has no walls: {length:.2f} m of them"
    return ""


def _free_cells(found: SavedMap) -> NDArray[np.bool_]:
    return (found.cells >= 0) & (found.cells <= FREE_PERCENT)


def _grid_hash(found: SavedMap) -> NDArray[np.uint8]:
    """Return a hash that identifies a saved grid."""
    occupied = np.where(found.cells >= OCCUPIED_PERCENT, 100, -1)
    geometry = f"{found.resolution:.12g} {found.origin_x:.12g} {found.origin_y:.12g}"
    cells = np.where(_free_cells(found), 0, occupied).astype(np.int8)
    hashed = f"{geometry} {cells.shape}".encode() + cells.tobytes()
    return np.frombuffer(hashlib.sha256(hashed).digest(), np.uint8)


def _files(path: Path, found: SavedMap, graph: Arrays) -> dict[str, bytes]:
    height, width = found.cells.shape
    grey = np.full((height, width), UNKNOWN, np.uint8)
    grey[found.cells >= OCCUPIED_PERCENT] = OCCUPIED
    grey[_free_cells(found)] = FREE
    image = path.with_suffix(".pgm").name
    description = (
        f"image: {image}\nresolution: {found.resolution:.12g}\n"
        f"origin: [{found.origin_x:.12g}, {found.origin_y:.12g}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return {
        image: b"P5\n%d %d\n255\n" % (width, height) + grey[::-1].tobytes(),
        path.with_suffix(GRAPH).name: arrays_bytes({**graph, GRID_HASH: _grid_hash(found)}),
        path.name: description.encode(),
    }


def _write_all(path: Path, files: Mapping[str, bytes]) -> None:
    """Write all `files` durably; from then on _finish_save can put them in their places."""
    draft = path.with_name(f".{path.stem}.draft")
    if draft.exists():  # from an interrupted save
        shutil.rmtree(draft)
    draft.mkdir()
    try:
        _write(draft, files)
    except OSError:
        shutil.rmtree(draft, ignore_errors=True)  # a full disk would stay full
        raise
    draft.rename(_complete_folder(path))
    sync_folder(path.parent)


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, data in files.items():
        write_synced(folder / name, data)
    sync_folder(folder)


def _finish_save(path: Path) -> None:
    """Move the files of a complete save to their places. Raises ConfigError if that fails."""
    complete = _complete_folder(path)
    if not os.path.isdir(complete):  # Path.is_dir raises in a forbidden folder
        return
    try:
        for file in complete.iterdir():
            file.rename(path.with_name(file.name))
        sync_folder(path.parent)
        complete.rmdir()
    except FileNotFoundError:  # another process finished it
        return
    except OSError as error:
        raise ConfigError(f"{complete}: an unfinished save: {error.strerror}") from None


def _complete_folder(path: Path) -> Path:
    return path.with_name(f".{path.stem}.complete")


def read_arrays(path: Path, what: str, only: str = "") -> dict[str, NDArray[Any]]:
    """Read the arrays of a file, or only the array `only`; `what` names the content in errors.

    Raises ConfigError, in one line.
    """
    try:
        with open_regular(path, MAX_ARRAY_BYTES) as file:
            return _read_zip(file, only)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: {what}: {error.strerror}") from None
    except READ_ERRORS as error:
        text = " ".join(str(error).split())[:120] or type(error).__name__
        raise ConfigError(f"{path}: cut or damaged: {text}") from None


def write_arrays(file: BinaryIO, arrays: Arrays, *, compress: bool) -> None:
    """Write `arrays` to `file`. Raises OSError, and ValueError if they are too large to read."""
    size = sum(values.nbytes for values in arrays.values())
    if size > MAX_ARRAY_BYTES * 0.99:  # the headers count too
        raise ValueError(
            f"it holds {size / 1e6:.0f} MB; at most {MAX_ARRAY_BYTES / 1e6:g} MB can be read"
        )
    save = np.savez_compressed if compress else np.savez
    save(file, allow_pickle=False, **arrays)


def arrays_bytes(arrays: Arrays) -> bytes:
    """Return `arrays` as a compressed file. Raises ValueError like `write_arrays`."""
    content = io.BytesIO()
    write_arrays(content, arrays, compress=True)
    return content.getvalue()


def _read_zip(file: BinaryIO, only: str) -> dict[str, NDArray[Any]]:
    if _directory_bytes(file) > MAX_ARRAYS * DIRECTORY_BYTES:
        raise ValueError(f"expected at most {MAX_ARRAYS} arrays")  # zipfile reads all entries
    with zipfile.ZipFile(file) as members:
        infos = members.infolist()
        size = sum(info.file_size for info in infos)
        if size > MAX_ARRAY_BYTES or len(infos) > MAX_ARRAYS:
            raise ValueError(
                f"{len(infos)} arrays of {size / 1e6:.0f} MB; expected at most {MAX_ARRAYS} "
                f"of {MAX_ARRAY_BYTES / 1e6:g} MB"
            )
        names = {info.filename.removesuffix(".npy"): info for info in infos}
        wanted = {only: names[only]} if only else names
        return {name: _read_array(name, members, info) for name, info in wanted.items()}


def _directory_bytes(file: BinaryIO) -> int:
    """Return the size of the zip's directory, from its end record (APPNOTE.TXT, 4.3.16) [bytes]."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - ZIP_END_BYTES - MAX_COMMENT_BYTES))
    tail = file.read()
    file.seek(0)
    end = len(tail) - ZIP_END_BYTES
    if tail[end : end + 4] != ZIP_END or tail[-2:] != b"\0\0":
        end = tail.rfind(ZIP_END)
    if end < 0 or len(tail) - end < ZIP_END_BYTES:
        return 0  # no zip: zipfile raises
    if b"PK\6\7" in tail[max(0, end - 20) : end]:
        raise ValueError("it is a zip of the large format, which no map needs")
    return int.from_bytes(tail[end + 12 : end + 16], "little")


def _read_array(name: str, members: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """Read one array of plain numbers. Raises one of READ_ERRORS for other content."""
    with members.open(info) as stream:
        shape, fortran, dtype = NPY_HEADERS[np.lib.format.read_magic(stream)](stream)
        if dtype.kind not in "biuf" or min(shape, default=0) < 0:
            raise ValueError(f"{name} holds data other than numbers")
        data = stream.read()  # of bounded size; zipfile checks the checksum
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{name}: {len(data)} bytes for {shape} of {dtype}")
    values: NDArray[Any] = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
    if values.size and not -MAX_NUMBER <= values.min() <= values.max() <= MAX_NUMBER:
        raise ValueError(f"{name} holds data other than numbers up to {MAX_NUMBER:g}")
    return values
