"""Behaviour cloning: it learns, resumes to the same end, and refuses what it should."""

import json
import math
import shutil
from pathlib import Path

import miniature
import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from hvs_suite.errors import DatasetError, OptionError, OutputError, PolicyError
from hvs_suite.policies.belief.acting import CompiledBelief, act
from hvs_suite.policies.checkpoints.loading import load_network
from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.pretrain import pretrain
from hvs_suite.policies.training.dataset import read_manifest


def weights(folder: Path):
    return load_file(folder / "model.safetensors")


STEP = {"steps": 1, "batch_size": 4, "windows": 4, "window_steps": 4}


class Killed(BaseException):
    """What a kill looks like to the loop."""


def kill_after(steps: int):
    def on_progress(progress):
        if progress.step == steps:
            raise Killed

    return on_progress


def test_training_lowers_the_loss_and_reports_it(dataset, tmp_path):
    reports = []
    outcome = pretrain(
        dataset,
        tmp_path / "out",
        steps=40,
        batch_size=16,
        windows=8,
        window_steps=4,
        on_progress=reports.append,
    )
    training = [r for r in reports if r.stage == "training"]
    assert [r.step for r in training] == list(range(1, 41))
    # The eyes learn first.
    assert training[19].loss < 0.9 * training[0].loss
    assert training[-1].share == 1.0
    assert sum(r.stage == "decoding" for r in reports) >= 1
    assert outcome.step == 40
    assert math.isfinite(outcome.held_out_loss)
    assert json.loads((tmp_path / "out/training/outcome.json").read_text())["step"] == 40
    assert list((tmp_path / "out/training/tensorboard").iterdir())
    with Image.open(tmp_path / "out/training/training.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 50


def test_a_killed_run_ends_like_one_that_was_left_alone(dataset, tmp_path):
    options = {"steps": 6, "batch_size": 8, "seed": 3, "checkpoint_period_s": 0.0}
    pretrain(dataset, tmp_path / "whole", **options)
    with pytest.raises(Killed):
        pretrain(dataset, tmp_path / "cut", on_progress=kill_after(3), **options)
    steps = []
    pretrain(dataset, tmp_path / "cut", on_progress=lambda p: steps.append(p.step), **options)
    assert steps == [4, 5, 6]
    whole, cut = weights(tmp_path / "whole"), weights(tmp_path / "cut")
    assert whole.keys() == cut.keys()
    for name, value in whole.items():
        np.testing.assert_array_equal(value, cut[name], err_msg=name)


def test_a_run_killed_before_its_first_checkpoint_starts_again(dataset, tmp_path):
    def on_decoding(progress):
        raise Killed

    with pytest.raises(Killed):
        pretrain(dataset, tmp_path / "out", steps=2, batch_size=4, on_progress=on_decoding)
    assert pretrain(dataset, tmp_path / "out", steps=2, batch_size=4).step == 2


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(dataset, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        pretrain(dataset, tmp_path / name, steps=2, batch_size=4, seed=seed)
    a, b, c = (weights(tmp_path / name) for name in "abc")
    assert all((a[k] == b[k]).all() for k in a)
    assert any((a[k] != c[k]).any() for k in a)


def test_frames_come_back_from_the_cache_as_they_were_recorded(dataset, tmp_path):
    columns = miniature.scene(40)
    for _ in range(2):  # decoded, then opened again
        decoded = []
        demonstrations = Demonstrations(
            read_manifest(dataset), tmp_path / "cache", 0, on_frames=decoded.append
        )
        batch = demonstrations.batch(np.array([7, 31]))
        for camera in ("eih", "eth"):
            key = f"observation.images.{camera}"
            np.testing.assert_array_equal(batch[key].permute(0, 2, 3, 1), columns[key][[7, 31]])
        np.testing.assert_array_equal(batch["action"], columns["action"][[7, 31]])
    assert decoded == []


def test_held_out_frames_are_whole_episodes_that_training_never_sees(dataset, tmp_path):
    demonstrations = Demonstrations(read_manifest(dataset), tmp_path, seed=0)
    held_out = set(demonstrations.held_out // 4)
    assert held_out
    assert held_out.isdisjoint(set(demonstrations.training // 4))
    assert len(demonstrations.held_out) + len(demonstrations.training) == 40


def test_of_few_demonstrations_only_those_are_seen(dataset, tmp_path):
    demonstrations = Demonstrations(read_manifest(dataset), tmp_path, seed=0, episodes=3)
    # And no more are decoded.
    assert len(np.load(tmp_path / "observation.images.eih.npy", mmap_mode="r")) == len(
        demonstrations
    )
    seen = np.concatenate([demonstrations.held_out, demonstrations.training])
    assert sorted(seen) == list(range(12))


def test_of_few_demonstrations_nothing_is_known_of_the_others(tmp_path):
    columns = miniature.scene(80)
    for name, n in (("all", 80), ("few", 40)):
        first = {key: column[:n] for key, column in columns.items()}
        miniature.write_dataset(tmp_path / name, first, miniature.episodes(n))
    pretrain(tmp_path / "few", tmp_path / "a", episodes=10, **STEP)
    pretrain(tmp_path / "all", tmp_path / "b", episodes=10, **STEP)
    a, b = (weights(tmp_path / name) for name in "ab")
    for name, value in a.items():
        np.testing.assert_array_equal(value, b[name], err_msg=name)


@pytest.mark.parametrize("camera", ["eih", "eth"])
def test_a_policy_of_one_camera_has_no_more(dataset, tmp_path, camera):
    pretrain(dataset, tmp_path / "out", inputs=(camera,), **STEP)
    config = json.loads((tmp_path / "out/config.json").read_text())
    assert set(config["input_features"]) == {f"observation.images.{camera}", "observation.state"}
    assert not config["reads_positions"]
    assert not config["reads_velocities"]


def test_a_policy_may_see_grey_where_the_dataset_has_colour(dataset, tmp_path):
    pretrain(dataset, tmp_path / "out", grey=("eth",), **STEP)
    config = json.loads((tmp_path / "out/config.json").read_text())
    shapes = {key: feature["shape"] for key, feature in config["input_features"].items()}
    assert shapes["observation.images.eth"] == [1, 28, 28]
    assert shapes["observation.images.eih"] == [3, 28, 28]
    manifest = read_manifest(dataset)
    colour, grey = (
        Demonstrations(each, tmp_path / name, 0).batch(np.arange(2))["observation.images.eth"]
        for name, each in (
            ("colour", manifest),
            ("grey", manifest.with_cameras(("eth",), ("eth",))),
        )
    )
    luma = colour[:, 0] * 0.299 + colour[:, 1] * 0.587 + colour[:, 2] * 0.114
    np.testing.assert_allclose(grey[:, 0], luma, atol=0.51)
    with pytest.raises(OptionError, match="unknown camera 'top'"):
        pretrain(dataset, tmp_path / "other", grey=("top",), **STEP)
    with pytest.raises(OptionError, match="unknown input 'top'"):
        pretrain(dataset, tmp_path / "other", inputs=("top",), **STEP)


def check_compiled(folder):
    """What plays a policy fast decides as the policy does."""
    network = load_network(folder)
    image = torch.rand(1, 3, 28, 28, generator=torch.Generator().manual_seed(0))
    images, state = {"eih": image, "eth": image}, torch.zeros(1, 14)
    slow, _ = act(network, images, state, network.start(1))
    fast, _ = CompiledBelief(network)(images, state, None)
    torch.testing.assert_close(fast, slow, atol=1e-6, rtol=0)


def test_eyes_of_chosen_cameras_tell_slopes_by_themselves(dataset, tmp_path):
    pretrain(dataset, tmp_path / "out", slopes=("eih",), **STEP)
    assert json.loads((tmp_path / "out/config.json").read_text())["slopes"] == ["eih"]
    judges = [name for name in weights(tmp_path / "out") if name.endswith(".slope.n_lessons")]
    assert len(judges) == 1
    assert ".eih." in judges[0]
    check_compiled(tmp_path / "out")
    with pytest.raises(OptionError, match="unknown camera 'top'"):
        pretrain(dataset, tmp_path / "other", slopes=("top",), **STEP)
    with pytest.raises(OptionError, match="unknown camera 'eih'; choose from eth"):
        pretrain(dataset, tmp_path / "other", inputs=("eth",), slopes=("eih",), **STEP)


def test_eyes_can_learn_alone(dataset, tmp_path):
    options = {"batch_size": 4, "learning_rate": 1e-2, "seed": 0}
    for name, steps in (("begun", 1), ("learned", 4)):
        pretrain(dataset, tmp_path / name, steps=steps, eye_share=1.0, **options)
    before, after = weights(tmp_path / "begun"), weights(tmp_path / "learned")
    changed = {name for name in after if (after[name] != before[name]).any()}
    assert changed
    assert all(".eyes." in name for name in changed)


def test_without_keypoints_the_eyes_learn_from_what_belief_and_head_make_of_it(dataset, tmp_path):
    options = {"batch_size": 8, "windows": 2, "window_steps": 4, "without": ("keypoints",)}
    pretrain(dataset, tmp_path / "begun", **options, steps=1)
    pretrain(dataset, tmp_path / "learned", **options, steps=6)
    before, after = weights(tmp_path / "begun"), weights(tmp_path / "learned")
    changed = {name for name in after if (after[name] != before[name]).any()}
    assert {name.split(".")[1] for name in changed} >= {"eyes", "belief", "head"}


def test_a_policy_may_be_made_without_a_memory(dataset, tmp_path):
    pretrain(dataset, tmp_path / "out", without=("memory",), **STEP)
    assert not json.loads((tmp_path / "out/config.json").read_text())["remembers"]
    assert not load_network(tmp_path / "out").shape.remembers
    check_compiled(tmp_path / "out")
    with pytest.raises(OptionError, match="unknown part 'head'; choose from memory, keypoints"):
        pretrain(dataset, tmp_path / "other", without=("head",), **STEP)


def test_a_head_may_be_told_to_correct_near_the_goal_alone(dataset, tmp_path):
    pretrain(dataset, tmp_path / "out", corrects_within_m=0.04, **STEP)
    assert load_network(tmp_path / "out").shape.corrects_within_m == 0.04
    check_compiled(tmp_path / "out")
    with pytest.raises(OptionError, match="corrects_within_m must be above 0"):
        pretrain(dataset, tmp_path / "other", corrects_within_m=0.0, **STEP)


def test_eyes_alone_learn_slopes_once_they_have_found_the_target(dataset, tmp_path):
    options = {"steps": 2, "batch_size": 4, "eye_share": 1.0, "slopes": ("eih",)}
    pretrain(dataset, tmp_path / "out", **options)
    first = weights(tmp_path / "out")
    [lessons] = [value for name, value in first.items() if name.endswith("eih.slope.n_lessons")]
    assert lessons == 1
    # The same command finds that all is done.
    pretrain(dataset, tmp_path / "out", **options)
    again = weights(tmp_path / "out")
    assert all((again[name] == value).all() for name, value in first.items())


def test_how_far_off_a_camera_is_can_be_part_of_the_belief(dataset, tmp_path):
    pretrain(dataset, tmp_path / "out", offsets=("eth",), **STEP)
    assert json.loads((tmp_path / "out/config.json").read_text())["offsets"] == ["eth"]
    check_compiled(tmp_path / "out")
    with pytest.raises(OptionError, match="unknown camera 'top'"):
        pretrain(dataset, tmp_path / "other", offsets=("top",), **STEP)
    config = json.loads((tmp_path / "out/config.json").read_text())
    del config["input_features"]["observation.images.eth"]
    (tmp_path / "out/config.json").write_text(json.dumps(config))
    with pytest.raises(PolicyError, match="it has no camera 'eth'"):
        load_network(tmp_path / "out")


def test_errors_weigh_by_the_tolerance_unless_told_otherwise(dataset, tmp_path):
    scales = []
    for name, options in (("a", {}), ("b", {"error_scale": 0.5})):
        pretrain(dataset, tmp_path / name, steps=1, batch_size=4, **options)
        scales.append(json.loads((tmp_path / name / "config.json").read_text())["error_scale"])
    assert scales == [0.025, 0.5]


def test_eyes_of_another_policy_are_where_training_begins(dataset, large_dataset, tmp_path):
    learned, out = tmp_path / "learned", tmp_path / "run"
    pretrain(dataset, learned, steps=2, batch_size=4)
    pretrain(dataset, out, steps=1, batch_size=4, learning_rate=1e-9, seed=1, eyes=[learned])
    after = weights(out)
    for name, before in weights(learned).items():
        change = (after[name] - before).abs().max().item()
        assert change < 1e-6 or ".eyes." not in name
        assert change > 1e-6 or ".head." not in name or "bias" in name
    assert json.loads((out / "train_config.json").read_text())["settings"]["eyes"]
    with pytest.raises(PolicyError, match="not a LeRobot checkpoint"):
        pretrain(dataset, tmp_path / "other", steps=1, eyes=[tmp_path])
    with pytest.raises(PolicyError, match="no eyes that fit"):
        pretrain(large_dataset, tmp_path / "large", steps=1, batch_size=4, eyes=[learned])


def test_an_eye_that_is_kept_learns_no_more_and_the_others_do(dataset, tmp_path):
    learned, out = tmp_path / "learned", tmp_path / "run"
    pretrain(dataset, learned, steps=2, batch_size=4)
    pretrain(dataset, out, steps=3, batch_size=4, seed=1, eyes=[learned], kept_eyes=("eih",))
    after = weights(out)
    for name, before in weights(learned).items():
        if ".eyes.eih." in name:
            assert torch.equal(after[name], before)
    assert any(
        not torch.equal(after[name], before)
        for name, before in weights(learned).items()
        if ".eyes.eth." in name
    )
    with pytest.raises(PolicyError, match="no eyes were given for eih"):
        pretrain(dataset, tmp_path / "none", steps=1, kept_eyes=("eih",))
    with pytest.raises(OptionError, match="must leave a camera"):
        pretrain(dataset, tmp_path / "all", steps=1, eyes=[learned], kept_eyes=("eih", "eth"))
    with pytest.raises(OptionError, match="unknown camera 'eye'"):
        pretrain(dataset, tmp_path / "eye", steps=1, eyes=[learned], kept_eyes=("eye",))


def test_a_policy_can_be_trained_on_whole_and_its_eyes_be_left_alone(dataset, tmp_path):
    learned, out = tmp_path / "learned", tmp_path / "run"
    pretrain(dataset, learned, steps=2, batch_size=4, slopes=("eih",))
    alone = {"weights": learned, "slopes": ("eih",), "eye_share": 0.0}
    pretrain(dataset, out, steps=2, seed=1, **alone)
    before, after = weights(learned), weights(out)
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    assert changed
    assert not any(".eyes." in name for name in changed)
    pretrain(dataset, tmp_path / "same", steps=1, learning_rate=1e-9, **alone)
    for name, value in weights(tmp_path / "same").items():
        torch.testing.assert_close(value, before[name], atol=1e-6, rtol=0)
    with pytest.raises(PolicyError, match=r"other layers .* give the --inputs, --slopes"):
        pretrain(dataset, tmp_path / "level", steps=1, weights=learned)
    with pytest.raises(OptionError, match="give --eyes or --weights"):
        pretrain(dataset, tmp_path / "both", steps=1, weights=learned, eyes=[learned])
    with pytest.raises(OptionError, match="fresh eyes must learn"):
        pretrain(dataset, tmp_path / "fresh", steps=1, eye_share=0.0)


def test_data_recorded_on_the_test_split_is_refused(tmp_path):
    root = tmp_path / "data"
    miniature.write_dataset(root, miniature.scene(4), miniature.episodes(4), split="test")
    with pytest.raises(DatasetError, match="test split"):
        pretrain(root, tmp_path / "out", steps=1)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_no_dataset_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="not a LeRobot dataset"):
        pretrain(tmp_path / "nothing", tmp_path / "out", steps=1)


def test_a_dataset_with_frames_missing_is_refused(dataset, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(dataset, root)
    (root / "data/chunk-000/file-001.parquet").unlink()
    with pytest.raises(DatasetError, match="declares 40 frames but holds 20"):
        pretrain(root, tmp_path / "out", steps=1)


def test_a_folder_in_use_is_refused(dataset, tmp_path):
    (tmp_path / "letter.txt").write_text("dear reader")
    with pytest.raises(OutputError, match="not empty"):
        pretrain(dataset, tmp_path, steps=1)


def test_a_run_with_other_settings_is_not_mixed_into(dataset, tmp_path):
    pretrain(dataset, tmp_path / "out", steps=1, batch_size=4, seed=0)
    with pytest.raises(OutputError, match="another seed"):
        pretrain(dataset, tmp_path / "out", steps=1, batch_size=4, seed=1)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"steps": 0},
        {"minutes": -1.0},
        {"minutes": math.nan},
        {"steps": 1, "batch_size": 0},
        {"steps": 1, "learning_rate": 0.0},
        {"steps": 1, "episodes": 11},
        {"steps": 1, "error_scale": 0.0},
        {"steps": 1, "inputs": ("eih", "nose")},
        {"steps": 1, "inputs": ()},
        {"steps": 1, "device": "abacus"},
        {"steps": 1, "device": "meta"},
        {"steps": 1, "eye_share": 0.0},
        {"steps": 1, "eye_share": 1.0, "dagger_rounds": 1},
    ],
)
def test_numbers_that_make_no_sense_are_refused(dataset, tmp_path, options):
    with pytest.raises(OptionError):
        pretrain(dataset, tmp_path / "out", **options)
