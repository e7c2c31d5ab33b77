"""The files of a LeRobot dataset, format v3, as LeRobot 0.6 writes them, without importing it.

Written with PyArrow and JSON alone: LeRobot's own writer goes through temporary PNG files and
Hugging Face's ``datasets`` and takes 20 ms a frame, more than simulating it, and importing it takes
10 to 20 s. The layout is small and versioned; a test compares these files with LeRobot's own.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from hvs_suite.datasets.episode_stats import STAT_NAMES, STAT_ORDER, FeatureStats

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
DATA = "data"
EPISODES = "meta/episodes"
FILES_A_CHUNK = 1000
DATA_FILE_MB = 100
STATS_PREFIX = "stats/"

_VERSION = "v3.0"
_VIDEO_FILE_MB = 200
_COUNTERS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}

Columns = Mapping[str, npt.NDArray[Any] | Sequence[bytes]]
Stats = Mapping[str, FeatureStats]


def numbered(folder: str, number: int) -> str:
    """Path of the file with this number, counted from 0 over all chunks, in ``folder``."""
    chunk, file = divmod(number, FILES_A_CHUNK)
    return f"{folder}/chunk-{chunk:03d}/file-{file:03d}.parquet"


def counters(
    length: int, episode: int, first: int, fps: int, task: int
) -> dict[str, npt.NDArray[Any]]:
    """The columns (n,) that LeRobot adds to those of the features.

    Args:
        length: Frames of the episode.
        episode: Its index.
        first: Index of its first frame in the dataset.
        fps: Frames a second.
        task: Number of its sentence.
    """
    frames = np.arange(length)
    return {
        "timestamp": frames / fps,
        "frame_index": frames,
        "episode_index": np.full(length, episode),
        "index": first + frames,
        "task_index": np.full(length, task),
    }


def is_picture(feature: Mapping[str, Any]) -> bool:
    """Whether a feature holds images."""
    return bool(feature["dtype"] == "image")


def with_counters(features: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The features as ``info.json`` lists them."""
    added = {
        name: {"dtype": dtype, "shape": (1,), "names": None} for name, dtype in _COUNTERS.items()
    }
    return {**features, **added}


def data_schema(features: Mapping[str, dict[str, Any]]) -> pa.Schema:
    """Schema of the data files, with the note that tells Hugging Face's ``datasets`` of images.

    Args:
        features: LeRobot's, counters left out.
    """
    fields, notes = [], {}
    for name, feature in with_counters(features).items():
        note: dict[str, Any]
        if is_picture(feature):
            kind: pa.DataType = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
            note = {"_type": "Image"}
        else:
            kind = pa.bool_() if feature["dtype"] == "bool" else getattr(pa, feature["dtype"])()
            note = {"dtype": feature["dtype"], "_type": "Value"}
            if tuple(feature["shape"]) != (1,):
                [size] = feature["shape"]
                kind = pa.list_(kind, size)
                note = {"feature": note, "length": size, "_type": "List"}
        fields.append(pa.field(name, kind))
        notes[name] = note
    return pa.schema(fields, {"huggingface": json.dumps({"info": {"features": notes}})})


def data_writer(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    """Opens a data file; one row group an episode, as LeRobot has it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Extremes and dictionaries of PNG bytes would only enlarge the file's footer.
    plain = [field.name for field in schema if not pa.types.is_nested(field.type)]
    return pq.ParquetWriter(
        path, schema, compression="snappy", use_dictionary=plain, write_statistics=plain
    )


def data_table(schema: pa.Schema, episodes: Sequence[Columns]) -> pa.Table:
    """The rows of some episodes.

    Args:
        schema: As ``data_schema`` gives it.
        episodes: Feature to values (n, k) or (n,), or to n PNG files, of each episode.
    """
    return pa.Table.from_arrays(
        [_array(field.type, [columns[field.name] for columns in episodes]) for field in schema],
        schema=schema,
    )


def episode_row(episode: int, length: int, first: int, file: int, task: str) -> dict[str, Any]:
    """The row of an episode in ``meta/episodes``, statistics and the place of the row left out.

    Args:
        episode: Its index.
        length: Its frames.
        first: Index of its first frame in the dataset.
        file: Number of its data file.
        task: The task as a sentence.
    """
    chunk, place = divmod(file, FILES_A_CHUNK)
    return {
        "episode_index": episode,
        "tasks": [task],
        "length": length,
        "data/chunk_index": chunk,
        "data/file_index": place,
        "dataset_from_index": first,
        "dataset_to_index": first + length,
    }


def write_episodes(
    root: Path,
    number: int,
    rows: Sequence[Mapping[str, Any]],
    features: Mapping[str, dict[str, Any]],
    stats: Sequence[Stats],
) -> None:
    """Writes a file of ``meta/episodes``.

    Args:
        root: The dataset.
        number: Of the file.
        rows: As ``episode_row`` gives them.
        features: LeRobot's, counters left out.
        stats: Statistics of each episode.
    """
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    for name, feature in with_counters(features).items():
        each = [of_episode[name] for of_episode in stats]
        values = np.stack([one.values for one in each])
        listed = {
            stat: _lists(values[:, i], picture=is_picture(feature))
            for i, stat in enumerate(STAT_NAMES)
        }
        listed["count"] = _lists(np.array([[one.count] for one in each]), picture=False)
        columns |= {f"{STATS_PREFIX}{name}/{stat}": listed[stat] for stat in STAT_ORDER}
    chunk, file = divmod(number, FILES_A_CHUNK)
    columns["meta/episodes/chunk_index"] = np.full(len(rows), chunk)
    columns["meta/episodes/file_index"] = np.full(len(rows), file)
    path = root / numbered(EPISODES, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def write_tasks(root: Path, tasks: Sequence[str]) -> None:
    """Writes ``meta/tasks.parquet``; pandas takes the sentences for the index."""
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": raw, "metadata": None}
        for name, kind, raw in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    whole = {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [{**whole, "metadata": {"encoding": "UTF-8"}}],
        "columns": described,
        "attributes": {},
        "creator": {"library": "pyarrow", "version": pa.__version__},
    }
    numbers = pa.array(range(len(tasks)), pa.int64())
    table = pa.table({"task_index": numbers, "task": list(tasks)})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), root / TASKS)


def write_stats(root: Path, features: Mapping[str, dict[str, Any]], stats: Stats) -> None:
    """Writes ``meta/stats.json``."""
    content = {
        name: stats[name].named(picture=is_picture(feature))
        for name, feature in with_counters(features).items()
    }
    _write_json(root / STATS, content)


def write_info(
    root: Path,
    features: Mapping[str, dict[str, Any]],
    fps: int,
    robot: str,
    episodes: int,
    frames: int,
    tasks: int,
) -> None:
    """Writes ``meta/info.json``."""
    content = {
        "codebase_version": _VERSION,
        "fps": fps,
        "features": with_counters(features),
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": FILES_A_CHUNK,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": _VIDEO_FILE_MB,
        "data_path": DATA + "/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "robot_type": robot,
        "splits": {"train": f"0:{episodes}"},
    }
    _write_json(root / INFO, content)


def _array(kind: pa.DataType, episodes: Sequence[npt.NDArray[Any] | Sequence[bytes]]) -> pa.Array:
    """A column of some episodes in its type."""
    if pa.types.is_struct(kind):
        names = [f"frame-{frame:06d}.png" for files in episodes for frame in range(len(files))]
        pictures = [picture for files in episodes for picture in files]
        content = [pa.array(pictures, pa.binary()), pa.array(names, pa.string())]
        return pa.StructArray.from_arrays(content, fields=list(kind))
    flat = np.concatenate([np.asarray(values).reshape(-1) for values in episodes])
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(pa.array(flat, kind.value_type), type=kind)
    # PyArrow narrows no float64 by itself.
    return pa.array(flat.astype(kind.to_pandas_dtype(), copy=False), kind)


def _lists(values: npt.NDArray[Any], *, picture: bool) -> pa.Array:
    """A list for each row of values (n, k); of pictures a list of k planes of one pixel."""
    n, k = values.shape
    array = pa.array(values.ravel())
    singles = np.arange(n * k + 1, dtype=np.int32)
    for _ in range(2 * picture):
        array = pa.ListArray.from_arrays(singles, array)
    return pa.ListArray.from_arrays(singles[::k], array)


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")
