"""Converts a recording into a LeRobot dataset: format version 3.0, as lerobot 0.4 reads it.

A frame is a tenth of a second of the robot's time. An episode lasts while the gate is enabled
without a gap. Images are left out.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording.bag_reader import Bag, samples
from gigabrain_zenoh.recording.message_tables import message_of

try:
    import pyarrow as pa
    from pyarrow import parquet
except ModuleNotFoundError:
    raise ConfigError("datasets need pyarrow: pip install 'gigabrain-zenoh[lerobot]'") from None

FRAME_HZ, TICKS_PER_FRAME = 10, 5
VERSION, TASK = "v3.0", "drive"
STATE, SCAN, ACTION = "observation.state", "observation.environment_state", "action"
STATE_NAMES = ("x", "y", "yaw", "linear_x", "linear_y", "angular_z")
ACTION_NAMES = ("linear_x", "linear_y", "angular_z")
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
FILE = "chunk-000/file-000.parquet"
Floats = NDArray[np.float32]


class LeRobotFrame(Struct, frozen=True, kw_only=True):
    """Observation of the robot, and the command that it received."""

    boot: int
    tick: int
    state: Floats  # (6,)
    scan: Floats  # (n,), [m]; the lidar's range where nothing was hit, 0 where unknown
    action: Floats  # (3,), [m/s], [m/s], [rad/s]


def frames(path: Path) -> Iterator[LeRobotFrame]:
    """Iterate over every fifth state of an enabled gate, with the newest scan and command."""
    scan, action = np.empty(0, np.float32), np.zeros(3, np.float32)
    for sample in samples(path):
        message = message_of(sample)
        if isinstance(message, LaserScan):
            seen = np.minimum(message.ranges_m, np.float32(message.range_max))
            scan = np.nan_to_num(seen, nan=0.0)
        elif isinstance(message, CmdVel):
            speeds = (message.linear_x, message.linear_y, message.angular_z)
            action = np.array(speeds, np.float32)
        elif isinstance(message, RobotState) and message.gate.mode == "enabled":
            if message.tick % TICKS_PER_FRAME:
                continue
            pose, speed = message.pose, message.velocity
            known = (pose.x, pose.y, pose.yaw, speed.linear_x, speed.linear_y, speed.angular_z)
            state = np.array(known, np.float32)
            yield LeRobotFrame(
                boot=message.boot, tick=message.tick, state=state, scan=scan, action=action
            )


def episodes(path: Path) -> list[list[LeRobotFrame]]:
    """Return the frames in unbroken rows of two or more. Raises ConfigError if there are none."""
    rows: list[list[LeRobotFrame]] = []
    for frame in frames(path):
        last = rows[-1][-1] if rows else None
        follows = last and (last.boot, last.tick + TICKS_PER_FRAME) == (frame.boot, frame.tick)
        if follows and last and last.scan.shape == frame.scan.shape:
            rows[-1].append(frame)
        else:
            rows.append([frame])
    beams = max((len(row[0].scan) for row in rows), default=0)
    rows = [row for row in rows if len(row) > 1 and len(row[0].scan) == beams]
    if not rows:
        raise ConfigError(f"{path} holds no drive: the gate was never enabled")
    return rows


def columns(row: list[LeRobotFrame], episode: int, first: int) -> dict[str, NDArray[Any]]:
    """Return an episode's columns; `first` is the number of its first frame in the dataset."""
    count = np.arange(len(row), dtype=np.int64)
    found: dict[str, NDArray[Any]] = {
        STATE: np.stack([frame.state for frame in row]),
        ACTION: np.stack([frame.action for frame in row]),
        "timestamp": (count / FRAME_HZ).astype(np.float32),
        "frame_index": count,
        "episode_index": np.full(len(row), episode, np.int64),
        "index": count + first,
        "task_index": np.zeros(len(row), np.int64),
    }
    if len(row[0].scan):
        found[SCAN] = np.stack([frame.scan for frame in row])
    return found


def features(beams: int) -> dict[str, dict[str, Any]]:
    """Return the format's description of the columns."""
    found: dict[str, dict[str, Any]] = {
        STATE: {"dtype": "float32", "shape": [6], "names": list(STATE_NAMES)},
        ACTION: {"dtype": "float32", "shape": [3], "names": list(ACTION_NAMES)},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in COUNTERS},
    }
    if beams:
        names = [f"beam_{i}" for i in range(beams)]
        found[SCAN] = {"dtype": "float32", "shape": [beams], "names": names}
    return found


def statistics(data: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, list[float]]]:
    """Return the statistics of each column over its frames."""
    found = {}
    for name, values in data.items():
        table = values.reshape(len(values), -1).astype(np.float64)
        found[name] = {
            "min": table.min(0).tolist(),
            "max": table.max(0).tolist(),
            "mean": table.mean(0).tolist(),
            "std": table.std(0).tolist(),
            "count": [len(table)],
        }
    return found


def convert(path: Path, folder: Path) -> str:
    """Write the dataset into a new folder; return a summary in words. Raises ConfigError."""
    rows, tables, first = episodes(path), [], 0
    for episode, row in enumerate(rows):
        tables.append(columns(row, episode, first))
        first += len(row)
    whole = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    state = next((m for m in map(message_of, Bag(path)) if isinstance(m, RobotState)), None)
    info = {
        "codebase_version": VERSION,
        "robot_type": state.robot_type if state else None,
        "total_episodes": len(rows),
        "total_frames": first,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FRAME_HZ,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features(len(rows[0][0].scan)),
    }
    try:
        folder.mkdir(parents=True)
        _write_columns(whole, folder / "data" / FILE)
        _write_episodes([len(row) for row in rows], TASK, folder / "meta/episodes" / FILE)
        _write_task(TASK, folder / "meta/tasks.parquet")
        (folder / "meta/info.json").write_text(json.dumps(info, indent=4))
        (folder / "meta/stats.json").write_text(json.dumps(statistics(whole), indent=4))
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None
    return f"{folder}: {len(rows)} episodes, {first} frames"


def _write_columns(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write one column per feature; vectors as lists of fixed length. Raises OSError."""
    arrays = {}
    for name, values in columns.items():
        flat = pa.array(values.reshape(-1))
        arrays[name] = (
            flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        )
    _write_table(pa.table(arrays), path)


def _write_episodes(lengths: Sequence[int], task: str, path: Path) -> None:
    """Write the range of rows of each episode in the data file. Raises OSError."""
    ends, zeros = list(accumulate(lengths)), [0] * len(lengths)
    table = {
        "episode_index": list(range(len(lengths))),
        "tasks": [[task]] * len(lengths),
        "length": list(lengths),
        "data/chunk_index": zeros,
        "data/file_index": zeros,
        "dataset_from_index": [0, *ends[:-1]],
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros,
    }
    _write_table(pa.table(table), path)


def _write_task(task: str, path: Path) -> None:
    """Write the tasks: a table whose index, as pandas stores it, is the name. Raises OSError."""
    index = "__index_level_0__"
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: [task]})
    columns = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64",
         "numpy_type": "int64", "metadata": None},
        {"name": None, "field_name": index, "pandas_type": "unicode",
         "numpy_type": "object", "metadata": None},
    ]  # fmt: skip
    pandas = {"index_columns": [index], "column_indexes": [], "columns": columns}
    _write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _write_table(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path)
