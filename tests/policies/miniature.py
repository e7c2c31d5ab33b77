"""Small datasets in LeRobot's format, written without LeRobot, whose answer is known.

The scene: a red disc on grey, seen by both cameras at a place that a joint angle has to match.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from hvs_suite.cell.robot import JOINT_RANGE_RAD
from hvs_suite.datasets.metadata import DatasetMetadata, write_metadata

Columns = Mapping[str, npt.NDArray[Any]]


def write_dataset(
    root: Path,
    columns: Columns,
    episode_index: npt.NDArray[np.int64],
    task: str = "align-easy",
    split: str = "train",
    n_files: int = 1,
    options: Mapping[str, Any] | None = None,
) -> None:
    """Write frames as a LeRobot v3 dataset with images in parquet.

    Args:
        root: Folder to make.
        columns: Key to (n, ...) array; images (n, H, W, C) uint8, numbers (n, k).
        episode_index: (n,).
        task: For ``hvs.json``.
        split: For ``hvs.json``.
        n_files: Data files to spread the frames over.
        options: Task options, for ``hvs.json``.
    """
    (root / "meta").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    features: dict[str, Any] = {}
    for key, values in columns.items():
        kind = "image" if ".images." in key else str(values.dtype)
        names = ["height", "width", "channels"] if kind == "image" else None
        features[key] = {"dtype": kind, "shape": list(values.shape[1:]), "names": names}
    info = {
        "codebase_version": "v3.0",
        "total_frames": len(episode_index),
        "total_episodes": len(np.unique(episode_index)),
        "fps": 10,
        "features": features,
    }
    (root / "meta" / "info.json").write_text(json.dumps(info))
    write_metadata(
        root, DatasetMetadata(task=task, task_version=1, split=split, options=dict(options or {}))
    )
    for number, rows in enumerate(np.array_split(np.arange(len(episode_index)), n_files)):
        arrays: dict[str, Any] = {"episode_index": pa.array(episode_index[rows])}
        for key, values in columns.items():
            if ".images." in key:
                arrays[key] = pa.array(
                    [{"bytes": _png(values[row]), "path": None} for row in rows],
                    pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
                )
            else:
                arrays[key] = pa.FixedSizeListArray.from_arrays(
                    pa.array(values[rows].reshape(-1)), values.shape[1]
                )
        path = root / "data" / "chunk-000" / f"file-{number:03d}.parquet"
        pq.write_table(pa.table(arrays), path)


def scene(n: int, side: int = 28, seed: int = 0) -> dict[str, npt.NDArray[Any]]:
    """Frames of the miniature scene, four to an episode if written with `episodes`.

    Args:
        n: Frames.
        side: Of the images (px).
        seed: Of everything drawn.

    Returns:
        Every column that the suite's recorder writes and training reads.
    """
    rng = np.random.default_rng(seed)
    columns: dict[str, npt.NDArray[Any]] = {}
    for camera in ("eih", "eth"):
        uv = rng.uniform(-0.7, 0.7, (n, 2))
        diameter = rng.uniform(0.2, 0.5, (n, 1))
        visible = np.ones((n, 1))
        visible[::8] = 0.0
        grid = (2 * np.arange(side) + 1) / side - 1
        distance = np.hypot(
            grid[None, None, :] - uv[:, 0, None, None], grid[None, :, None] - uv[:, 1, None, None]
        )
        disc = (distance < diameter[:, :, None]) & (visible[:, :, None] > 0)
        image = np.full((n, side, side, 3), 140, np.uint8)
        image[disc] = (200, 30, 30)
        columns[f"observation.images.{camera}"] = image
        truth = np.concatenate([uv, diameter, visible], axis=1).astype(np.float32)
        columns[f"privileged.target_{camera}"] = truth
    q = rng.uniform(-1.0, 1.0, (n, 7))
    velocity = rng.uniform(-0.5, 0.5, (n, 7))
    columns["observation.state"] = np.concatenate([q, velocity], axis=1).astype(np.float32)
    step = np.zeros((n, 7))
    step[:, :2] = 0.1 * columns["privileged.target_eih"][:, :2]
    columns["action"] = ((q + step) / JOINT_RANGE_RAD).astype(np.float32)
    columns["privileged.action_executed"] = columns["action"]
    goal = np.concatenate([rng.uniform(-0.6, 0.6, (n, 2)), np.full((n, 1), 0.05)], axis=1)
    columns["privileged.goal_position"] = goal.astype(np.float32)
    columns["privileged.goal_normal"] = np.tile(np.float32([0, 0, 1]), (n, 1))
    return columns


def episodes(n: int, length: int = 4) -> npt.NDArray[np.int64]:
    """Episode numbers of n frames, ``length`` to an episode."""
    return np.arange(n) // length


def _png(image: npt.NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", image[..., ::-1])[1])
