"""Rehearsal: the head learns from frames without their images."""

import numpy as np
import pytest
import torch

from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.pretrain import pretrain
from hvs_suite.policies.network.dataset import read_manifest
from hvs_suite.policies.network.network import Sighting
from hvs_suite.policies.network.rehearsal import drawn_sightings


def truths(n, seed):
    """u, v, diameter, visible; every third is hidden."""
    random = np.random.default_rng(seed)
    seen = (np.arange(n) % 3 > 0).astype(float)
    columns = [random.uniform(-0.8, 0.8, (n, 2)), random.uniform(0.05, 0.5, (n, 1)), seen[:, None]]
    truth = np.concatenate(columns, axis=1)
    truth[seen == 0, :3] = 0.0
    return torch.from_numpy(truth.astype(np.float32))


def sighting_of(truth, off):
    """An eye that is off by ``off`` times the diameter, and says so."""
    seen = truth[:, 3:] > 0.5
    uv = truth[:, :2] + off * truth[:, 2:3]
    uv = torch.where(seen, uv, torch.full_like(uv, -7.0))
    log_diameter = truth[:, 2:3].clamp(min=1e-3).log() + off
    logit = torch.where(seen, 3.0, -4.0)
    return Sighting(uv, log_diameter, logit, 10.0 * off * logit)


def test_errors_and_doubts_are_those_of_eyes_that_saw_about_the_same():
    truth, wanted = truths(300, 0), truths(600, 1)
    made = {"eih": sighting_of(truth, 0.1)}
    drawn = drawn_sightings(made, {"eih": truth}, {"eih": wanted}, torch.Generator())["eih"]
    seen = wanted[:, 3] > 0.5
    off = drawn.uv[seen] - wanted[seen, :2]
    # Drawn from frames of about the same size, an error is about a tenth of this diameter.
    near = 0.1 * wanted[seen, 2:3]
    assert (off - near).abs().max() < 0.006
    assert (off - near).abs().max() > 0.0
    grown = drawn.log_diameter[seen] - wanted[seen, 2:3].log()
    torch.testing.assert_close(grown, torch.full_like(grown, 0.1), atol=1e-5, rtol=0.0)
    assert (drawn.visible_logit[seen] == 3.0).all()
    assert (drawn.uv[~seen] == -7.0).all()
    assert (drawn.visible_logit[~seen] == -4.0).all()
    assert (drawn.trust_logit[~seen] == -4.0).all()


@pytest.mark.parametrize("visible", [0.0, 1.0])
def test_where_no_eye_tells_the_truth_stands_in(visible):
    truth, wanted = truths(30, 0), truths(60, 1)
    truth = truth[truth[:, 3] == visible]
    made = {"eih": sighting_of(truth, 0.1)}
    drawn = drawn_sightings(made, {"eih": truth}, {"eih": wanted}, torch.Generator())["eih"]
    other = wanted[:, 3] != visible
    torch.testing.assert_close(drawn.uv[other], wanted[other, :2])
    assert ((drawn.visible_logit[other] > 0) == (wanted[other, 3:] > 0.5)).all()


def test_it_teaches_the_head_and_leaves_the_eyes_alone(dataset, tmp_path):
    from hvs_suite.policies.imitation.settings import Settings, new_policy

    manifest = read_manifest(dataset)
    settings = Settings(
        seed=0, batch_size=4, learning_rate=1e-3, dagger_rounds=0, dagger_frames=1, dataset="",
        task=manifest.task, inputs=None, episodes=None, rehearsal_frames=16, keypoint_weight=1.0,
        error_scale=0.005, eyes=None,
    )  # fmt: skip
    policy = new_policy(manifest, settings)
    demonstrations = Demonstrations(manifest, tmp_path / "cache", 0)
    lesson = policy.supervise(demonstrations.batch(np.arange(8)))
    batch = demonstrations.batch(np.arange(16), pictures=False)
    assert not [key for key in batch if ".images." in key]
    policy.rehearse(batch, lesson, torch.Generator()).backward()
    moved = {
        name.split(".")[1]
        for name, parameter in policy.named_parameters()
        if parameter.grad is not None and parameter.grad.abs().max() > 0
    }
    always = {"head", "step_gain", "stride_gain", "onward_step_gain", "onward_stride_gain"}
    assert always <= moved <= always | {"above_gain", "memory_trust", "log_height_doubt"}


def test_a_run_without_supervision_has_nothing_to_rehearse_on(dataset, tmp_path):
    outcome = pretrain(dataset, tmp_path / "out", steps=2, batch_size=4, keypoint_weight=0.0)
    assert outcome.step == 2
