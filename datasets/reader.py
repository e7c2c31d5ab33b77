"""Reading a LeRobot dataset's own files, format v3, without importing LeRobot.

LeRobot's dataset package takes some 20 s to import and reads a frame at a time; checking, filming
and sharing need whole episodes. Frames are images in parquet, or videos after a conversion.
"""

import dataclasses
import functools
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from hvs_suite.errors import DatasetError

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
EPISODES = "meta/episodes"
DATA_FILE = "data/chunk-{chunk:03d}/file-{file:03d}.parquet"
VIDEO_FILE = "videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
STATS_PREFIX = "stats/"

Picture = npt.NDArray[np.uint8]


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
    info = _read_json(root, INFO)
    for name, kind in (("features", dict), ("fps", int), ("total_episodes", int)):
        if not isinstance(info.get(name), kind):
            raise DatasetError(f"{INFO} is damaged: it lacks {name}")
    return info


def read_stats(root: Path) -> dict[str, Any]:
    """Reads ``meta/stats.json``.

    Raises:
        DatasetError: It is missing or damaged.
    """
    return _read_json(root, STATS)


def read_sentences(root: Path) -> list[str]:
    """Sentences of the tasks, in order of their index.

    Raises:
        DatasetError: ``meta/tasks.parquet`` is missing or damaged.
    """
    rows = read_table(root, TASKS).to_pylist()
    try:
        return [str(row["task"]) for row in sorted(rows, key=lambda row: row["task_index"])]
    except (KeyError, TypeError) as error:
        raise DatasetError(f"{TASKS} is damaged: it lacks {error}") from None


def read_places(root: Path) -> list[Place]:
    """Where each episode lies, in the order listed.

    Raises:
        DatasetError: A file of ``meta/episodes`` is missing or damaged.
    """
    files = sorted((root / EPISODES).glob("*/*.parquet"))
    if not files:
        raise DatasetError(f"{EPISODES} is missing")
    places = []
    for file in files:
        name = file.relative_to(root).as_posix()
        try:
            names = pq.read_schema(file).names
            wanted = [n for n in names if not n.startswith(STATS_PREFIX)]
            rows = pq.read_table(file, columns=wanted).to_pylist()
            places += [_place(row, name) for row in rows]
        except (pa.ArrowException, OSError) as error:
            raise DatasetError(f"{name} cannot be read ({_short(error)})") from None
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{name} is damaged: {error}") from None
    return places


def read_table(root: Path, name: str, columns: list[str] | None = None) -> pa.Table:
    """Reads one parquet file.

    Args:
        root: The dataset.
        name: The file, relative to it.
        columns: Columns; all by default.

    Raises:
        DatasetError: It is missing or damaged.
    """
    if not (root / name).is_file():
        raise DatasetError(f"{name} is missing")
    try:
        return pq.read_table(root / name, columns=columns)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{name} cannot be read ({_short(error)})") from None


def read_episode(root: Path, place: Place) -> pa.Table:
    """The rows of an episode.

    Raises:
        DatasetError: Its data file is missing or damaged.
    """
    table = _cached_table(root, place.file)
    if "episode_index" not in table.column_names:
        raise DatasetError(f"{place.file} lacks the column episode_index")
    mask = np.asarray(table.column("episode_index")) == place.episode
    return table.filter(pa.array(mask))


def listed_statistics(root: Path, place: Place) -> dict[str, dict[str, Any]]:
    """The statistics that LeRobot keeps of an episode: feature, then name, to values.

    Raises:
        DatasetError: Their file is missing or damaged.
    """
    table = _cached_table(root, place.listed_in)
    [row] = table.filter(pa.array(np.asarray(table["episode_index"]) == place.episode)).to_pylist()
    found: dict[str, dict[str, Any]] = {}
    for name, value in row.items():
        if name.startswith(STATS_PREFIX):
            feature, _, statistic = name.removeprefix(STATS_PREFIX).rpartition("/")
            found.setdefault(feature, {})[statistic] = value
    return found


def column(table: pa.Table, name: str) -> npt.NDArray[Any]:
    """A column of numbers as (n, k), or (n,) where a row holds one number.

    Raises:
        DatasetError: Rows differ in length, or hold nothing.
    """
    try:
        values = np.array(table.column(name).to_pylist())
    except ValueError:
        raise DatasetError(f"{name}: rows differ in length") from None
    if values.dtype == object:
        raise DatasetError(f"{name}: a row holds no number")
    return values


def decode(stored: Mapping[str, Any] | None) -> Picture:
    """Decodes an image as parquet holds it.

    Args:
        stored: ``bytes`` of a PNG.

    Returns:
        uint8 (H, W, 3).

    Raises:
        DatasetError: There is no image, or it is damaged.
    """
    from PIL import Image

    if not stored or not stored.get("bytes"):
        raise DatasetError("holds no image")
    try:
        with Image.open(io.BytesIO(stored["bytes"])) as image:
            # Anything else than 8-bit RGB would be converted silently.
            if image.mode != "RGB":
                raise DatasetError(f"is an image of mode {image.mode}, not RGB")
            return np.asarray(image)
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"cannot be decoded ({_short(error)})") from None


def decode_video(root: Path, file: str, start_s: float, length: int, fps: int) -> list[Picture]:
    """Decodes the frames of one episode from a video.

    Args:
        root: The dataset.
        file: The video, relative to it.
        start_s: Time of the episode's first frame in it (s).
        length: Frames of the episode.
        fps: Frames a second.

    Returns:
        uint8 (H, W, 3) each; fewer than ``length`` where the video ends early.

    Raises:
        DatasetError: It is missing or damaged.
    """
    import av

    if not (root / file).is_file():
        raise DatasetError(f"{file} is missing")
    pictures: list[Picture] = []
    try:
        with av.open(str(root / file)) as container:
            [stream] = container.streams.video
            container.seek(round(start_s / (stream.time_base or 1)), stream=stream)
            for frame in container.decode(stream):
                if frame.time is None or frame.time < start_s - 0.5 / fps:
                    continue
                pictures.append(np.asarray(frame.to_ndarray(format="rgb24"), np.uint8))
                if len(pictures) == length:
                    break
    except (av.FFmpegError, ValueError, OSError) as error:
        raise DatasetError(f"{file} cannot be decoded ({_short(error)})") from None
    return pictures


def read_pictures(root: Path, place: Place, table: pa.Table, key: str, fps: int) -> list[Picture]:
    """All pictures of one camera in an episode, wherever they are stored.

    Args:
        root: The dataset.
        place: The episode.
        table: Its rows.
        key: Feature of the camera.
        fps: Frames a second.

    Returns:
        uint8 (H, W, 3) each.

    Raises:
        DatasetError: One is missing or damaged; the text names the frame.
    """
    if key in place.videos:
        file, start_s = place.videos[key]
        return decode_video(root, file, start_s, place.length, fps)
    if key not in table.column_names:
        raise DatasetError(f"{place.file} lacks the column {key}")
    pictures = []
    for frame, stored in enumerate(table.column(key).to_pylist()):
        try:
            pictures.append(decode(stored))
        except DatasetError as error:
            raise DatasetError(
                f"{place.file}: episode {place.episode}, frame {frame}: {key} {error}"
            ) from None
    return pictures


def _cached_table(root: Path, name: str) -> pa.Table:
    """A whole file: it holds many episodes, which are read one after the other."""
    path = root / name
    # The time of the last change is part of the key: a dataset may be mended and read again.
    changed = path.stat().st_mtime_ns if path.is_file() else 0
    return _cached_table_as_of(root, name, changed)


@functools.lru_cache(maxsize=2)
def _cached_table_as_of(root: Path, name: str, _changed: int) -> pa.Table:
    return read_table(root, name)


def _place(row: Mapping[str, Any], listed_in: str) -> Place:
    start, end = int(row["dataset_from_index"]), int(row["dataset_to_index"])
    if end - start != int(row["length"]):
        raise ValueError(
            f"episode {row['episode_index']} has {row['length']} frames, from {start} to {end}"
        )
    videos = {}
    for name in row:
        if name.startswith("videos/") and name.endswith("/from_timestamp"):
            key = name.split("/")[1]
            chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
            if chunk is not None and file is not None:
                path = VIDEO_FILE.format(key=key, chunk=int(chunk), file=int(file))
                videos[key] = (path, float(row[name]))
    return Place(
        episode=int(row["episode_index"]),
        length=int(row["length"]),
        start=start,
        file=DATA_FILE.format(chunk=int(row["data/chunk_index"]), file=int(row["data/file_index"])),
        listed_in=listed_in,
        videos=videos,
    )


def _read_json(root: Path, name: str) -> dict[str, Any]:
    try:
        content = json.loads((root / name).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DatasetError(f"{name} is missing") from None
    except (OSError, ValueError) as error:
        raise DatasetError(f"{name} is damaged ({_short(error)})") from None
    if not isinstance(content, dict):
        raise DatasetError(f"{name} is damaged: it holds no JSON object")
    return content


def _short(error: Exception) -> str:
    """The first line of a library's complaint."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:120]
