"""Writing a LeRobot dataset so that a kill loses the episodes of one block at most.

Parquet files have no footer until they are closed: a dataset whose recorder was killed would not
load. So each block of episodes is written into a hidden folder inside the dataset and moved into
place once it is whole, files first and counts last. What stands in place always loads.
"""

import contextlib
import dataclasses
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from hvs_suite.datasets import lerobot_files as files
from hvs_suite.datasets import reader
from hvs_suite.datasets.demonstration import Demonstration
from hvs_suite.datasets.episode_stats import (
    STAT_NAMES,
    FeatureStats,
    Shades,
    column_stats,
    merge_stats,
    shade_stats,
)
from hvs_suite.datasets.features import ROBOT_TYPE
from hvs_suite.errors import DatasetError, OutputError
from hvs_suite.files import only_writer

STAGE = ".recording"
"""Hidden folder inside the dataset that holds the block being written."""
_WAITING_BYTES = 2**20
"""Pictures that wait for each other: making an Arrow table costs more than most episodes do."""
_DATA_PLACE = ("data/chunk_index", "data/file_index")
_EPISODE_PLACE = ("meta/episodes/chunk_index", "meta/episodes/file_index")
# Counts come last: until then readers see the dataset as it was before the block.
_COUNTS = (files.TASKS, files.STATS, files.INFO)


@dataclasses.dataclass(frozen=True)
class _Published:
    """What stands in place.

    Attributes:
        episodes: Episodes.
        frames: Frames.
        data_files: Number of the next data file.
        episode_files: Number of the next file of ``meta/episodes``.
        stats: Statistics of it all; empty where there is nothing.
        tasks: Sentences that say what was to be done, the first one first.
    """

    episodes: int = 0
    frames: int = 0
    data_files: int = 0
    episode_files: int = 0
    stats: Mapping[str, FeatureStats] = dataclasses.field(default_factory=dict)
    tasks: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class _Episode:
    """What is to be said of an episode.

    Attributes:
        first: Index of its first frame in the dataset.
        length: Its frames.
        numbers: Its columns of numbers, with those that LeRobot adds.
        shades: Pixels of its pictures, counted.
        task: What was to be done, as a sentence.
    """

    first: int
    length: int
    numbers: Mapping[str, npt.NDArray[Any]]
    shades: Mapping[str, Shades]
    task: str


class DatasetWriter:
    """Appends demonstrations to the dataset at ``root``, block by block.

    Args:
        root: The dataset; may be missing or empty, or hold published blocks.
        features: LeRobot's features.
        fps: Frames a second.
        block: Episodes a block.
    """

    def __init__(
        self,
        root: Path,
        features: Mapping[str, dict[str, Any]],
        fps: int,
        block: int,
    ) -> None:
        self._root = root
        self._stage = root / STAGE
        self._features = dict(features)
        self._schema = files.data_schema(features)
        self._fps = fps
        self._block = block
        self._published: _Published | None = None
        self._open: _Block | None = None
        # PyArrow loads pandas at its first array; this loads it before the episodes.
        pa.array(np.empty(0))

    def save(self, demonstration: Demonstration) -> None:
        """Appends one episode, and publishes the block when it is full.

        Raises:
            OSError: The disk is full or the folder not writable.
        """
        if self._published is None:
            self._published = _read_published(self._root, self._features)
        if self._open is None:
            shutil.rmtree(self._stage, ignore_errors=True)
            self._open = _Block(self._published.data_files, self._published.tasks)
        block, before = self._open, self._published
        length, first = demonstration.length, before.frames + block.frames
        task = block.number_of(demonstration.task)
        counters = files.counters(length, before.episodes + block.size, first, self._fps, task)
        numbers = {**demonstration.numbers, **counters}
        episode = _Episode(first, length, numbers, demonstration.shades, demonstration.task)
        block.waiting.append((episode, {**demonstration.columns, **counters}))
        block.waiting_bytes += demonstration.picture_bytes
        if block.size >= self._block:
            self.publish()
        elif block.waiting_bytes >= _WAITING_BYTES:
            block.write(self._stage, self._schema)

    def publish(self) -> None:
        """Closes the open block, if any, and moves it into place."""
        block, before = self._open, self._published
        if block is None or before is None or block.torn or not block.size:
            self.discard()
            return
        block.write(self._stage, self._schema)
        block.close()
        names = files.with_counters(self._features)
        stats = _stats_of_block(block.episodes)
        parts = [before.stats, *stats] if before.stats else stats
        rows = [
            files.episode_row(
                before.episodes + i,
                episode.length,
                episode.first,
                data_file,
                episode.task,
            )
            for i, (episode, data_file) in enumerate(
                zip(block.episodes, block.data_files, strict=True)
            )
        ]
        after = _Published(
            before.episodes + len(rows),
            before.frames + block.frames,
            block.data_file + 1,
            before.episode_files + 1,
            {name: merge_stats([part[name] for part in parts]) for name in names},
            tuple(block.tasks),
        )
        files.write_episodes(self._stage, before.episode_files, rows, self._features, stats)
        files.write_tasks(self._stage, after.tasks)
        files.write_stats(self._stage, self._features, after.stats)
        files.write_info(
            self._stage,
            self._features,
            self._fps,
            ROBOT_TYPE,
            episodes=after.episodes,
            frames=after.frames,
            tasks=len(after.tasks),
        )
        for part in (files.DATA, files.EPISODES):
            for staged in sorted((self._stage / part).glob("*/*.parquet")):
                target = self._root / staged.relative_to(self._stage)
                target.parent.mkdir(parents=True, exist_ok=True)
                staged.replace(target)
        for name in _COUNTS:
            (self._stage / name).replace(self._root / name)
        self._published = after
        self.discard()

    def discard(self) -> None:
        """Drops the open block."""
        block, self._open = self._open, None
        if block is not None:
            # On a full disk, closing fails as well.
            with contextlib.suppress(OSError):
                block.close()
        shutil.rmtree(self._stage, ignore_errors=True)


class _Block:
    """Episodes on their way: their data in the stage, what is said of them in memory.

    Args:
        data_file: Number of its first data file.
        tasks: Sentences that are known.

    Attributes:
        tasks: Those and new ones.
        waiting: Episodes that are not written yet, each with its columns.
        waiting_bytes: Size of their pictures.
        episodes: Those that are.
        data_files: Number of the data file of each.
        torn: Rows were written that are not listed.
    """

    def __init__(self, data_file: int, tasks: Sequence[str]) -> None:
        self.data_file = data_file
        self.tasks = list(tasks)
        self.waiting: list[tuple[_Episode, files.Columns]] = []
        self.waiting_bytes = 0
        self.episodes: list[_Episode] = []
        self.data_files: list[int] = []
        self.torn = False
        self._writer: pq.ParquetWriter | None = None
        self._path = Path()
        self._frames_in_file = 0

    @property
    def size(self) -> int:
        """Episodes, written or waiting."""
        return len(self.episodes) + len(self.waiting)

    @property
    def frames(self) -> int:
        """Their frames."""
        return sum(e.length for e in (*self.episodes, *(e for e, _ in self.waiting)))

    def number_of(self, task: str) -> int:
        """The number of a sentence, which a new one gets here."""
        if task not in self.tasks:
            self.tasks.append(task)
        return self.tasks.index(task)

    def write(self, stage: Path, schema: pa.Schema) -> None:
        """Writes the episodes that wait."""
        if not self.waiting:
            return
        table = files.data_table(schema, [columns for _, columns in self.waiting])
        # An interrupt in here would leave rows that are not listed.
        self.torn = True
        row = 0
        for episode, _ in self.waiting:
            self._write_rows(stage, table.slice(row, episode.length))
            self.data_files.append(self.data_file)
            row += episode.length
        self.episodes += [episode for episode, _ in self.waiting]
        self.waiting, self.waiting_bytes = [], 0
        self.torn = False

    def _write_rows(self, stage: Path, rows: pa.Table) -> None:
        """Appends the rows of an episode, to a new file where LeRobot would begin one."""
        if self._writer is not None:
            size = self._path.stat().st_size / 2**20
            if size * (1.0 + len(rows) / self._frames_in_file) >= files.DATA_FILE_MB:
                self.close()
                self.data_file += 1
        if self._writer is None:
            self._path = stage / files.numbered(files.DATA, self.data_file)
            self._writer = files.data_writer(self._path, rows.schema)
            self._frames_in_file = 0
        self._writer.write_table(rows)
        self._frames_in_file += len(rows)

    def close(self) -> None:
        """Writes the footer."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()


def _stats_of_block(episodes: Sequence[_Episode]) -> list[dict[str, FeatureStats]]:
    """Statistics of all columns, episode by episode; what is alike goes through NumPy together."""
    shades = {(i, name): s for i, e in enumerate(episodes) for name, s in e.shades.items()}
    found = shade_stats(shades)
    alike: dict[int, list[int]] = {}
    for i, episode in enumerate(episodes):
        alike.setdefault(episode.length, []).append(i)
    for members in alike.values():
        found |= column_stats({(i, n): v for i in members for n, v in episodes[i].numbers.items()})
    stats: list[dict[str, FeatureStats]] = [{} for _ in episodes]
    for (i, name), each in found.items():
        stats[i][name] = each
    return stats


def _read_published(root: Path, features: Mapping[str, dict[str, Any]]) -> _Published:
    """What a recording goes on from.

    Raises:
        DatasetError: ``info.json`` or ``stats.json`` is damaged.
    """
    if not (root / files.INFO).exists():
        return _Published()
    (episodes, frames), listed = _counts(root), _episode_files(root)
    if not listed:
        raise reader.DamagedFileError(files.EPISODES, "is missing; record the dataset again")
    last = reader.read_numbers(root, listed[-1], [*_DATA_PLACE, *_EPISODE_PLACE])
    data_file, episode_file = (
        int(last[chunk][-1]) * files.FILES_A_CHUNK + int(last[file][-1])
        for chunk, file in (_DATA_PLACE, _EPISODE_PLACE)
    )
    names = files.with_counters(features)
    stats = reader.read_stats(root)
    try:
        # A kill between the last two files leaves statistics that count a block too many.
        if stats["index"]["count"] == [frames]:
            whole = {name: FeatureStats.from_named(stats[name]) for name in names}
        else:
            whole = _stats_of_episodes(root, listed, list(names))
        for name, feature in names.items():
            width = (
                feature["shape"][-1] if files.is_picture(feature) else math.prod(feature["shape"])
            )
            if whole[name].values.shape != (len(STAT_NAMES), width):
                raise ValueError(f"{name} has another size")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        if isinstance(error, DatasetError):
            raise
        what = f"is damaged ({type(error).__name__}: {error}); record the dataset again"
        raise reader.DamagedFileError(files.STATS, what) from None
    tasks = tuple(reader.read_sentences(root))
    return _Published(episodes, frames, data_file + 1, episode_file + 1, whole, tasks)


def _stats_of_episodes(root: Path, listed: list[str], names: list[str]) -> dict[str, FeatureStats]:
    """Statistics of all episodes that are listed, merged."""
    parts: dict[str, list[FeatureStats]] = {name: [] for name in names}
    for path in listed:
        for row in reader.read_table(root, path).to_pylist():
            for name in names:
                prefix = f"{files.STATS_PREFIX}{name}/"
                named = {k.removeprefix(prefix): v for k, v in row.items() if k.startswith(prefix)}
                parts[name].append(FeatureStats.from_named(named))
    return {name: merge_stats(each) for name, each in parts.items()}


@contextlib.contextmanager
def taken(root: Path, *, resume: bool) -> Iterator[None]:
    """Makes sure that ``root`` can take a recording, and clears what a killed one left behind.

    No other process can while the block lasts.

    Args:
        root: The dataset's folder.
        resume: Go on with what is there.

    Raises:
        OutputError: It is a file, not writable, not empty without ``resume``, or another process
            has it.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        entries = list(root.iterdir())
    except OSError as error:
        raise OutputError(
            f"cannot use {root} as a folder: {error.strerror}; choose another one"
        ) from error
    if not os.access(root, os.W_OK):
        raise OutputError(f"cannot write into {root}; choose another folder")
    if entries and not resume:
        raise OutputError(f"{root} is not empty; choose another folder, or go on with --resume")
    with only_writer(root):
        shutil.rmtree(root / STAGE, ignore_errors=True)
        _drop_unpublished(root)
        yield


def published_outcomes(root: Path) -> list[bool]:
    """Success of each published episode, in order; empty where nothing is published.

    Raises:
        DatasetError: The files and the counts contradict each other.
    """
    if not (root / files.INFO).exists():
        return []
    outcomes: dict[int, bool] = {}
    for path in sorted((root / "data").glob("*/*.parquet")):
        name = path.relative_to(root).as_posix()
        rows = reader.read_numbers(root, name, ["episode_index", "next.success"])
        for episode, success in zip(rows["episode_index"], rows["next.success"], strict=True):
            outcomes[int(episode)] = outcomes.get(int(episode), False) or bool(success)
    count, _ = _counts(root)
    if len(outcomes) != count or sorted(outcomes) != list(range(count)):
        raise DatasetError(f"{root} counts {count} episodes but holds others; record it again")
    return [outcomes[episode] for episode in range(count)]


def _counts(root: Path) -> tuple[int, int]:
    """Published episodes and frames.

    Raises:
        DatasetError: ``info.json`` is damaged.
    """
    info = reader.read_info(root)
    return info["total_episodes"], info["total_frames"]


def _episode_files(root: Path) -> list[str]:
    """Files of ``meta/episodes``, relative to the dataset."""
    found = sorted((root / files.EPISODES).glob("*/*.parquet"))
    return [path.relative_to(root).as_posix() for path in found]


def _drop_unpublished(root: Path) -> None:
    """Removes files of a block that was being moved into place when its recorder was killed.

    Raises:
        DatasetError: What is there is damaged, and nothing is removed.
    """
    info = root / files.INFO
    if info.parent.exists() and not info.parent.is_dir():
        raise reader.DamagedFileError(info.parent.name, "is not a folder; record the dataset again")
    if not info.exists():
        shutil.rmtree(root / "data", ignore_errors=True)
        shutil.rmtree(root / "meta", ignore_errors=True)
        return
    count, _ = _counts(root)
    places = reader.read_places(root)
    kept = [place for place in places if place.episode < count]
    wanted = {place.file for place in kept}
    if lacking := sorted(name for name in wanted if not (root / name).is_file()):
        # Another list than that of these files: none of them is known to be superfluous.
        raise reader.DamagedFileError(lacking[0], "is missing; record the dataset again")
    for name in {place.listed_in for place in places} - {place.listed_in for place in kept}:
        (root / name).unlink()
    for path in (root / "data").glob("*/*.parquet"):
        if path.relative_to(root).as_posix() not in wanted:
            path.unlink()
