"""Writing a LeRobot dataset so that a kill loses the episodes of one block at most.

LeRobot's parquet files have no footer until ``finalize()``, while ``info.json`` already counts
their episodes: a dataset whose recorder was killed does not load. So each block of episodes is
written into a hidden folder inside the dataset and moved into place once it is finalised, files
first and counts last. What stands in place always loads.
"""

import contextlib
import importlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from hvs_suite.datasets.demonstration import Demonstration
from hvs_suite.datasets.features import ROBOT_TYPE
from hvs_suite.errors import DatasetError, OutputError

STAGE = ".recording"
"""Hidden folder inside the dataset that holds the block being written."""
IMAGE_WRITER_THREADS = 2
# Named so that LeRobot does not probe torchcodec, which complains at length without FFmpeg.
_UNUSED_VIDEO_BACKEND = "pyav"
_EPISODES = Path("meta", "episodes")
_INFO = Path("meta", "info.json")
# Counts come last: until then readers see the dataset as it was before the block.
_COUNTS = (Path("meta", "tasks.parquet"), Path("meta", "stats.json"), _INFO)


class DatasetWriter:
    """Appends demonstrations to the dataset at ``root``, block by block.

    Importing LeRobot's dataset package takes some 20 s, which making the first block pays.

    Args:
        root: The dataset; may be missing or empty, or hold published blocks.
        features: LeRobot's features.
        fps: Frames a second.
        task: The task as a sentence.
        block: Episodes a block.
    """

    def __init__(
        self,
        root: Path,
        features: Mapping[str, dict[str, Any]],
        fps: int,
        task: str,
        block: int,
    ) -> None:
        self._root = root
        self._stage = root / STAGE
        self._features = dict(features)
        self._fps = fps
        self._task = task
        self._block = block
        self._dataset: Any = None
        self._in_block = 0

    def save(self, demonstration: Demonstration) -> None:
        """Appends one episode, and publishes the block when it is full.

        Raises:
            OSError: The disk is full or the folder not writable.
        """
        if self._dataset is None:
            self._begin()
        for frame in demonstration.frames:
            self._dataset.add_frame({**frame, "task": self._task})
        with _lean_datasets(self._stage / "cache"):
            self._dataset.save_episode()
        self._in_block += 1
        if self._in_block >= self._block:
            self.publish()

    def publish(self) -> None:
        """Finalises the open block, if any, and moves it into place."""
        if self._dataset is None:
            return
        dataset, self._dataset, self._in_block = self._dataset, None, 0
        dataset.finalize()
        for part in ("data", str(_EPISODES)):
            for staged in sorted((self._stage / part).glob("*/*.parquet")):
                target = self._root / staged.relative_to(self._stage)
                if not target.exists():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    staged.replace(target)
        for name in _COUNTS:
            (self._stage / name).replace(self._root / name)
        self.discard()

    def discard(self) -> None:
        """Drops the open block."""
        self._dataset, self._in_block = None, 0
        shutil.rmtree(self._stage, ignore_errors=True)

    def _begin(self) -> None:
        """Opens a block: a dataset of its own, or the continuation of the published one."""
        shutil.rmtree(self._stage, ignore_errors=True)
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        repo_id = f"local/{self._root.resolve().name}"
        if not (self._root / _INFO).exists():
            self._dataset = LeRobotDataset.create(
                repo_id,
                self._fps,
                self._features,
                root=self._stage,
                robot_type=ROBOT_TYPE,
                use_videos=False,
                image_writer_threads=IMAGE_WRITER_THREADS,
                video_backend=_UNUSED_VIDEO_BACKEND,
            )
            return
        # To go on, LeRobot needs the counts and the last episode's row; all other files stay out,
        # so that opening a block costs the same however long the dataset has become.
        for name in (*_COUNTS, _episode_files(self._root)[-1].relative_to(self._root)):
            (self._stage / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self._root / name, self._stage / name)
        with _lean_datasets(self._stage / "cache"):
            self._dataset = LeRobotDataset.resume(
                repo_id,
                root=self._stage,
                image_writer_threads=IMAGE_WRITER_THREADS,
                video_backend=_UNUSED_VIDEO_BACKEND,
            )


def prepare_root(root: Path, *, resume: bool) -> None:
    """Makes sure that ``root`` can take a recording, and clears what a killed one left behind.

    Args:
        root: The dataset's folder.
        resume: Go on with what is there.

    Raises:
        OutputError: It is a file, not writable, or not empty without ``resume``.
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
    shutil.rmtree(root / STAGE, ignore_errors=True)
    _drop_unpublished(root)


def published_outcomes(root: Path) -> list[bool]:
    """Success of each published episode, in order; empty where nothing is published.

    Raises:
        DatasetError: The files and the counts contradict each other.
    """
    if not (root / _INFO).exists():
        return []
    outcomes: dict[int, bool] = {}
    for path in sorted((root / "data").glob("*/*.parquet")):
        table = pq.read_table(path, columns=["episode_index", "next.success"]).to_pydict()
        for episode, success in zip(table["episode_index"], table["next.success"], strict=True):
            outcomes[episode] = outcomes.get(episode, False) or bool(success)
    count = _published_count(root)
    if sorted(outcomes) != list(range(count)):
        raise DatasetError(f"{root} counts {count} episodes but holds others; record it again")
    return [outcomes[episode] for episode in range(count)]


def _published_count(root: Path) -> int:
    try:
        return int(json.loads((root / _INFO).read_text(encoding="utf-8"))["total_episodes"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{root / _INFO} is damaged ({error}); record the dataset again"
        ) from None


def _episode_files(root: Path) -> list[Path]:
    return sorted((root / _EPISODES).glob("*/*.parquet"))


def _drop_unpublished(root: Path) -> None:
    """Removes files of a block that was being moved into place when its recorder was killed."""
    if not (root / _INFO).exists():
        shutil.rmtree(root / "data", ignore_errors=True)
        shutil.rmtree(root / "meta", ignore_errors=True)
        return
    count = _published_count(root)
    kept: set[tuple[int, int]] = set()
    columns = ["episode_index", "data/chunk_index", "data/file_index"]
    for path in _episode_files(root):
        rows = pq.read_table(path, columns=columns).to_pydict()
        if min(rows["episode_index"]) >= count:
            path.unlink()
        else:
            kept |= set(zip(rows[columns[1]], rows[columns[2]], strict=True))
    wanted = {
        root / "data" / f"chunk-{chunk:03d}" / f"file-{file:03d}.parquet" for chunk, file in kept
    }
    for path in (root / "data").glob("*/*.parquet"):
        if path not in wanted:
            path.unlink()


@contextlib.contextmanager
def _lean_datasets(cache: Path) -> Iterator[None]:
    """Keeps Hugging Face's datasets from drawing bars, hashing and filling the user's cache."""
    # By name: type checkers take the plain import for our own folder of that name.
    datasets: Any = importlib.import_module("datasets")
    config: Any = importlib.import_module("datasets.config")
    folder, caching = config.HF_DATASETS_CACHE, datasets.is_caching_enabled()
    bars = datasets.are_progress_bars_disabled()
    config.HF_DATASETS_CACHE = cache
    datasets.disable_caching()
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        config.HF_DATASETS_CACHE = folder
        if caching:
            datasets.enable_caching()
        if not bars:
            datasets.enable_progress_bars()
