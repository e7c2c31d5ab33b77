"""Foresight: where a moving target will be, by how targets moved in the demonstrations."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import hvs_suite
from hvs_suite.policies.belief.foresight import PAST_STEPS, Foresight
from hvs_suite.policies.imitation.settings import new_policy, settings_for
from hvs_suite.policies.training.dataset import GOAL_VELOCITY, read_manifest

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
PERIOD_S = 0.1
STEPS = 60
AHEAD_S = 0.2
SURE_M2 = (3e-5) ** 2


def ways(split: str, n: int) -> tuple[Tensor, Tensor]:
    """Motions of ``track-hard`` on one level: places (n, STEPS, 3) m and velocities (m/s)."""
    times = PERIOD_S * np.arange(STEPS)
    with hvs_suite.load("track-hard", split=split, observations="state") as env:
        motions = [env.task.source.draw(scenario).motion for scenario in range(n)]
    level = np.zeros((n, STEPS, 1))
    places = np.stack([motion.place(times) for motion in motions])
    later = np.stack([motion.place(times + 1e-3) for motion in motions])
    placed, moving = (np.concatenate([p, level], axis=2) for p in (places, (later - places) / 1e-3))
    return torch.from_numpy(placed), torch.from_numpy(moving)


def taught(places: Tensor, velocities: Tensor, n_past: int = PAST_STEPS) -> Foresight:
    foresight = Foresight(n_past, PERIOD_S)
    episode = torch.arange(len(places)).repeat_interleave(places.shape[1])
    foresight.learn(places.flatten(0, 1), velocities.flatten(0, 1), episode)
    return foresight


def followed(foresight: Foresight, places: Tensor, past: Tensor | None = None) -> Tensor:
    """What is remembered at the last of places (B, T, 3) that were seen, and before them `past`."""
    past = foresight.start(len(places)) if past is None else past
    sure, a_little = torch.full_like(places[:, 0], SURE_M2), torch.full_like(places[:, 0, :1], 1e-7)
    for place in places[:, :-1].unbind(dim=1):
        past = foresight.remember(past, place, sure, a_little)
    return past


def foretold(foresight: Foresight, past: Tensor, place: Tensor, lead_s: float = AHEAD_S) -> Tensor:
    lead = torch.full_like(place[:, :1], lead_s)
    return foresight.ahead(past, place, torch.full_like(place, SURE_M2), lead)


@pytest.fixture(scope="module")
def foresight() -> Foresight:
    return taught(*ways("train", 100))


def test_targets_are_foreseen_better_than_by_velocity_and_acceleration(
    foresight: Foresight,
) -> None:
    places, velocities = ways("dev", 40)
    random = torch.Generator().manual_seed(0)
    seen = places + SURE_M2**0.5 * torch.randn(places.shape, generator=random, dtype=places.dtype)
    seen[:, :, 2] = 0.0
    now = STEPS - 3
    past = followed(foresight, seen[:, : now + 1])
    foreseen = seen[:, now] + foretold(foresight, past, seen[:, now])
    # Even with the true ones.
    acceleration = (velocities[:, now] - velocities[:, now - 1]) / PERIOD_S
    carried = places[:, now] + AHEAD_S * velocities[:, now] + 0.5 * AHEAD_S**2 * acceleration
    truth = places[:, now + 2]
    missed, missed_so = (
        (each - truth).norm(dim=1).square().mean().sqrt() for each in (foreseen, carried)
    )
    assert missed < 3e-4
    assert missed < 0.4 * missed_so


def test_between_control_steps_it_is_interpolated(foresight: Foresight) -> None:
    places, _ = ways("dev", 10)
    past, place = followed(foresight, places[:, :-1]), places[:, -2]
    by_lead = [foretold(foresight, past, place, lead) for lead in (0.0, 0.1, 0.15, 0.2, 0.3)]
    assert by_lead[0].abs().max() == 0.0
    np.testing.assert_allclose(by_lead[1], places[:, -1] - place, atol=3e-4)
    weights = torch.tensor([-1.0, 9.0, 9.0, -1.0], dtype=torch.float64) / 16.0
    nodes = torch.stack([by_lead[k] for k in (0, 1, 3, 4)])
    np.testing.assert_allclose(by_lead[2], (weights[:, None, None] * nodes).sum(dim=0), atol=1e-12)


def test_a_target_that_never_moved_stays_where_it_is() -> None:
    places = torch.rand(20, 1, 3, dtype=torch.float64).expand(20, STEPS, 3)
    still = taught(places, torch.zeros_like(places))
    past = followed(still, places + 1e-4 * torch.rand_like(places))
    assert foretold(still, past, places[:, 0]).abs().max() == 0.0


def test_of_episodes_that_are_too_short_nothing_is_learned() -> None:
    short = torch.rand(1, PAST_STEPS, 3, dtype=torch.float64)
    assert taught(short, torch.ones_like(short)).moments.abs().max() == 0.0


def test_targets_that_come_one_after_the_other_are_not_taken_for_one_that_moves() -> None:
    places, velocities = ways("train", 20)
    one = taught(places, velocities).moments
    # The same motions, but half-way somewhere else.
    elsewhere = torch.where(torch.arange(STEPS)[:, None] < STEPS // 2, 0.0, 3.0)
    two = taught(places + elsewhere, velocities).moments
    assert two[:2].diagonal(dim1=1, dim2=2).max() < 2.0 * one.max()


def test_what_was_before_the_episode_or_was_forgotten_counts_for_nothing(
    foresight: Foresight,
) -> None:
    places, _ = ways("dev", 10)
    near, far = places[:, :8], places[:, :8] + torch.tensor([0.3, -0.2, 0.0])
    alone = foretold(foresight, followed(foresight, near), near[:, -1])
    assert (alone - (places[:, 9] - near[:, -1])).norm(dim=1).median() < 2e-3
    # Another target before it, which was forgotten when this one came.
    sure, all_of_it = torch.full_like(near[:, 0], SURE_M2), torch.ones(10, 1, dtype=torch.float64)
    past = foresight.remember(followed(foresight, far), far[:, -1], sure, all_of_it)
    after = foretold(foresight, followed(foresight, near, past), near[:, -1])
    np.testing.assert_allclose(after, alone, atol=2e-5)


@pytest.mark.parametrize("moves", [True, False])
def test_a_new_policy_has_it_where_the_targets_of_its_dataset_move(moves: bool) -> None:
    manifest = read_manifest(SAMPLE)
    if moves:
        column = {"dtype": "float32", "shape": [3], "names": ["x", "y", "z"]}
        features = {**manifest.features, GOAL_VELOCITY: column}
        manifest = dataclasses.replace(manifest, features=features)
    policy = new_policy(manifest, settings_for(manifest, [], None, {"error_scale": None}))
    assert policy.config.foresight == (PAST_STEPS if moves else 0)
    assert (policy.network.foresight is not None) == moves
