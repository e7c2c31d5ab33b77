"""SAC from scratch: the thesis's network and table, a run that resumes, a folder that plays."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest
import torch
from gymnasium import spaces
from rl_state import state_of
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hvs_suite.cli.main import run
from hvs_suite.errors import OptionError, OutputError, PolicyError, UnknownTaskError
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.policies.sac.network import ThesisExtractor
from hvs_suite.policies.sac.playing import SacFactory, check_fit, read_config
from hvs_suite.policies.sac.settings import Settings
from hvs_suite.policies.sac.training import train_sac
from hvs_suite.registry import TASKS

pytestmark = pytest.mark.timeout(300)

SMALL = Settings(batch_size=4, replay_size=24, random_steps=8, collect_steps=6, hidden=(8,))
OPTIONS = {
    "options": {"eih_resolution": 16, "eth_resolution": 16, "time_limit_steps": 5},
    "settings": SMALL,
    "eval_every": 1000,
    "eval_episodes": 1,
    "checkpoint_period_s": 0.0,
}
STEPS = 42


class Killed(BaseException):
    """What a kill looks like to the loop."""


def kill_at(env_steps):
    def on_progress(progress):
        if progress.stage == "training" and progress.env_steps == env_steps:
            raise Killed

    return on_progress


def replay_of(folder, capacity=SMALL.replay_size):
    """Array to the last transitions that the run stored, oldest first."""
    shards = sorted((folder / "training" / "replay").glob("*.npz"))
    contents = [dict(np.load(path)) for path in shards]
    return {k: np.concatenate([c[k] for c in contents])[-capacity:] for k in contents[0]}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that was left alone, long enough for the memory to forget."""
    out = tmp_path_factory.mktemp("sac") / "whole"
    reports = []
    outcome = train_sac(
        "align-easy", out, steps=STEPS, seed=3, on_progress=reports.append, **OPTIONS
    )
    return out, outcome, reports


@pytest.fixture(scope="module")
def full_size(tmp_path_factory):
    """A folder that fits the named tasks, written by the command itself."""
    out = tmp_path_factory.mktemp("sac") / "policy"
    words = ["--task", "align-easy", "--out", str(out), "--steps", "6", "--random-steps", "2"]
    sizes = [
        "--batch-size",
        "2",
        "--replay-size",
        "8",
        "--collect-steps",
        "3",
        "--hidden-units",
        "8",
    ]
    assert run(["train-sac", *words, *sizes, "--eval-episodes", "1"]) == 0
    return out


def test_the_defaults_are_the_thesis_s():
    settings = Settings()
    assert (settings.learning_rate, settings.batch_size) == (3e-4, 256)
    assert (settings.tau, settings.gamma) == (0.005, 0.99)
    assert (settings.replay_size, settings.collect_steps) == (10_000, 20)
    assert settings.random_steps == 500 * TASKS["align-thesis"].time_limit_steps


def test_the_network_has_the_thesis_s_shapes():
    image = spaces.Box(0, 255, (3, 112, 112), np.uint8)
    bound = np.linspace(1.0, 3.0, 7, dtype=np.float32)
    joints = spaces.Box(-bound, bound)
    extractor = ThesisExtractor(
        spaces.Dict({"eih": image, "eth": image, "joint_positions": joints})
    )
    shapes = {name: tuple(p.shape) for name, p in extractor.named_parameters() if "weight" in name}
    for eye in ("eih", "eth"):
        assert shapes.pop(f"branches.{eye}.0.weight") == (32, 3, 3, 3)
        assert shapes.pop(f"branches.{eye}.2.weight") == (32, 32, 3, 3)
    assert shapes == {
        "branches.joint_positions.0.weight": (64, 7),
        "branches.joint_positions.2.weight": (64, 64),
    }
    batch = {
        "eih": torch.rand(2, 3, 112, 112),
        "eth": torch.rand(2, 3, 112, 112),
        "joint_positions": torch.from_numpy(np.stack([bound, -bound])),
    }
    features = extractor(batch)
    # Stride 2 twice: 112 to 55 to 27 px.
    assert features.shape == (2, 2 * 32 * 27 * 27 + 64) == (2, extractor.features_dim)
    # At its bounds a joint reads 1 and -1, as in the thesis.
    dense = extractor.branches["joint_positions"]
    expected = dense(torch.stack([torch.ones(7), -torch.ones(7)]))
    torch.testing.assert_close(features[:, -64:], expected)


def test_a_run_counts_what_it_did(whole):
    out, outcome, reports = whole
    assert outcome.env_steps == STEPS
    # Learning starts once more than 8 random steps are stored: after the second iteration.
    assert outcome.step == STEPS // 6 - 1
    assert outcome.updates_per_env_step == pytest.approx(6 / 42)
    assert [r.env_steps for r in reports if r.stage == "training"] == list(range(6, 43, 6))
    assert reports[-1].share == 1.0
    left = [report.seconds_left for report in reports if report.stage == "training"]
    assert all(seconds > 0.0 for seconds in left[:-1])
    assert left[-1] == 0.0
    told = json.loads((out / "training" / "outcome.json").read_text())
    assert (told["step"], told["env_steps"]) == (outcome.step, STEPS)
    assert told["n_parameters"] == outcome.n_parameters > 1000


def test_everything_that_was_promised_is_logged(whole):
    out, _, _ = whole
    board = EventAccumulator(str(out / "training" / "tensorboard")).Reload()
    promised = {
        "rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/success_rate", "rollout/collision",
        "rollout/position_error_mm", "rollout/tilt_error_deg", "train/actor_loss",
        "train/critic_loss", "train/ent_coef", "train/ent_coef_loss", "train/updates_per_env_step",
        "eval/episode_return", "eval/length", "eval/success_rate", "eval/collision_rate",
        "eval/position_error_mm", "eval/tilt_error_deg",
    }  # fmt: skip
    assert promised - set(board.Tags()["scalars"]) == set()
    assert [point.step for point in board.Scalars("eval/episode_return")] == [0, STEPS]
    evaluations = json.loads((out / "training" / "evaluations.json").read_text())
    assert [row["env_steps"] for row in evaluations] == [0, STEPS]
    clips = sorted(path.name for path in (out / "training" / "clips").iterdir())
    assert clips == ["0000000000.mp4", f"{STEPS:010d}.mp4"]


def test_a_killed_run_ends_like_one_that_was_left_alone(whole, tmp_path):
    out, _, _ = whole
    cut = tmp_path / "cut"
    # After 18 steps the memory still fills up; after 30 it forgets, in the middle of an episode.
    for kill in (18, 30):
        with pytest.raises(Killed):
            train_sac("align-easy", cut, steps=STEPS, seed=3, on_progress=kill_at(kill), **OPTIONS)
    (cut / "training" / "replay" / "0000000030-0000000036.npz").write_bytes(b"half a file")
    steps = []
    train_sac(
        "align-easy", cut, steps=STEPS, seed=3,
        on_progress=lambda p: steps.append((p.stage, p.env_steps)), **OPTIONS,
    )  # fmt: skip
    assert steps[0] == ("training", 36)
    (tensors, header), (expected, expected_header) = state_of(cut), state_of(out)
    assert header == expected_header
    assert tensors.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(tensors[name], value, rtol=0.0, atol=0.0, msg=name)
    replay, expected_replay = replay_of(cut), replay_of(out)
    for name, rows in expected_replay.items():
        np.testing.assert_array_equal(replay[name], rows, err_msg=name)
    assert len(expected_replay["actions"]) == SMALL.replay_size


def test_the_callers_own_draws_do_not_notice(whole, tmp_path):
    before = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    train_sac("align-easy", tmp_path / "out", steps=6, **OPTIONS)
    np.testing.assert_array_equal(before[0], np.random.get_state()[1])  # noqa: NPY002
    assert torch.equal(before[1], torch.get_rng_state())


def test_nothing_in_the_folder_is_a_pickle(whole):
    out, _, _ = whole
    files = [path for path in out.rglob("*") if path.is_file()]
    kinds = {path.suffix for path in files if "tfevents" not in path.name}
    assert kinds == {".json", ".safetensors", ".npz", ".mp4", ".png"}
    for path in (path for path in files if path.suffix == ".npz"):
        assert all(name.endswith(".npy") for name in zipfile.ZipFile(path).namelist())
        with np.load(path, allow_pickle=False) as content:
            assert {content[name].dtype.kind for name in content} <= {"u", "f"}


def test_the_command_s_folder_is_scored_like_any_policy(full_size, tmp_path, capsys):
    result = tmp_path / "result.json"
    words = ["--task", "align-easy", "--episodes", "1", "--out", str(result)]
    assert run(["evaluate", "--policy", str(full_size), *words]) == 0
    metadata = json.loads(result.read_text())["metadata"]
    weights = load_file(full_size / "model.safetensors")
    assert metadata["policy_kind"] == "checkpoint"
    assert metadata["policy_parameters"] == sum(w.numel() for w in weights.values())
    assert metadata["training_steps"] == 2
    assert 0.0 < metadata["training_hours"] < 1.0
    assert len(metadata["policy_hash"]) == 64


def test_the_folder_plays_what_the_trained_actor_plays(full_size, named):
    env = named("align-easy")
    observation = env.reset(scenario=0).observation
    policy = policy_factory(str(full_size), "align-easy")(env)
    policy.reset()
    action = policy.select_action(observation)
    assert (action.shape, action.dtype) == ((7,), np.float32)
    assert (np.abs(action) <= 1.0).all()
    np.testing.assert_array_equal(action, policy.select_action(observation))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"eth_resolution": 224}, "the task shows"),
        ({"observations": "eih+joint_positions"}, "which the task does not show"),
        ({"action_mode": "joint_delta"}, "commands joint_position"),
        ({"normalise_observation": True}, "raw observations"),
    ],
)
def test_a_folder_that_does_not_fit_is_refused(full_size, change, reason):
    spec = dataclasses.replace(TASKS["align-easy"], **change)
    with pytest.raises(PolicyError, match=reason):
        check_fit(read_config(full_size), full_size, spec)


def test_damaged_folders_are_refused(full_size, tmp_path):
    config = json.loads((full_size / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(PolicyError, match=r"no model\.safetensors"):
        policy_factory(str(tmp_path), "align-easy")
    (tmp_path / "model.safetensors").write_bytes(b"not weights")
    env = type("Env", (), {"spec": TASKS["align-easy"]})()
    with pytest.raises(PolicyError, match="no safetensors file"):
        SacFactory(str(tmp_path))(env)
    (tmp_path / "config.json").write_text(json.dumps({**config, "inputs": 3}))
    with pytest.raises(PolicyError, match="inputs"):
        policy_factory(str(tmp_path), "align-easy")


def test_a_damaged_state_is_refused_and_another_seed_too(whole, tmp_path):
    out, _, _ = whole
    with pytest.raises(OutputError, match="another seed"):
        train_sac("align-easy", out, steps=STEPS, seed=4, **OPTIONS)
    train_sac("align-easy", tmp_path / "out", steps=6, **OPTIONS)
    (tmp_path / "out" / "training" / "replay" / "0000000000-0000000006.npz").unlink()
    with pytest.raises(OutputError, match="rows 0 to 5 are missing"):
        train_sac("align-easy", tmp_path / "out", steps=12, **OPTIONS)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"steps": 0},
        {"minutes": float("nan")},
        {"steps": 1, "seed": -1},
        {"steps": 1, "split": "test"},
        {"steps": 1, "eval_every": 0},
        {"steps": 1, "device": "abacus"},
        {"steps": 1, "rewards": ("applause",)},
        {"steps": 1, "options": {"observations": "eih+eth_depth"}},
        {"steps": 1, "options": {"normalise_observation": True}},
    ],
)
def test_values_that_make_no_sense_are_refused(tmp_path, options):
    with pytest.raises(OptionError):
        train_sac("align-easy", tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "values",
    [{"learning_rate": 0.0}, {"tau": 2.0}, {"batch_size": 0}, {"random_steps": -1}, {"hidden": ()}],
)
def test_settings_that_make_no_sense_are_refused(values):
    with pytest.raises(OptionError):
        Settings(**values)


def test_an_unknown_task_is_refused(tmp_path):
    with pytest.raises(UnknownTaskError, match="align-easy"):
        train_sac("align-eazy", tmp_path / "out", steps=1)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--task", "align-thesys"], "align-thesis"),
        (["--task", "align-easy", "--steps", "0"], "steps"),
        (["--task", "align-easy", "--batch-size", "0"], "batch_size"),
        (["--task", "align-easy", "--reward", "applause"], "applause"),
    ],
)
def test_the_command_refuses_bad_input_in_one_line(words, reason, tmp_path, capsys):
    assert run(["train-sac", *words, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert reason in err
