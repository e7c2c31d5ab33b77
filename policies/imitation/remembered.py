"""What a policy would remember at each frame of a recording, as training gives it to the network.

The frames were not played with the network that learns. So its memory is computed from the true
state, with errors as large as those of trained eyes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from hvs_suite.cell.robot import JOINT_RANGE_RAD, set_point_after
from hvs_suite.datasets.features import ACTION_EXECUTED
from hvs_suite.policies.network.geometry import (
    Calibration,
    FlangeMotion,
    flange_motion,
    look_height,
    seen_from_afar,
    seen_from_hand,
)
from hvs_suite.policies.network.network import (
    CONTROL_PERIOD_S,
    HEIGHT_SUMS,
    N_JOINTS,
    SET_POINT,
    SLOT_SIZE,
    STATE,
    memory_size,
)

UV_SIGMA = {"eih": 0.006, "eth": 0.003}
"""How well a trained eye finds the target in its image of [-1, 1], one sigma."""
SIZE_SIGMA = 0.004
"""How well it tells the target's size, as a share, at the goal, one sigma: as much again in all
looks of an episode alike, where light and colour are what they are. Grows with the distance."""

Column = npt.NDArray[Any]
Columns = Mapping[str, Column]


def remembered(
    columns: Columns,
    cameras: Sequence[str],
    calibration: Calibration,
    random: np.random.Generator,
) -> npt.NDArray[np.float32]:
    """The memory before each frame, as `HvsNetwork.forward` reads it.

    Args:
        columns: State, executed actions, targets in the images and ``episode_index``, (n, k) each,
            the frames of an episode in order.
        cameras: Their names, in the order of the network's eyes.
        calibration: Of the network.
        random: Draws how far off the eyes are.

    Returns:
        (n, 4 per camera + 10): the place that each camera saw last (m, base frame), and 1 if it did
        earlier in the episode, else 0 and the place 0; the sums of the heights that its size showed
        and of their weights; the set point (rad), and 1 if there is one.
    """
    episodes = columns["episode_index"]
    frames = np.arange(len(episodes))
    first = np.maximum.accumulate(np.where(np.diff(episodes, prepend=-1) != 0, frames, 0))
    motion = flange_motion(torch.from_numpy(columns[STATE][:, :N_JOINTS]))
    memory = np.zeros((len(episodes), memory_size(len(cameras))), np.float32)
    for i, camera in enumerate(cameras):
        target = columns.get(f"privileged.target_{camera}")
        if target is None:
            continue
        off = UV_SIGMA[camera] * random.normal(size=(len(target), 2))
        uv = torch.from_numpy((target[:, :2] + off).astype(np.float32))
        slot = memory[:, SLOT_SIZE * i : SLOT_SIZE * (i + 1)]
        slot[:] = _places(camera, uv, target, motion, calibration, first)
        if camera == "eih":
            memory[:, HEIGHT_SUMS] = _height_sums(uv, target, motion, calibration, first, random)
    if ACTION_EXECUTED in columns:
        memory[:, SET_POINT] = _set_points(columns[STATE], columns[ACTION_EXECUTED], first)
        memory[:, -1] = frames > first
        memory[frames == first, SET_POINT] = 0.0
    return memory


def _places(
    camera: str,
    uv: torch.Tensor,
    target: Column,
    motion: FlangeMotion,
    calibration: Calibration,
    first: Column,
) -> Column:
    """Where a camera saw the target last, and whether it did, (n, 4)."""
    height = torch.tensor(calibration.plane_height_m, dtype=torch.float32)
    seen = _in_view(target)
    if camera == "eih":
        rays = torch.from_numpy(calibration.rays.astype(np.float32))
        place = seen_from_hand(motion, uv, rays, height).numpy()
        seen &= place[:, 3] > 0
    else:
        homography = torch.from_numpy(calibration.homography.astype(np.float32))
        place = seen_from_afar(uv, homography, height).numpy()
    last_seen = np.maximum.accumulate(np.where(seen, np.arange(len(seen)), -1))
    before = np.concatenate([[-1], last_seen[:-1]])
    known = before >= first
    slot = np.zeros((len(seen), SLOT_SIZE), np.float32)
    slot[known, :3] = place[before[known], :3]
    slot[known, 3] = 1.0
    return slot


def _height_sums(
    uv: torch.Tensor,
    target: Column,
    motion: FlangeMotion,
    calibration: Calibration,
    first: Column,
    random: np.random.Generator,
) -> Column:
    """Sums of the weighted heights that the looks before each frame showed, and of weights."""
    n = len(target)
    distance = calibration.size_at_1m / np.maximum(target[:, 2], 1e-3)
    sigma = SIZE_SIGMA * distance / calibration.standoff_m
    off = sigma * (random.normal(size=n) + random.normal(size=n)[first])
    diameter = torch.from_numpy((target[:, 2] * np.exp(off)).astype(np.float32))[:, None]
    constants = (
        torch.as_tensor(value, dtype=torch.float32)
        for value in (
            calibration.rays,
            calibration.size_at_1m,
            calibration.plane_height_m,
            calibration.standoff_m,
        )
    )
    _, height, weight = look_height(motion, uv, diameter.clamp(min=1e-3), *constants)
    looks = torch.cat([weight * height, weight], dim=1).double().numpy()
    looks[~_in_view(target)] = 0.0
    before = np.concatenate([np.zeros((1, 2)), looks.cumsum(axis=0)])[:-1]
    return np.asarray(before - before[first])


def _set_points(state: Column, executed: Column, first: Column) -> Column:
    """The set point that all actions before each frame lead to, (n, 7) rad."""
    set_points = state[:, :N_JOINTS].astype(np.float64)
    number = np.arange(len(state)) - first
    for k in range(1, int(number.max(initial=0)) + 1):
        now = np.flatnonzero(number == k)
        asked = executed[now - 1] * JOINT_RANGE_RAD
        set_points[now] = set_point_after(set_points[now - 1], asked, CONTROL_PERIOD_S)
    return set_points


def _in_view(target: Column) -> npt.NDArray[np.bool_]:
    """Which frames show the target, (n,)."""
    return np.asarray((target[:, 3] > 0.5) & (np.abs(target[:, :2]).max(axis=1) <= 1.0))
