"""The prior of a belief, from demonstrations: where goals are, and how they move and look."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hvs_suite.datasets.features import STATE
from hvs_suite.policies.belief.belief import ACCELERATION, N_MOTION, PLACE, VELOCITY, Prior, View
from hvs_suite.policies.belief.geometry import cross, flange_motion
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork
from hvs_suite.policies.belief.recorded import shown_goals
from hvs_suite.policies.training.dataset import (
    EPISODE,
    GOAL_POSITION,
    GOAL_VELOCITY,
    TARGET_PREFIX,
)

WIDER = 1.5
"""Variances are so much larger than those of the demonstrations: scenes to come may lie beyond."""
PLACE_FLOOR_M = 2e-5
MOTION_FLOOR = 1e-5
"""Of velocities (m/s) and accelerations (m/s2)."""
SLOPE_VARIANCE_FLOOR = 1e-7
"""Where all demonstrations are alike, the prior is not quite certain."""
EM_ROUNDS = 100
"""Of expectation maximisation; the variances of ``sequence-hard`` no longer change after half of
them."""
UNSEEN_SIZE = 0.02
"""Size of a target that a camera never saw (image widths times m)."""


def fit_prior(
    columns: Mapping[str, npt.NDArray[np.generic]], views: Mapping[str, View], period_s: float
) -> Prior:
    """Fit the prior to recorded frames.

    Goals g_i with unit normals n_i are known, and that the target lies on the ray d_i from a
    camera's centre o_i through its picture. It lies at g_i - s n_i, and the standoff s is the one
    that leaves the least angles to these rays: with A_i = I - d_i d_i' and w_i = 1 / |g_i - o_i|^2,

        s = sum(w_i n_i' A_i (g_i - o_i)) / sum(w_i n_i' A_i n_i).

    The eye in hand tells it, whose place is known where it stands; without one, the eye to hand.
    Looks along the normal do not count, because A_i n_i is 0 there; if there are no others, s is 0.
    Mean and covariance are those of g_i - s n_i, of the velocities, of their differences from frame
    to frame and of the slopes n_xy / n_z, the covariance `WIDER`; a camera's size is the median of
    apparent diameter times depth.

    How far off a camera shows a target is the vector from the target to the nearest point of its
    nominal ray. If in an episode a camera is shifted by -a and turned by -w from where it is taken
    to be, that is what of a + w x (g_i - s n_i - o_i) lies across the ray. The variances of a and w
    and that of what is left come from expectation maximisation (Dempster, Laird and Rubin, 1977),
    of one look at each target.

    Args:
        columns: ``privileged.goal_position`` and ``privileged.goal_normal`` (n, 3),
            ``observation.state`` (n, 14), ``privileged.target_<camera>`` (n, 4) of each camera of
            the views, ``episode_index`` (n,), and those of
            `hvs_suite.policies.training.dataset.FURTHER_KEYS` that there are.
        views: Camera name to its pose at each frame, nominal.
        period_s: Control period (s).

    Returns:
        The prior.
    """
    goal, normal = (_double(part) for part in shown_goals(columns))
    velocity = (
        _double(columns[GOAL_VELOCITY]) if GOAL_VELOCITY in columns else torch.zeros_like(goal)
    )
    targets = {name: _double(columns[TARGET_PREFIX + name]) for name in views}
    teller = "eih" if "eih" in views else next(iter(views))
    standoff = _standoff(goal, normal, targets[teller], views[teller])
    place = goal - standoff * normal
    covariance = torch.zeros(N_MOTION, N_MOTION, dtype=torch.float64)
    off = place - place.mean(dim=0)
    covariance[PLACE, PLACE] = WIDER * off.T @ off / len(off)
    # About zero, where the belief begins.
    covariance[VELOCITY, VELOCITY] = WIDER * velocity.T @ velocity / len(velocity)
    episode = torch.from_numpy(np.asarray(columns[EPISODE], np.int64))
    change = velocity.diff(dim=0)[episode.diff() == 0] / period_s
    covariance[ACCELERATION, ACCELERATION] = WIDER * change.T @ change / max(1, len(change))
    floors = torch.tensor([PLACE_FLOOR_M] * 3 + [MOTION_FLOOR] * 6, dtype=torch.float64)
    offsets = {n: _offset(place, targets[n], view, episode) for n, view in views.items()}
    slope = normal[:, :2] / normal[:, 2:]
    spread = (slope - slope.mean(dim=0)).square().mean()
    return Prior(
        place=place.mean(dim=0),
        covariance=covariance + torch.diag(floors.square()),
        slope=slope.mean(dim=0),
        slope_variance=float(WIDER * spread + SLOPE_VARIANCE_FLOOR),
        standoff_m=standoff,
        sizes={name: _size(place, targets[name], view) for name, view in views.items()},
        offsets={name: off[:2] for name, off in offsets.items()},
        drifts={name: off[2] for name, off in offsets.items()},
    )


def take_prior(network: BeliefNetwork, columns: Mapping[str, npt.NDArray[np.generic]]) -> None:
    """Give a network what demonstrations say beforehand.

    Args:
        network: Gets it: the prior of its belief, how low goals lie, and how targets move, if it
            has foresight.
        columns: As in `fit_prior`.
    """
    views = network.views(flange_motion(_double(columns[STATE])[:, :N_JOINTS]))
    prior = fit_prior(columns, views, network.cell.period_s)
    network.set_prior(prior, float(np.asarray(columns[GOAL_POSITION])[:, 2].min()))
    if network.foresight is not None:
        goal, normal = (_double(part) for part in shown_goals(columns))
        episode = torch.from_numpy(np.asarray(columns[EPISODE], np.int64))
        network.foresight.learn(
            goal - prior.standoff_m * normal, _double(columns[GOAL_VELOCITY]), episode
        )


def _standoff(goal: Tensor, normal: Tensor, target: Tensor, view: View) -> float:
    seen = _in_view(target)
    direction = _rays(target, view)[seen]
    n, offset = normal[seen], goal[seen] - view.origin[seen]
    across = n - (n * direction).sum(dim=1, keepdim=True) * direction  # A n
    weight = 1.0 / offset.square().sum(dim=1)
    told = float((weight * (across * n).sum(dim=1)).sum())
    return float((weight * (across * offset).sum(dim=1)).sum()) / told if told > 0.0 else 0.0


def _size(place: Tensor, target: Tensor, view: View) -> float:
    seen = _in_view(target)
    if not seen.any():
        return UNSEEN_SIZE
    depth = (view.rotation.transpose(1, 2) @ (place - view.origin)[:, :, None])[:, 2, 0]
    return float((target[:, 2] * depth)[seen].median())


def _offset(
    place: Tensor, target: Tensor, view: View, episode: Tensor
) -> tuple[float, float, float]:
    """Variances of a camera's shift (m2) and turn (rad2), and of what they leave (m2)."""
    floor = PLACE_FLOOR_M**2
    seen = _in_view(target)
    if not seen.any():
        return floor, floor, floor
    place, origin, episode = place[seen], view.origin[seen], episode[seen]
    direction = _rays(target, view)[seen]
    # Further looks at a target say nothing more of the pose.
    new = torch.ones_like(episode, dtype=torch.bool)
    new[1:] = (episode.diff() != 0) | (place.diff(dim=0) != 0.0).any(dim=1)
    way, direction = (place - origin)[new], direction[new]
    number = torch.unique_consecutive(episode[new], return_inverse=True)[1]
    eye3 = torch.eye(3, dtype=way.dtype)
    across = eye3 - direction[:, :, None] * direction[:, None]
    off = -(across @ way[:, :, None])
    A = across @ torch.cat([eye3.expand(len(way), 3, 3), cross(-way)], dim=2)
    return _pose_variances(A, off, number, floor)


def _pose_variances(
    A: Tensor, off: Tensor, number: Tensor, floor: float
) -> tuple[float, float, float]:
    """What `_offset` returns, by expectation maximisation.

    Args:
        A: What shift and turn move, across each ray, (k, 3, 6).
        off: How far off each ray is, (k, 3, 1) m.
        number: Of each look's episode, (k,), from 0 on.
        floor: Least variance (m2, rad2).
    """
    n = int(number[-1]) + 1
    M = A.new_zeros(n, 6, 6).index_add(0, number, A.transpose(1, 2) @ A)
    b = A.new_zeros(n, 6, 1).index_add(0, number, A.transpose(1, 2) @ off)
    total = off.square().sum()
    left = total / (2 * len(off)) + floor
    # Half of it each, to begin with.
    shift, turn = 0.5 * left, left / A[:, :, 3:].square().sum(dim=(1, 2)).mean()
    for _ in range(EM_ROUNDS):
        known = torch.diag(torch.cat([(1.0 / shift).expand(3), (1.0 / turn).expand(3)]))
        spread = torch.linalg.inv(M / left + known)
        mean = spread @ b / left
        second = spread + mean @ mean.transpose(1, 2)
        squares = torch.diagonal(second, dim1=1, dim2=2).mean(dim=0)
        shift, turn = squares[:3].mean() + floor, squares[3:].mean() + floor
        rest = total - 2.0 * (mean * b).sum() + (M * second).sum()
        left = rest.clamp(min=0.0) / (2 * len(off)) + floor
    return float(shift), float(turn), float(left)


def _rays(target: Tensor, view: View) -> Tensor:
    """Unit vectors to where a camera shows targets, (n, 3)."""
    uv = target[:, :2] * view.tan
    ray = torch.cat([uv, torch.ones_like(uv[:, :1])], dim=1)
    return (view.rotation @ (ray / ray.norm(dim=1, keepdim=True))[:, :, None])[:, :, 0]


def _in_view(target: Tensor) -> Tensor:
    return (target[:, 3] > 0.5) & (target[:, :2].abs().amax(dim=1) < 1.0)


def _double(column: npt.NDArray[np.generic]) -> Tensor:
    return torch.from_numpy(np.asarray(column, np.float64))
