"""The action log beside a result: all actions, from which everything else follows.

``<file stem>.actions.npz`` holds ``steps`` (n,) int64, the control steps played in scenarios
0..n-1, and ``actions`` (sum of steps, 7) float32, scenario after scenario, as the policy gave them,
before clipping. Where all of them are multiples of 2^-20, as those of the suite's own network are,
``changes`` (4, 7, sum of steps) uint8 stands for ``actions`` in two fifths of the space: from step
to step, in these units. Equal actions give equal bytes.
"""

import hashlib
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvs_suite import reading
from hvs_suite.errors import ResultError

Actions = npt.NDArray[np.float32]

MOST_BYTES = 64 * 2**20
"""Largest log that is read, packed or not: sixty times that of 1,000 scenarios of 40 steps."""
MOST_SCENARIOS = 100_000
_ACTION_SIZE = 7
_UNITS = 2.0**20
"""Of `changes`: parts of the range of an action."""
_MOST_UNITS = 2**28
"""Actions up to 256; twice the change between two of them still fits 32 bits."""
_SAME = 1e-4
"""Actions this close are the same: a thousand roundings apart, and a hundredth of a millimetre."""
_SAME_STEPS = 0.7


def encode(actions: Sequence[Actions]) -> bytes:
    """Returns the file for (steps, 7) actions of each scenario from 0 up."""
    steps = np.array([len(episode) for episode in actions], np.int64)
    together = np.concatenate(actions).astype(np.float32)
    in_units = together * _UNITS
    buffer = io.BytesIO()
    # Scaled by a power of two, a float32 stays what it is; a zero's sign would be lost.
    if (
        (np.abs(in_units) <= _MOST_UNITS).all()
        and (in_units == np.rint(in_units)).all()
        and not (np.signbit(together) & (together == 0.0)).any()
    ):
        np.savez_compressed(buffer, steps=steps, changes=_changes(in_units.astype(np.int32)))
    else:
        np.savez_compressed(buffer, steps=steps, actions=together)
    return buffer.getvalue()


def _changes(in_units: npt.NDArray[np.int32]) -> npt.NDArray[np.uint8]:
    """What changes from row to row, lowest bytes first: small numbers leave the others empty."""
    change = np.diff(in_units, axis=0, prepend=np.zeros((1, _ACTION_SIZE), np.int32))
    unsigned = ((change << 1) ^ (change >> 31)).astype("<u4")  # 0, -1, 1, -2 become 0, 1, 2, 3
    planes = np.ascontiguousarray(unsigned.T)[..., None].view(np.uint8)  # (7, n, 4)
    return np.ascontiguousarray(planes.transpose(2, 0, 1))


def _from_changes(changes: npt.NDArray[np.uint8]) -> Actions:
    """Inverse of `_changes`, as actions."""
    planes = np.ascontiguousarray(changes.transpose(1, 2, 0))
    unsigned = planes.view("<u4")[..., 0].T  # (n, 7)
    change = (unsigned >> 1).astype(np.int64) ^ -(unsigned & 1).astype(np.int64)
    return (np.cumsum(change, axis=0) / _UNITS).astype(np.float32)


def digest(path: Path) -> str:
    """Returns the SHA-256 of a file, as ``sha256sum`` prints it.

    Raises:
        ResultError: The file cannot be read, or is larger than any log.
    """
    return hashlib.sha256(_content(path)).hexdigest()


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
    log = reading.read_npz(
        path,
        {"steps": (np.int64, 1), "actions": (np.float32, 2)},
        or_else={"steps": (np.int64, 1), "changes": (np.uint8, 3)},
        most=MOST_BYTES,
        error=ResultError,
    )
    steps = log["steps"]
    if "actions" in log:
        actions = log["actions"]
    elif log["changes"].shape[:2] == (4, _ACTION_SIZE):
        actions = _from_changes(log["changes"])
    else:
        raise ResultError(f"{path}: is no action log; its changes have no rows of {_ACTION_SIZE}")
    if (
        not 0 < len(steps) <= MOST_SCENARIOS
        # One by one first: a sum of huge numbers may come round to any other.
        or not ((steps >= 0) & (steps <= len(actions))).all()
        or steps.sum() != len(actions)
        or actions.shape[1] != _ACTION_SIZE
        or not np.isfinite(actions).all()
    ):
        raise ResultError(f"{path}: is no action log; steps and actions do not fit together")
    return np.split(actions, np.cumsum(steps)[:-1])


def executed(actions: Sequence[Actions], steps: int) -> Actions:
    """Returns the actions as they were carried out, clipped: (n, steps, 7), NaN after the end.

    Args:
        actions: (steps, 7) of each of n scenarios.
        steps: At least as many as any of them holds.
    """
    padded = np.full((len(actions), steps, _ACTION_SIZE), np.nan, np.float32)
    for scenario, episode in enumerate(actions):
        padded[scenario, : len(episode)] = np.clip(episode, -1.0, 1.0)
    return padded


def share_alike(one: Actions, other: Actions) -> float:
    """Returns in which share of the scenarios two policies did the same, in [0, 1].

    Two policies did the same if the actions agree to a ten-thousandth of their range in seven in
    ten of the steps that both played. Not all steps, because a copy may have some changed; not
    fewer, because any two good policies agree where both go at full speed.

    Args:
        one: As `executed` gives them, up to where each scenario was scored: what comes after it
            gives no score, and could be anything in a copy.
        other: Likewise, of the same task.
    """
    n = min(len(one), len(other))
    apart = np.abs(one[:n] - other[:n]).max(axis=-1)
    played = (~np.isnan(apart)).sum(axis=-1)
    alike = (apart <= _SAME).sum(axis=-1)
    return float(((played > 0) & (alike >= _SAME_STEPS * played)).mean())


def _content(path: Path) -> bytes:
    try:
        return reading.read_bytes(path, most=MOST_BYTES, error=ResultError)
    except ResultError as error:
        raise ResultError(f"{error}; the action log belongs beside its result") from error
