"""Arrays of numbers in a file, as numpy's .npz has them, read without trust.

A zip may hold a thousand times its own size, and a header may promise more than follows: what is
read is bounded before it is read. The zip's checksums tell damage.
"""

import io
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import open_regular

Arrays = Mapping[str, NDArray[Any]]

MOST_BYTES = 80_000_000  # of all arrays of a file together
MOST_ARRAYS = 64
DIRECTORY_BYTES = 512  # of a zip's directory, for each array
END, END_BYTES, MOST_COMMENT_BYTES = b"PK\5\6", 22, 65_535  # of a zip's end record
LARGEST = 1e9  # of any number, as on the bus
HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
# all that zipfile, zlib and numpy's reading of headers raise on hostile input
DAMAGES = (
    ValueError, EOFError, KeyError, OSError, TypeError, NotImplementedError, RuntimeError,
    SyntaxError, OverflowError, MemoryError, struct.error, tokenize.TokenError, zlib.error,
    zipfile.BadZipFile,
)  # fmt: skip


def read(path: Path, what: str, only: str = "") -> dict[str, NDArray[Any]]:
    """The arrays in a file, which holds `what`; `only` one of them, if it is named.

    Raises ConfigError, in one line.
    """
    try:
        with open_regular(path, MOST_BYTES) as file:
            return _read(file, only)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: {what}: {error.strerror}") from None
    except DAMAGES as error:
        text = " ".join(str(error).split())[:120] or type(error).__name__
        raise ConfigError(f"{path}: cut or damaged: {text}") from None


def write(file: BinaryIO, arrays: Arrays, *, compress: bool) -> None:
    """Write a file's content. Raises OSError, and ValueError for more than `read` would take."""
    size = sum(values.nbytes for values in arrays.values())
    if size > MOST_BYTES * 0.99:  # the headers count too
        raise ValueError(
            f"it holds {size / 1e6:.0f} MB; at most {MOST_BYTES / 1e6:g} MB can be read"
        )
    save = np.savez_compressed if compress else np.savez
    save(file, allow_pickle=False, **arrays)


def written(arrays: Arrays) -> bytes:
    """The content of a compressed file. Raises ValueError, as `write` does."""
    content = io.BytesIO()
    write(content, arrays, compress=True)
    return content.getvalue()


def _read(file: BinaryIO, only: str) -> dict[str, NDArray[Any]]:
    if _directory_bytes(file) > MOST_ARRAYS * DIRECTORY_BYTES:
        raise ValueError(f"expected at most {MOST_ARRAYS} arrays")  # zipfile reads all entries
    with zipfile.ZipFile(file) as members:
        infos = members.infolist()
        size = sum(info.file_size for info in infos)
        if size > MOST_BYTES or len(infos) > MOST_ARRAYS:
            raise ValueError(
                f"{len(infos)} arrays of {size / 1e6:.0f} MB; expected at most {MOST_ARRAYS} "
                f"of {MOST_BYTES / 1e6:g} MB"
            )
        names = {info.filename.removesuffix(".npy"): info for info in infos}
        wanted = {only: names[only]} if only else names
        return {name: _array(name, members, info) for name, info in wanted.items()}


def _directory_bytes(file: BinaryIO) -> int:
    """Return how large the zip's directory is, by its end record (APPNOTE.TXT, 4.3.16) [bytes]."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - END_BYTES - MOST_COMMENT_BYTES))
    tail = file.read()
    file.seek(0)
    at = len(tail) - END_BYTES
    if tail[at : at + 4] != END or tail[-2:] != b"\0\0":
        at = tail.rfind(END)
    if at < 0 or len(tail) - at < END_BYTES:
        return 0  # no zip, as zipfile will say
    if b"PK\6\7" in tail[max(0, at - 20) : at]:
        raise ValueError("it is a zip of the large format, which no map needs")
    return int.from_bytes(tail[at + 12 : at + 16], "little")


def _array(name: str, members: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, if it holds plain numbers; else one of DAMAGES."""
    with members.open(info) as stream:
        shape, fortran, dtype = HEADERS[np.lib.format.read_magic(stream)](stream)
        if dtype.kind not in "biuf" or min(shape, default=0) < 0:
            raise ValueError(f"{name} holds something else than numbers")
        data = stream.read()  # no more than the zip says, which is bounded; and its checksum
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{name}: {len(data)} bytes for {shape} of {dtype}")
    values: NDArray[Any] = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
    if values.size and not -LARGEST <= values.min() <= values.max() <= LARGEST:
        raise ValueError(f"{name} holds something else than numbers up to {LARGEST:g}")
    return values
