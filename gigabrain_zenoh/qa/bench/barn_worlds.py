"""The worlds of BARN and DynaBARN: where the obstacles are, and when."""

import json
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.errors import ConfigError

Floats = NDArray[np.float64]

FASTEST = 2.0  # [m/s], which the optimal time goes by
DYNAMIC_LENGTH = 20.0  # [m], of every path in DynaBARN
PATH_CELL, PATH_X, PATH_Y = 0.15, -4.575, 5.075  # [m], from a cell of the path to the world


class Moving(NamedTuple):
    """A disc on its way between key frames, over and over."""

    duration: float  # [s]
    keys: Floats  # (k, 3): time [s], x, y [m]
    radius: float  # [m]


class World(NamedTuple):
    """One world."""

    number: int  # in the original set
    posts: Floats  # (n, 3): x, y, radius [m]
    movers: tuple[Moving, ...]
    start: tuple[float, float, float]  # x, y [m], yaw [rad]
    goal: tuple[float, float]  # [m]
    length: float  # [m], of the reference path

    def discs(self, at: float) -> Floats:
        """All obstacles at a time [s]: (n, 3), x, y, radius [m]."""
        if not self.movers:
            return self.posts
        rows = [(*_position(mover, at), mover.radius) for mover in self.movers]
        return np.concatenate([self.posts, np.array(rows).reshape(-1, 3)])


def _position(mover: Moving, at: float) -> tuple[float, float]:
    times, xs, ys = mover.keys.T
    now = at % mover.duration
    return float(np.interp(now, times, xs)), float(np.interp(now, times, ys))


def read_worlds(file: Path, dynamic: bool) -> list[World]:
    """The worlds in `file`. Raises ConfigError for what is no such file."""
    try:
        return _read_dynamic(file) if dynamic else _read_static(file)
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, EOFError) as error:
        kind = "DynaBARN worlds (JSON)" if dynamic else "BARN worlds (npz)"
        raise ConfigError(f"{file}: expected {kind}: {error}") from None


def _read_static(file: Path) -> list[World]:
    data = np.load(file, allow_pickle=False)
    meta = json.loads(str(data["meta"]))
    start = cast("tuple[float, float, float]", tuple(map(float, meta["start"])))
    goal = float(meta["goal"][0]), float(meta["goal"][1])
    posts = np.split(data["cyl"].astype(np.float64), np.cumsum(data["n_cyl"])[:-1])
    cells = np.split(data["path_cells"], np.cumsum(data["n_path"])[:-1])
    worlds = []
    for index, mine, path in zip(data["index"].tolist(), posts, cells, strict=True):
        points = np.vstack([start[:2], path * PATH_CELL + (PATH_X, PATH_Y), goal])
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        worlds.append(World(index, mine, (), start, goal, length))
    return worlds


def _read_dynamic(file: Path) -> list[World]:
    data = json.loads(file.read_bytes())
    radius = float(data["meta"]["radius"])
    movers = {
        name: Moving(float(duration), np.array(keys, dtype=np.float64).reshape(-1, 3), radius)
        for name, (duration, keys) in data["plugins"].items()
    }
    start, goal = (11.0, 0.0, 3.14), (-9.0, 0.0)
    none = np.empty((0, 3))
    return [
        World(index, none, tuple(movers[name] for name in names), start, goal, DYNAMIC_LENGTH)
        for index, names in zip(data["index"], data["worlds"], strict=True)
    ]


def choose(worlds: list[World], only: str) -> list[World]:
    """Those whose numbers are in `only`, separated by commas; all where that is empty."""
    if not only:
        return worlds
    known = {world.number: world for world in worlds}
    try:
        return [known[int(number)] for number in only.split(",")]
    except ValueError:
        raise ConfigError(f"--only: expected numbers like 1,7, got {only!r}") from None
    except KeyError as error:
        some = f"it has {len(known)}, from {min(known)} to {max(known)}"
        raise ConfigError(f"--only: no world {error} in the file; {some}") from None
