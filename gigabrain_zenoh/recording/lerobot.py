"""Converts a recording into a LeRobot dataset: format version 3.0, as lerobot 0.4 reads it.

A frame is a tenth of a second of the robot's time. An episode lasts while the gate is enabled
without a gap. Pictures and depth become videos.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY
from gigabrain_schemas.topics import STATE as STATE_TOPIC
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording.bag_reader import Bag, samples
from gigabrain_zenoh.recording.lerobot_video import VIDEO_PATH, VideoFeature, write_videos
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
LATERAL = "linear_y"
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


def columns(
    row: list[LeRobotFrame], episode: int, first: int, *, lateral: bool = True
) -> dict[str, NDArray[Any]]:
    """Return an episode's columns; `first` is the number of its first frame in the dataset.

    Without `lateral` the speed to the side is left out.
    """
    count = np.arange(len(row), dtype=np.int64)
    found: dict[str, NDArray[Any]] = {
        STATE: np.stack([frame.state for frame in row])[:, _kept(STATE_NAMES, lateral)],
        ACTION: np.stack([frame.action for frame in row])[:, _kept(ACTION_NAMES, lateral)],
        "timestamp": (count / FRAME_HZ).astype(np.float32),
        "frame_index": count,
        "episode_index": np.full(len(row), episode, np.int64),
        "index": count + first,
        "task_index": np.zeros(len(row), np.int64),
    }
    if len(row[0].scan):
        found[SCAN] = np.stack([frame.scan for frame in row])
    return found


def _kept(names: Sequence[str], lateral: bool) -> list[int]:
    """Return which values of a vector the dataset has."""
    return [number for number, name in enumerate(names) if lateral or name != LATERAL]


def features(beams: int, *, lateral: bool = True) -> dict[str, dict[str, Any]]:
    """Return the format's description of the columns."""
    state, action = (
        [names[number] for number in _kept(names, lateral)] for names in (STATE_NAMES, ACTION_NAMES)
    )
    found: dict[str, dict[str, Any]] = {
        STATE: {"dtype": "float32", "shape": [len(state)], "names": state},
        ACTION: {"dtype": "float32", "shape": [len(action)], "names": action},
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
    robot_type, lateral = _body(path)
    for episode, row in enumerate(rows):
        tables.append(columns(row, episode, first, lateral=lateral))
        first += len(row)
    whole = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    ticks = [(frame.boot, frame.tick) for row in rows for frame in row]
    try:
        folder.mkdir(parents=True)
        videos = write_videos(path, ticks, folder, FRAME_HZ)
        _write_columns(whole, folder / "data" / FILE)
        _write_episodes([len(row) for row in rows], videos, folder / "meta/episodes" / FILE)
        _write_task(TASK, folder / "meta/tasks.parquet")
        info = {
            "codebase_version": VERSION,
            "robot_type": robot_type,
            "total_episodes": len(rows),
            "total_frames": first,
            "total_tasks": 1,
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": FRAME_HZ,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": VIDEO_PATH if videos else None,
            "features": features(len(rows[0][0].scan), lateral=lateral)
            | {video.key: video.feature for video in videos},
        }
        stats = statistics(whole) | {video.key: video.statistics for video in videos}
        (folder / "meta/info.json").write_text(json.dumps(info, indent=4))
        (folder / "meta/stats.json").write_text(json.dumps(stats, indent=4))
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None
    found = [f"{folder}: {len(rows)} episodes, {first} frames"]
    return "\n  ".join(found + [video.summary for video in videos])


def _body(path: Path) -> tuple[str | None, bool]:
    """Return the type of the recorded body, and whether it can move to the side, if known."""
    robot_type = None
    for sample in Bag(path):
        message = message_of(sample) if sample.key in (BODY.key, STATE_TOPIC.key) else None
        if isinstance(message, Body):
            return message.description.robot_type, message.description.max_lateral_speed > 0
        if isinstance(message, RobotState):
            robot_type = message.robot_type
    return robot_type, True


def _write_columns(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write one column per feature; vectors as lists of fixed length. Raises OSError."""
    arrays = {}
    for name, values in columns.items():
        flat = pa.array(values.reshape(-1))
        arrays[name] = (
            flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        )
    _write_table(pa.table(arrays), path)


def _write_episodes(lengths: Sequence[int], videos: Sequence[VideoFeature], path: Path) -> None:
    """Write the rows of each episode in the data file, and its time in videos. Raises OSError."""
    ends, zeros = list(accumulate(lengths)), [0] * len(lengths)
    table: dict[str, list[Any]] = {
        "episode_index": list(range(len(lengths))),
        "tasks": [[TASK]] * len(lengths),
        "length": list(lengths),
        "data/chunk_index": zeros,
        "data/file_index": zeros,
        "dataset_from_index": [0, *ends[:-1]],
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros,
    }
    for key in (video.key for video in videos):
        table |= {
            f"videos/{key}/chunk_index": zeros,
            f"videos/{key}/file_index": zeros,
            f"videos/{key}/from_timestamp": [start / FRAME_HZ for start in [0, *ends[:-1]]],
            f"videos/{key}/to_timestamp": [end / FRAME_HZ for end in ends],
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
