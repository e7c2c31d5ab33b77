"""The action log beside a result: every action of every scenario, from which all else follows.

``<file stem>.actions.npz`` holds ``steps`` (n,) int64, the control steps played in scenarios
0..n-1, and ``actions`` (sum of steps, 7) float32, scenario after scenario, as the policy gave them,
before clipping. Equal actions give equal bytes.
"""

import hashlib
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import ResultError

Actions = npt.NDArray[np.float32]


def encode(actions: Sequence[Actions]) -> bytes:
    """Returns the file for (steps, 7) actions of each scenario from 0 up."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        steps=np.array([len(episode) for episode in actions], np.int64),
        actions=np.concatenate(actions).astype(np.float32),
    )
    return buffer.getvalue()


def digest(path: Path) -> str:
    """Returns the SHA-256 of a file, as ``sha256sum`` prints it.

    Raises:
        ResultError: The file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ResultError(
            f"{path}: the action log cannot be read ({error.strerror}); it belongs beside its "
            "result"
        ) from error


def load(path: Path, sha256: str) -> list[Actions]:
    """Reads a log.

    Args:
        path: The file.
        sha256: What its result says of it.

    Returns:
        (steps, 7) float32 of each scenario from 0 up.

    Raises:
        ResultError: It is missing, is not the one that the result was made with, or is no log.
    """
    if digest(path) != sha256:
        raise ResultError(f"{path}: is not the action log that its result was written with")
    try:
        with np.load(path, allow_pickle=False) as log:
            steps, actions = log["steps"], log["actions"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ResultError(f"{path}: is no action log ({error})") from error
    if (
        steps.ndim != 1
        or steps.dtype != np.int64
        or actions.ndim != 2
        or actions.dtype != np.float32
        or (steps < 0).any()
        or steps.sum() != len(actions)
        or not np.isfinite(actions).all()
    ):
        raise ResultError(f"{path}: steps and actions do not make a log")
    return np.split(actions, np.cumsum(steps)[:-1])
