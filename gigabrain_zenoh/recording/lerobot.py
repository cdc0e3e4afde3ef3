"""Converts a recording into a LeRobot dataset: format version 3.0, which lerobot 0.4 reads.

It has 10 frames per second of the robot's time, and 25 for an arm. An episode lasts while the gate
is enabled without a gap. Pictures and depth become videos.
"""

import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_S, Velocity
from gigabrain_schemas.body import Body, JointDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import BODY
from gigabrain_schemas.topics import STATE as STATE_TOPIC
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.pose import velocity_of
from gigabrain_zenoh.host.files import cannot_write
from gigabrain_zenoh.recording.bag_reader import Bag, samples
from gigabrain_zenoh.recording.lerobot_video import VIDEO_PATH, VideoFeature, write_videos
from gigabrain_zenoh.recording.message_tables import message_of

try:
    import pyarrow as pa
    from pyarrow import parquet
except ModuleNotFoundError:
    raise ConfigError("datasets need pyarrow: pip install 'gigabrain-zenoh[lerobot]'") from None

TICKS_PER_FRAME, ARM_TICKS_PER_FRAME = 5, 2
VERSION, TASK = "v3.0", "drive"
STATE, SCAN, ACTION = "observation.state", "observation.environment_state", "action"
BASE_STATE = ("x", "y", "yaw", "linear_x", "linear_y", "angular_z")
BASE_ACTION = ("linear_x", "linear_y", "angular_z")
LATERAL = "linear_y"
GRIPPER_OPEN = 100.0  # [%], in LeRobot's convention; 0 is closed
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
FILE = "chunk-000/file-000.parquet"
Floats = NDArray[np.float32]


class Layout(Struct, frozen=True, kw_only=True):
    """The parts of a body that a dataset contains."""

    robot_type: str | None = None
    base: bool = True
    lateral: bool = True  # the base can move sideways
    joints: tuple[JointDescription, ...] = ()

    @property
    def ticks(self) -> int:
        """Return the length of a frame [ticks]."""
        return ARM_TICKS_PER_FRAME if self.joints else TICKS_PER_FRAME

    @property
    def hz(self) -> int:
        """Return the frame rate."""
        return round(1 / (self.ticks * TICK_S))

    @property
    def joint_names(self) -> list[str]:
        """Return the names of the joints' values, in LeRobot's convention."""
        return [f"{joint.name}.pos" for joint in self.joints]

    def of_base(self, names: Sequence[str]) -> list[str]:
        """Return those `names` of the base's values that the dataset contains."""
        return [name for name in names if self.base and (self.lateral or name != LATERAL)]

    def degrees(self, places: Sequence[float]) -> list[float]:
        """Return positions of all joints, given in [rad] or [m], in LeRobot's units.

        These are degrees, millimetres for joints that slide, and per cent for a gripper.
        """
        found = []
        for joint, place in zip(self.joints, places, strict=True):
            if joint.part == "gripper":
                found.append(GRIPPER_OPEN * (place - joint.lower) / (joint.upper - joint.lower))
            else:
                found.append(place * 1e3 if joint.unit == "m" else math.degrees(place))
        return found


class LeRobotFrame(Struct, frozen=True, kw_only=True):
    """Observation of the robot, and the command that it received."""

    boot: int
    tick: int
    state: Floats  # see Layout and BASE_STATE
    scan: Floats  # (n,), [m]; the lidar's range for beams without a hit, 0 for unknown ones
    action: Floats  # of the base [m/s], [m/s], [rad/s], then commanded positions of the joints


def frames(path: Path, layout: Layout | None = None) -> Iterator[LeRobotFrame]:
    """Iterate over the states of an enabled gate, with the newest scan and command.

    Only the command of the gate's commander counts; others may publish as well.
    """
    layout = layout or layout_of(path)
    scan, command, commander = np.empty(0, np.float32), Velocity(), ""
    for sample in samples(path):
        message = message_of(sample)
        if isinstance(message, LaserScan):
            seen = np.minimum(message.ranges_m, np.float32(message.range_max))
            scan = np.nan_to_num(seen, nan=0.0)
        elif isinstance(message, CmdVel) and message.source == commander:
            command = velocity_of(message)
        elif isinstance(message, RobotState):
            if message.gate.commander != commander:
                command, commander = Velocity(), message.gate.commander
            due = message.gate.mode == "enabled" and message.tick % layout.ticks == 0
            values = _values(layout, message, command) if due else None
            if values:
                state, action = (np.array(one, np.float32) for one in values)
                yield LeRobotFrame(
                    boot=message.boot, tick=message.tick, state=state, scan=scan, action=action
                )


def _values(
    layout: Layout, state: RobotState, command: Velocity
) -> tuple[list[float], list[float]] | None:
    """Return the observation and the action; None if a joint is missing."""
    pose, speed = state.pose, state.velocity
    base = {
        "x": pose.x, "y": pose.y, "yaw": pose.yaw,
        "linear_x": speed.linear_x, "linear_y": speed.linear_y, "angular_z": speed.angular_z,
    }  # fmt: skip
    observed = [base[name] for name in layout.of_base(BASE_STATE)]
    wanted = [getattr(command, name) for name in layout.of_base(BASE_ACTION)]
    if not layout.joints:
        return observed, wanted
    measured = {joint.name: joint.position for joint in state.joints}
    places = [measured[joint.name] for joint in layout.joints if joint.name in measured]
    if not len(places) == len(state.joints_sent) == len(layout.joints):
        return None
    return observed + layout.degrees(places), wanted + layout.degrees(state.joints_sent)


def episodes(path: Path, layout: Layout | None = None) -> list[list[LeRobotFrame]]:
    """Return gapless sequences of two or more frames. Raises ConfigError if there are none."""
    rows: list[list[LeRobotFrame]] = []
    layout = layout or layout_of(path)
    for frame in frames(path, layout):
        last = rows[-1][-1] if rows else None
        follows = last and (last.boot, last.tick + layout.ticks) == (frame.boot, frame.tick)
        if follows and last and last.scan.shape == frame.scan.shape:
            rows[-1].append(frame)
        else:
            rows.append([frame])
    beams = max((len(row[0].scan) for row in rows), default=0)
    rows = [row for row in rows if len(row) > 1 and len(row[0].scan) == beams]
    if not rows:
        raise ConfigError(f"{path} holds no drive: the gate was never enabled")
    return rows


def columns(row: list[LeRobotFrame], episode: int, first: int, hz: int) -> dict[str, NDArray[Any]]:
    """Return an episode's columns; `first` is the number of its first frame in the dataset."""
    count = np.arange(len(row), dtype=np.int64)
    found: dict[str, NDArray[Any]] = {
        STATE: np.stack([frame.state for frame in row]),
        ACTION: np.stack([frame.action for frame in row]),
        "timestamp": (count / hz).astype(np.float32),
        "frame_index": count,
        "episode_index": np.full(len(row), episode, np.int64),
        "index": count + first,
        "task_index": np.zeros(len(row), np.int64),
    }
    if len(row[0].scan):
        found[SCAN] = np.stack([frame.scan for frame in row])
    return found


def features(layout: Layout, beams: int) -> dict[str, dict[str, Any]]:
    """Return the description of the columns for `meta/info.json`."""
    state, action = (
        layout.of_base(names) + layout.joint_names for names in (BASE_STATE, BASE_ACTION)
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
    """Write the dataset into a new folder; return a summary in words. Raises ConfigError.

    If it fails, the folder is removed.
    """
    layout = layout_of(path)
    rows, tables, first = episodes(path, layout), [], 0
    for episode, row in enumerate(rows):
        tables.append(columns(row, episode, first, layout.hz))
        first += len(row)
    whole = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    ticks = [(frame.boot, frame.tick) for row in rows for frame in row]
    with _new_folder(folder):
        videos = write_videos(path, ticks, folder, layout.hz)
        _write_columns(whole, folder / "data" / FILE)
        lengths = [len(row) for row in rows]
        _write_episodes(lengths, videos, layout.hz, folder / "meta/episodes" / FILE)
        _write_task(TASK, folder / "meta/tasks.parquet")
        info = {
            "codebase_version": VERSION,
            "robot_type": layout.robot_type,
            "total_episodes": len(rows),
            "total_frames": first,
            "total_tasks": 1,
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": layout.hz,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": VIDEO_PATH if videos else None,
            "features": features(layout, len(rows[0][0].scan))
            | {video.key: video.feature for video in videos},
        }
        stats = statistics(whole) | {video.key: video.statistics for video in videos}
        (folder / "meta/info.json").write_text(json.dumps(info, indent=4))
        (folder / "meta/stats.json").write_text(json.dumps(stats, indent=4))
    found = [f"{folder}: {len(rows)} episodes, {first} frames"]
    return "\n  ".join(found + [video.summary for video in videos])


@contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    """Make a folder, and remove it if the block fails. Raises ConfigError for an OSError."""
    created = False
    try:
        folder.mkdir(parents=True)
        created = True
        yield
    except BaseException as error:
        if created:
            shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, OSError):
            raise cannot_write(folder, error) from None
        raise


def layout_of(path: Path) -> Layout:
    """Return the layout of a dataset of the recorded body."""
    robot_type = None
    for sample in Bag(path):
        message = message_of(sample) if sample.key in (BODY.key, STATE_TOPIC.key) else None
        if isinstance(message, Body):
            body = message.description
            return Layout(
                robot_type=body.robot_type,
                base=body.has_base,
                lateral=body.max_lateral_speed > 0,
                joints=body.joints,
            )
        if isinstance(message, RobotState):
            robot_type = message.robot_type
    return Layout(robot_type=robot_type)


def _write_columns(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write one column per feature; vectors as lists of fixed length. Raises OSError."""
    arrays = {}
    for name, values in columns.items():
        flat = pa.array(values.reshape(-1))
        arrays[name] = (
            flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        )
    _write_table(pa.table(arrays), path)


def _write_episodes(
    lengths: Sequence[int], videos: Sequence[VideoFeature], hz: int, path: Path
) -> None:
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
            f"videos/{key}/from_timestamp": [start / hz for start in [0, *ends[:-1]]],
            f"videos/{key}/to_timestamp": [end / hz for end in ends],
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
