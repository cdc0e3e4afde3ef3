"""The Parquet files of a LeRobot dataset."""

import json
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet


def write(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """One column per feature; rows of vectors as lists of fixed length. Raises OSError."""
    arrays = {}
    for name, values in columns.items():
        flat = pa.array(values.reshape(-1))
        arrays[name] = (
            flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        )
    _write(pa.table(arrays), path)


def write_episodes(lengths: Sequence[int], task: str, path: Path) -> None:
    """Where each episode lies, all of them in the one file of the data. Raises OSError."""
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
    _write(pa.table(table), path)


def write_task(task: str, path: Path) -> None:
    """The tasks by name: a table whose index, as pandas has it, is the name. Raises OSError."""
    index = "__index_level_0__"
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: [task]})
    columns = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64",
         "numpy_type": "int64", "metadata": None},
        {"name": None, "field_name": index, "pandas_type": "unicode",
         "numpy_type": "object", "metadata": None},
    ]  # fmt: skip
    about = {"index_columns": [index], "column_indexes": [], "columns": columns}
    _write(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)


def _write(table: pa.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path)
