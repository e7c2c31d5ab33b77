"""What eyes, belief and head learn from in turns, and that a run resumes in each of these turns."""

import json
import math
import shutil
from pathlib import Path

import miniature
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hvs_suite.errors import DatasetError, OptionError
from hvs_suite.policies.belief.network import SET_POINT
from hvs_suite.policies.checkpoints.loading import CheckpointFactory, load_network
from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.pretrain import pretrain
from hvs_suite.policies.imitation.windows import WindowPool
from hvs_suite.policies.training.dataset import read_manifest
from hvs_suite.registry import load

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
SMALL = {
    "slopes": ("eih",),
    "batch_size": 8,
    "windows": 6,
    "window_steps": 6,
    "checkpoint_period_s": 0.0,
    "workers": 1,
}


class Killed(BaseException):
    """What a kill looks like to the loop."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("belief") / "out"
    pretrain(SAMPLE, out, steps=12, dagger_rounds=1, dagger_frames=24, **SMALL)
    return out


def weights(folder: Path):
    return load_file(folder / "model.safetensors")


def test_a_run_learns_from_its_rounds_and_ends_in_a_checkpoint_that_plays(trained):
    outcome = json.loads((trained / "training/outcome.json").read_text())
    assert outcome["step"] == 12
    assert math.isfinite(outcome["held_out_loss"])
    assert [played["frames"] for played in outcome["rounds"]] == [24]
    assert json.loads((trained / "config.json").read_text())["type"] == "hvs"
    with load("align-thesis", split="dev") as env:
        policy = CheckpointFactory(str(trained))(env)
        seen = env.reset(scenario=0).observation
        policy.reset()
        first, second = policy.select_action(seen), policy.select_action(seen)
    assert first.shape == (7,)
    assert (np.abs(first) <= 1.0).all()
    # The second look at the same is another, because the first is remembered.
    assert (first != second).any()


@pytest.mark.parametrize("step", [4, 9])  # just after the eyes looked at all frames, and later
def test_a_killed_run_ends_like_one_that_was_left_alone(trained, tmp_path, step):
    def kill(progress):
        if progress.stage == "training" and progress.step == step:
            raise Killed

    options = {"steps": 12, "dagger_rounds": 1, "dagger_frames": 24, **SMALL}
    with pytest.raises(Killed):
        pretrain(SAMPLE, tmp_path / "cut", on_progress=kill, **options)
    pretrain(SAMPLE, tmp_path / "cut", **options)
    whole, cut = weights(trained), weights(tmp_path / "cut")
    for name, value in whole.items():
        np.testing.assert_array_equal(value, cut[name], err_msg=name)


def test_windows_hold_the_frames_of_one_episode_and_what_was_remembered(trained, tmp_path):
    demonstrations = Demonstrations(read_manifest(SAMPLE), tmp_path / "cache", 0)
    network = load_network(trained)
    pool = WindowPool(demonstrations, None, None)
    pool.look(network)
    begins, lengths = demonstrations.episodes()
    columns = demonstrations.columns()
    only = np.arange(len(begins)) == 1
    window = pool.draw(network, only, 40, 5, np.random.default_rng(0))
    rows = columns["observation.state"][begins[1] : begins[1] + lengths[1]]
    drawn = window.state[window.counts].numpy()
    assert {frame.tobytes() for frame in drawn} == {frame.tobytes() for frame in rows}
    assert not window.counts.all()  # some windows reach beyond the end
    at_first = (window.state[:, 0].numpy() == rows[0]).all(axis=1)
    fresh = network.start(1)[0]
    assert at_first.any()
    assert (window.memory[torch.from_numpy(at_first)] == fresh).all()
    assert (window.memory[torch.from_numpy(~at_first)] != fresh).any(dim=1).all()
    assert window.memory[:, SET_POINT].shape == (40, 7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"windows": 0}, "windows must be at least 1"),
        ({"window_steps": 0}, "window_steps must be at least 1"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path, options, message):
    with pytest.raises(OptionError, match=message):
        pretrain(SAMPLE, tmp_path / "out", steps=1, **{**SMALL, **options})


def test_a_dataset_without_what_nobody_can_see_is_refused(tmp_path):
    columns = miniature.scene(8, side=112)
    miniature.write_dataset(
        tmp_path / "data", columns, miniature.episodes(8), options={"joint_offset_deg": 0.05}
    )
    with pytest.raises(DatasetError, match=r"lacks privileged\.joint_offset"):
        pretrain(tmp_path / "data", tmp_path / "out", steps=1, **SMALL)


def test_a_dataset_that_does_not_say_what_is_true_is_refused(tmp_path):
    columns = miniature.scene(8, side=112)
    del columns["privileged.goal_normal"]
    miniature.write_dataset(tmp_path / "data", columns, miniature.episodes(8))
    with pytest.raises(DatasetError, match="lacks privileged"):
        pretrain(tmp_path / "data", tmp_path / "out", steps=1, **SMALL)
    shutil.rmtree(tmp_path / "out")
