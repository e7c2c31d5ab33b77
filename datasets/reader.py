"""Reading a LeRobot dataset's own files, format v3, without importing LeRobot.

LeRobot's dataset package takes some 20 s to import and reads a frame at a time; checking, filming
and sharing need whole episodes. Frames are images in parquet, or videos after a conversion.

A dataset is not trusted: only ordinary files inside its folder are read, of bounded size
(``hvs_suite.reading``), and their contents must have the right types.
"""

import contextlib
import dataclasses
import functools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pydantic

from hvs_suite.errors import DatasetError
from hvs_suite.reading import check_regular, decode_png, read_object, read_parquet, validated

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
EPISODES = "meta/episodes"
DATA_FILE = "data/chunk-{chunk:03d}/file-{file:03d}.parquet"
VIDEO_FILE = "videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
STATS_PREFIX = "stats/"
_PLACE_COLUMNS = (
    "episode_index",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "data/chunk_index",
    "data/file_index",
)
# Values of a frame in one feature: beyond any camera, and still a small file.
_MOST_VALUES = 64 * 2**20
_MOST_SENTENCES = 100
_LONGEST_SENTENCE = 1000

Picture = npt.NDArray[np.uint8]
_Count = Annotated[int, pydantic.Field(ge=0, lt=2**53, strict=True)]
_Side = Annotated[int, pydantic.Field(ge=1, le=_MOST_VALUES, strict=True)]


class DamagedFileError(DatasetError):
    """A file of a dataset that is missing or damaged.

    Args:
        file: The file, relative to the dataset.
        what: What is wrong.
    """

    def __init__(self, file: str, what: str) -> None:
        super().__init__(file, what)
        self.file = file
        self.what = what

    def __str__(self) -> str:
        """One line."""
        return f"{self.file}: {self.what}"


class _Feature(pydantic.BaseModel):
    """A feature of ``meta/info.json``."""

    dtype: Annotated[str, pydantic.Field(max_length=64)]
    shape: Annotated[list[_Side], pydantic.Field(min_length=1, max_length=4)]
    info: dict[str, Any] | None = None

    @pydantic.model_validator(mode="after")
    def _check_size(self) -> "_Feature":
        if math.prod(self.shape) > _MOST_VALUES:
            raise ValueError(f"shape {self.shape} holds more than {_MOST_VALUES:,} values")
        if self.dtype in ("image", "video") and (
            len(self.shape) != 3 or self.shape[2] not in (1, 3)
        ):
            raise ValueError(f"shape {self.shape} is no picture's; write height, width, 1 or 3")
        return self


class _Info(pydantic.BaseModel):
    """What is read of ``meta/info.json``; whatever else is in it stays as it is."""

    codebase_version: Annotated[str, pydantic.Field(pattern=r"^v\d{1,3}\.\d{1,3}$")] = "v3.0"
    features: dict[str, _Feature]
    fps: Annotated[int, pydantic.Field(ge=1, le=10_000, strict=True)]
    total_episodes: _Count
    total_frames: _Count
    # LeRobot would follow any other: out of the dataset, too.
    data_path: Literal["data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"] = (
        "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    )
    video_path: (
        Literal["videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"] | None
    ) = None


@dataclasses.dataclass(frozen=True)
class Place:
    """Where an episode lies.

    Attributes:
        episode: Its index.
        length: Frames.
        start: Index of its first frame in the dataset.
        file: Its data file, relative to the dataset.
        listed_in: The file of ``meta/episodes`` that lists it, relative to the dataset.
        videos: Video feature to (file, time of the first frame in it in s).
    """

    episode: int
    length: int
    start: int
    file: str
    listed_in: str
    videos: Mapping[str, tuple[str, float]]


def read_info(root: Path) -> dict[str, Any]:
    """Reads ``meta/info.json``.

    Raises:
        DatasetError: It is missing or damaged.
    """
    with in_file(root, INFO) as path:
        info = read_object(path, error=DatasetError, within=root)
        validated(_Info, info, path, error=DatasetError)
    return info


def read_stats(root: Path) -> dict[str, Any]:
    """Reads ``meta/stats.json``.

    Raises:
        DatasetError: It is missing or damaged.
    """
    with in_file(root, STATS) as path:
        return read_object(path, error=DatasetError, within=root)


def read_sentences(root: Path) -> list[str]:
    """Sentences of the tasks, in order of their index.

    Raises:
        DatasetError: ``meta/tasks.parquet`` is missing or damaged.
    """
    with in_file(root, TASKS):
        table = read_table(root, TASKS, ["task_index", "task"])
        if table.num_rows > _MOST_SENTENCES:
            raise DatasetError(f"lists {table.num_rows:,} tasks; a recording has a few")
        order = np.argsort(_numbers(table, ["task_index"])["task_index"])
        sentences = [str(table["task"][int(row)].as_py()) for row in order]
        if any(len(sentence) > _LONGEST_SENTENCE for sentence in sentences):
            raise DatasetError(f"holds a sentence of more than {_LONGEST_SENTENCE:,} characters")
        return sentences


def read_places(root: Path) -> list[Place]:
    """Where each episode lies, in the order listed.

    Raises:
        DatasetError: A file of ``meta/episodes`` is missing or damaged, or lists an episode twice.
    """
    files = sorted((root / EPISODES).glob("*/*.parquet"))
    if not files:
        raise DamagedFileError(EPISODES, "is missing")
    places: dict[int, Place] = {}
    for file in files:
        name = file.relative_to(root).as_posix()
        for place in _places_in(root, name):
            if place.episode in places:
                raise DamagedFileError(name, f"lists episode {place.episode} twice")
            places[place.episode] = place
    return list(places.values())


def data_files(root: Path) -> list[Path]:
    """Tabular files of a dataset, in frame order.

    Args:
        root: The dataset.

    Returns:
        The files.

    Raises:
        DatasetError: There are none.
    """
    files = sorted((root / "data").glob("chunk-*/file-*.parquet"))
    if not files:
        raise DatasetError(f"{root} holds no data/chunk-*/file-*.parquet; record it first")
    return files


def read_table(root: Path, name: str, columns: list[str] | None = None) -> pa.Table:
    """Reads one parquet file.

    Args:
        root: The dataset.
        name: The file, relative to it.
        columns: Columns; all by default.

    Raises:
        DatasetError: It is missing or damaged, or lacks a column.
    """
    with in_file(root, name) as path:
        return read_parquet(path, columns, error=DatasetError, within=root)


def read_numbers(root: Path, name: str, columns: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    """Reads columns that hold one number a row.

    Args:
        root: The dataset.
        name: The file, relative to it.
        columns: Their names.

    Returns:
        Column to values (n,), with n from 1 up.

    Raises:
        DatasetError: The file is missing or damaged, or holds no rows or something else in them.
    """
    with in_file(root, name):
        return _numbers(read_table(root, name, list(columns)), columns)


@contextlib.contextmanager
def in_file(root: Path, name: str) -> Iterator[Path]:
    """Names the file of a dataset in what goes wrong with it.

    Args:
        root: The dataset.
        name: The file, relative to it.

    Yields:
        Its path.

    Raises:
        DamagedFileError: There is no such file, or the block raises a ``DatasetError``.
    """
    path = root / name
    if not os.path.lexists(path):
        raise DamagedFileError(name, "is missing")
    try:
        yield path
    except DamagedFileError:
        raise
    except DatasetError as error:
        raise DamagedFileError(name, str(error).removeprefix(f"{path}: ")) from None


def read_episode(root: Path, place: Place) -> pa.Table:
    """The rows of an episode.

    Raises:
        DatasetError: Its data file is missing or damaged.
    """
    return _rows_of(place, _cached_table(root, place.file), place.file)


def listed_statistics(root: Path, place: Place) -> dict[str, dict[str, Any]]:
    """The statistics that LeRobot keeps of an episode: feature, then name, to values.

    Raises:
        DatasetError: Their file is missing or damaged.
    """
    [row] = _rows_of(place, _cached_table(root, place.listed_in), place.listed_in).to_pylist()
    found: dict[str, dict[str, Any]] = {}
    for name, value in row.items():
        if name.startswith(STATS_PREFIX):
            feature, _, statistic = name.removeprefix(STATS_PREFIX).rpartition("/")
            found.setdefault(feature, {})[statistic] = value
    return found


def column(table: pa.Table, name: str) -> npt.NDArray[Any]:
    """A column of numbers as (n, k), or (n,) where a row holds one number.

    Args:
        table: Rows.
        name: The column.

    Returns:
        float64, int64 or bool.

    Raises:
        DatasetError: It is missing, rows differ in length, or hold something else than numbers.
    """
    if name not in table.column_names:
        raise DatasetError(f"lacks the column {name}")
    values = table.column(name).combine_chunks()
    shape: tuple[int, ...] = (len(values),)
    if pa.types.is_nested(values.type):
        if not _is_list(values.type) or values.null_count:
            raise DatasetError(f"{name}: a row holds no numbers")
        lengths = pc.unique(pc.list_value_length(values)).to_pylist()
        if len(lengths) > 1:
            raise DatasetError(f"{name}: rows differ in length")
        width = lengths[0] if lengths else getattr(values.type, "list_size", 0)
        values, shape = values.flatten(), (len(values), width)
    kind = values.type
    if pa.types.is_floating(kind):
        wide: type = np.float64
    elif pa.types.is_integer(kind):
        wide = np.int64
    elif pa.types.is_boolean(kind):
        wide = np.bool_
    else:
        raise DatasetError(f"{name}: holds {kind}, no numbers")
    if values.null_count:
        raise DatasetError(f"{name}: a row holds no number")
    return values.to_numpy(zero_copy_only=False).astype(wide).reshape(shape)


def decode(stored: Any, shape: tuple[int, int, int]) -> Picture:
    """Decodes an image as parquet holds it.

    Args:
        stored: Mapping with the ``bytes`` of a PNG. A ``path`` beside them is not followed: it
            could lead anywhere.
        shape: (H, W, C) that the dataset declares.

    Returns:
        uint8 (H, W, C).

    Raises:
        DatasetError: There is no image, it is damaged, or of another size or kind.
    """
    content = stored.get("bytes") if isinstance(stored, Mapping) else None
    return decode_png(content, shape, error=DatasetError)


def shape_of(info: Mapping[str, Any], key: str) -> tuple[int, int, int]:
    """(H, W, C) of a camera's pictures.

    Args:
        info: As :func:`read_info` reads it.
        key: Feature of the camera.
    """
    height, width, channels = info["features"][key]["shape"]
    return height, width, channels


def decode_video(root: Path, info: Mapping[str, Any], place: Place, key: str) -> list[Picture]:
    """Decodes the frames of one episode from a video.

    Args:
        root: The dataset.
        info: As :func:`read_info` reads it.
        place: The episode.
        key: Feature of the camera.

    Returns:
        uint8 (H, W, 3) each; fewer than the episode has frames where the video ends early.

    Raises:
        DatasetError: It is missing or damaged, or of another size than the dataset declares.
    """
    import av

    file, start_s = place.videos[key]
    fps, shape = info["fps"], shape_of(info, key)
    pictures: list[Picture] = []
    with in_file(root, file) as path:
        check_regular(path, error=DatasetError, within=root)
    try:
        with av.open(str(root / file)) as container:
            if len(container.streams.video) != 1:
                raise DamagedFileError(file, "holds not one video")
            [stream] = container.streams.video
            if (stream.height, stream.width, 3) != shape:
                size = f"{stream.width} x {stream.height} px"
                raise DamagedFileError(file, f"is {size}, not {shape[1]} x {shape[0]} px")
            container.seek(round(start_s / (stream.time_base or 1)), stream=stream)
            for frame in container.decode(stream):
                if frame.time is None or frame.time < start_s - 0.5 / fps:
                    continue
                pictures.append(np.asarray(frame.to_ndarray(format="rgb24"), np.uint8))
                if len(pictures) == place.length:
                    break
    except (av.FFmpegError, ValueError, OSError, OverflowError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DamagedFileError(file, f"cannot be decoded ({_short(error)})") from None
    return pictures


def read_pictures(
    root: Path, info: Mapping[str, Any], place: Place, table: pa.Table, key: str
) -> list[Picture]:
    """All pictures of one camera in an episode, wherever they are stored.

    Args:
        root: The dataset.
        info: As :func:`read_info` reads it.
        place: The episode.
        table: Its rows.
        key: Feature of the camera.

    Returns:
        uint8 (H, W, 3) each.

    Raises:
        DatasetError: One is missing or damaged; the text names the frame.
    """
    if key in place.videos:
        return decode_video(root, info, place, key)
    if key not in table.column_names:
        raise DamagedFileError(place.file, f"lacks the column {key}")
    shape = shape_of(info, key)
    pictures = []
    for frame, stored in enumerate(table.column(key)):
        try:
            pictures.append(decode(stored.as_py(), shape))
        except DatasetError as error:
            what = f"episode {place.episode}, frame {frame}: {key} {error}"
            raise DamagedFileError(place.file, what) from None
    return pictures


def _cached_table(root: Path, name: str) -> pa.Table:
    """A whole file: it holds many episodes, which are read one after the other."""
    with in_file(root, name) as path:
        check_regular(path, error=DatasetError, within=root)
        # The time of the last change is part of the key, because a dataset may be repaired and read
        # again.
        return _cached_table_as_of(root, name, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=2)
def _cached_table_as_of(root: Path, name: str, _changed: int) -> pa.Table:
    return read_table(root, name)


def _rows_of(place: Place, table: pa.Table, name: str) -> pa.Table:
    """The rows of an episode in a table of many."""
    try:
        index = _numbers(table, ["episode_index"])["episode_index"]
    except DatasetError as error:
        raise DamagedFileError(name, str(error)) from None
    return table.filter(pa.array(index == place.episode))


def _numbers(table: pa.Table, columns: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    """See :func:`read_numbers`."""
    if not table.num_rows:
        raise DatasetError("holds no rows")
    numbers = {name: column(table, name) for name in columns}
    for name, values in numbers.items():
        if values.ndim != 1:
            raise DatasetError(f"{name}: a row holds no number")
    return numbers


def _places_in(root: Path, name: str) -> Iterator[Place]:
    """The episodes that one file of ``meta/episodes`` lists."""
    with in_file(root, name):
        table = read_table(root, name)
        videos = [each.split("/")[1] for each in table.column_names if _is_video_time(each)]
        numbers = _numbers(table, _PLACE_COLUMNS)
        for each, values in numbers.items():
            if values.dtype != np.int64 or (values < 0).any():
                raise DatasetError(f"{each}: a row holds no number from 0 up")
        for row in range(table.num_rows):
            of_row = {each: int(values[row]) for each, values in numbers.items()}
            found = {key: _video(table, key, row) for key in videos}
            yield _place(of_row, {k: each for k, each in found.items() if each}, name)


def _place(row: Mapping[str, int], videos: dict[str, tuple[str, float]], listed_in: str) -> Place:
    episode, length = row["episode_index"], row["length"]
    start, end = row["dataset_from_index"], row["dataset_to_index"]
    if end - start != length:
        raise DatasetError(f"episode {episode} has {length} frames, from {start} to {end}")
    return Place(
        episode=episode,
        length=length,
        start=start,
        file=DATA_FILE.format(chunk=row["data/chunk_index"], file=row["data/file_index"]),
        listed_in=listed_in,
        videos=videos,
    )


def _is_video_time(name: str) -> bool:
    return name.startswith("videos/") and name.endswith("/from_timestamp") and name.count("/") == 2


def _video(table: pa.Table, key: str, row: int) -> tuple[str, float] | None:
    """File and time (s) of an episode's first frame in it; None where it has no video."""
    chunk, file, start_s = (
        table[f"videos/{key}/{each}"][row].as_py()
        if f"videos/{key}/{each}" in table.column_names
        else None
        for each in ("chunk_index", "file_index", "from_timestamp")
    )
    if chunk is None or file is None:
        return None
    if not (isinstance(chunk, int) and isinstance(file, int) and isinstance(start_s, float)):
        raise DatasetError(f"the place of the video {key} is no number")
    if not math.isfinite(start_s):
        raise DatasetError(f"the video {key} begins at {start_s} s")
    return VIDEO_FILE.format(key=key, chunk=chunk, file=file), start_s


def _is_list(kind: pa.DataType) -> bool:
    types = pa.types
    return bool(types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind))


def _short(error: Exception) -> str:
    """The first line of a library's complaint."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:120]
