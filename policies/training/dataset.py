"""A recorded LeRobot dataset as the `hvs` policy reads it: description and columns.

Reads the dataset's own files (format v3, frames as images) without importing LeRobot's dataset
package, which takes longer than opening a small dataset.
"""

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hvs_suite.datasets import reader
from hvs_suite.datasets.features import (
    ACTION,
    ACTION_EXECUTED,
    IMAGES,
    OBSERVATION,
    STATE,
    dataset_features,
)
from hvs_suite.datasets.metadata import EXPERT, read_metadata
from hvs_suite.errors import DatasetError, OptionError, UnknownTaskError
from hvs_suite.registry import find

EPISODE = "episode_index"
GOAL_POSITION = "privileged.goal_position"
GOAL_NORMAL = "privileged.goal_normal"
GOAL_VELOCITY = "privileged.goal_velocity"
JOINT_OFFSET = "privileged.joint_offset"
GOAL_UNSEEN = "privileged.goal_unseen"
FURTHER_KEYS = (GOAL_VELOCITY, JOINT_OFFSET, GOAL_UNSEEN)
"""Columns that only some tasks have: elsewhere goals stand still, encoders are right, and goals are
where the pictures show them."""
TARGET_PREFIX = "privileged.target_"

Column = npt.NDArray[Any]


@dataclasses.dataclass(frozen=True)
class Manifest:
    """What a dataset says of itself.

    Attributes:
        root: The dataset.
        task: Named task that it was recorded on.
        split: Split of its scenarios.
        options: Task options that differ from the named task's.
        features: LeRobot's features by key.
        n_frames: Frames.
        n_episodes: Episodes.
        demonstrator: The policy that chose the actions.
    """

    root: Path
    task: str
    split: str
    options: Mapping[str, Any]
    features: Mapping[str, Mapping[str, Any]]
    n_frames: int
    n_episodes: int
    demonstrator: str = EXPERT

    @property
    def cameras(self) -> dict[str, tuple[int, int, int]]:
        """Camera name to (H, W, C) of its frames."""
        return {
            key.removeprefix(IMAGES): (shape[0], shape[1], shape[2])
            for key, feature in sorted(self.features.items())
            if key.startswith(IMAGES)
            for shape in [feature["shape"]]
        }

    @property
    def has_moving_targets(self) -> bool:
        """Whether its targets move within an episode."""
        return GOAL_VELOCITY in self.features

    @property
    def trained_keys(self) -> list[str]:
        """The features that training reads: all observations, actions, targets, goal."""
        wanted = {STATE, ACTION, ACTION_EXECUTED, GOAL_POSITION, GOAL_NORMAL}
        wanted |= {*FURTHER_KEYS}
        wanted |= {TARGET_PREFIX + name for name in self.cameras}
        wanted |= {IMAGES + name for name in self.cameras}
        wanted |= {
            key
            for key in self.features
            if key.startswith(OBSERVATION) and "." not in key.removeprefix(OBSERVATION)
        }
        return [key for key in self.features if key in wanted]

    def with_cameras(self, names: Collection[str], grey: Collection[str] = ()) -> "Manifest":
        """The same dataset for a policy that is given less.

        Args:
            names: Cameras that are left.
            grey: Those of them whose pictures are in grey.

        Raises:
            OptionError: A name is unknown, or none is left.
        """
        for known, some in ((self.cameras, names), (names, grey)):
            if unknown := sorted(set(some) - set(known)):
                raise OptionError(f"unknown camera {unknown[0]!r}; choose from {', '.join(known)}")
        if not names:
            raise OptionError("no camera is left to see the target with; keep eih or eth")
        dropped = {IMAGES + name for name in self.cameras if name not in names}
        features = {key: value for key, value in self.features.items() if key not in dropped}
        for key in (IMAGES + name for name in grey):
            features[key] = {**features[key], "shape": [*features[key]["shape"][:2], 1]}
        options = {**self.options, **{f"{name}_channels": 1 for name in grey}}
        return dataclasses.replace(self, features=features, options=options)


def read_manifest(root: Path) -> Manifest:
    """Read ``meta/info.json`` and ``hvs.json``.

    Args:
        root: The dataset.

    Returns:
        The manifest.

    Raises:
        DatasetError: There is no such dataset, it is empty, or it was not recorded by this suite.
    """
    try:
        info = reader.read_info(root)
    except DatasetError as error:
        raise DatasetError(f"{root} is not a LeRobot dataset: {error}") from error
    origin = read_metadata(root)
    manifest = Manifest(
        root=root,
        task=origin.task,
        split=origin.split,
        options=origin.options,
        features=info["features"],
        n_frames=info["total_frames"],
        n_episodes=info["total_episodes"],
        demonstrator=origin.demonstrator,
    )
    try:
        wanted = dataset_features(find(origin.task).with_options(origin.options))
    except (UnknownTaskError, OptionError) as error:
        raise DatasetError(f"{root}: hvs.json: {error}") from error
    # Trained without them, a policy would learn what nobody can see.
    if missing := [key for key in FURTHER_KEYS if key in wanted and key not in manifest.features]:
        raise DatasetError(
            f"{root} lacks {missing[0]}, which {origin.task} has: an earlier hvs_suite "
            "recorded it; record it again"
        )
    for key in manifest.trained_keys:
        found = list(manifest.features[key]["shape"])
        # Pictures may be smaller than the task's; their size is checked in the files.
        if key.startswith(IMAGES):
            continue
        right = list(wanted[key]["shape"]) if key in wanted else "recorded on this task"
        if found != right:
            raise DatasetError(f"{root}: meta/info.json: {key} has shape {found}, not {right}")
    if manifest.n_frames == 0:
        raise DatasetError(f"{root} is empty; record at least two episodes")
    return manifest


def refuse_test_split(manifest: Manifest) -> None:
    """Keep the scenarios that policies are scored on out of training.

    Args:
        manifest: Of the dataset.

    Raises:
        DatasetError: It was recorded on ``test``.
    """
    if manifest.split == "test":
        raise DatasetError(
            f"{manifest.root} was recorded on the test split, which scores policies; "
            "record with --split train"
        )


def read_columns(manifest: Manifest, wanted: Collection[str] | None = None) -> dict[str, Column]:
    """Read columns of numbers.

    Args:
        manifest: Of the dataset.
        wanted: Their keys; by default those that training uses: state, actions, targets, goal.

    Returns:
        Key to (n_frames, k) float32; ``episode_index`` to (n_frames,) int64.

    Raises:
        DatasetError: They are not there, or damaged.
    """
    keys = [
        key
        for key in (manifest.trained_keys if wanted is None else wanted)
        if not key.startswith(IMAGES)
    ]
    if wanted is None and (ACTION not in keys or not manifest.cameras):
        raise DatasetError(f"{manifest.root} needs an action and at least one camera to learn from")
    parts: dict[str, list[Column]] = {key: [] for key in [*keys, EPISODE]}
    for path in reader.data_files(manifest.root):
        name = path.relative_to(manifest.root).as_posix()
        table = reader.read_table(manifest.root, name, [*keys, EPISODE])
        with reader.in_file(manifest.root, name):
            for key in keys:
                values = reader.column(table, key)
                declared = tuple(manifest.features[key]["shape"])
                if values.shape[1:] != declared:
                    raise DatasetError(f"{key} has shape {values.shape[1:]}, not {declared}")
                values = values.astype(np.float32)
                astray = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
                if len(astray):
                    raise DatasetError(
                        f"{key} holds NaN or infinity in {len(astray)} rows, row {astray[0]} "
                        "first; record the dataset again"
                    )
                parts[key].append(values)
            index = reader.column(table, EPISODE)
            if index.ndim != 1:
                raise DatasetError(f"{EPISODE}: a row holds no number")
            parts[EPISODE].append(index.astype(np.int64))
    columns = {key: np.concatenate(arrays) for key, arrays in parts.items()}
    if len(columns[EPISODE]) != manifest.n_frames:
        raise DatasetError(
            f"{manifest.root} declares {manifest.n_frames} frames but holds "
            f"{len(columns[EPISODE])}; record it again"
        )
    return columns
