"""LeRobot's environment contract, and `lerobot-eval` run for real."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hvs_suite
from hvs_suite.cli.main import run
from hvs_suite.errors import (
    ActionError,
    OptionError,
    PolicyError,
    ScenarioError,
    UnknownTaskError,
)

SMALL = {"eih_resolution": 48, "eth_resolution": 48}

pytest.importorskip("lerobot")
# Importing LeRobot takes seconds, and half a minute on a busy machine.
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def package():
    import hvs_suite.lerobot_env

    return hvs_suite.lerobot_env


@pytest.fixture(scope="module")
def vector(package):
    from lerobot.envs import make_env

    suites = make_env(package.HvsEnvConfig(task="align-easy"), n_envs=2)
    yield suites["align-easy"][0]
    suites["align-easy"][0].close()


def test_importing_the_package_registers_the_type(package):
    from lerobot.envs import make_env_config

    config = make_env_config("hvs", task="align-thesis")
    assert isinstance(config, package.HvsEnvConfig)
    assert (config.type, config.fps, config.split) == ("hvs", 10, "test")


@pytest.mark.each_task
def test_features_follow_from_the_task(package, task):
    from lerobot.envs import env_to_policy_features

    spec = hvs_suite.TASKS[task]
    features = env_to_policy_features(package.HvsEnvConfig(task=task))
    side = spec.eth_resolution
    assert features["observation.images.eth"].shape == (3, side, side)
    assert features["observation.state"].shape == (14,)
    assert features["action"].shape == (7,)


def test_observations_have_pixels_and_agent_pos(vector):
    from lerobot.envs import preprocess_observation

    observation, _ = vector.reset(seed=[1000, 1001])
    assert observation["pixels"]["eih"].shape == (2, 112, 112, 3)
    assert observation["pixels"]["eth"].dtype == np.uint8
    assert observation["agent_pos"].shape == (2, 14)
    batch = preprocess_observation(observation)
    assert set(batch) == {
        "observation.images.eih",
        "observation.images.eth",
        "observation.state",
    }


def test_seeds_from_1000_up_are_the_first_test_scenarios(vector):
    _, info = vector.reset(seed=[1000, 1001], options={"lerobot_new_rollout": True})
    assert info["scenario"].tolist() == [0, 1]
    assert info["is_success"].tolist() == [False, False]


def test_attributes_that_lerobot_asks_for_are_there(vector):
    assert vector.call("_max_episode_steps") == (20, 20)
    assert vector.call("task") == ("align-easy", "align-easy")
    assert vector.call("task_description")[0] == hvs_suite.TASKS["align-easy"].instruction()
    assert vector.metadata["render_fps"] == 10
    vector.reset(seed=0)
    assert vector.envs[0].render().shape == (480, 480, 3)
    assert vector.single_action_space.shape == (7,)


def test_every_step_says_whether_it_succeeded(vector):
    vector.reset(seed=0)
    for _ in range(3):
        info = vector.step(np.zeros((2, 7), np.float32))[4]
        assert info["is_success"].tolist() == [False, False]


def test_actions_out_of_range_are_clipped_and_counted_and_nonsense_is_refused(vector):
    vector.reset(seed=0)
    action = np.zeros((2, 7), np.float32)
    action[1, 3] = -1.5
    assert vector.step(action)[4]["n_clipped"].tolist() == [0, 1]
    assert vector.step(action)[4]["n_clipped"].tolist() == [0, 2]
    action[1, 3] = np.nan
    with pytest.raises(ActionError, match=r"action\[3\] is nan"):
        vector.step(action)


def test_async_environments_work_in_processes_without_lerobot(package):
    suites = package.HvsEnvConfig(task="align-easy").create_envs(2, use_async_envs=True)
    vector = suites["align-easy"][0]
    try:
        _, info = vector.reset(seed=[1000, 1001])
        assert info["scenario"].tolist() == [0, 1]
        vector.step(np.zeros((2, 7), np.float32))
    finally:
        vector.close()


def test_split_length_and_options_reach_the_task(package):
    config = package.HvsEnvConfig(
        task="align-easy", split="train", episode_length=4, options={"eth_resolution": 64}
    )
    assert config.features["observation.images.eth"].shape == (64, 64, 3)
    vector = config.create_envs(1)["align-easy"][0]
    _, info = vector.reset(seed=[3])
    assert info["split"][0] == "train"
    assert vector.call("_max_episode_steps") == (4,)
    vector.close()


def test_what_lerobot_cannot_take_is_refused(package):
    with pytest.raises(UnknownTaskError, match="align-easy"):
        package.HvsEnvConfig(task="align-eas")
    with pytest.raises(OptionError, match="eih"):
        package.HvsEnvConfig(options={"eih_channels": 1})
    with pytest.raises(OptionError):
        package.HvsEnvConfig(options={"normalise_observation": True})
    with pytest.raises(OptionError, match="eth_resolution is 0 px"):
        package.HvsEnvConfig(options={"eth_resolution": 0})
    with pytest.raises(OptionError, match="both cameras off"):
        package.HvsEnvConfig(options={"observations": "joint_positions"})
    with pytest.raises(ScenarioError):
        package.HvsEnvConfig(split="").create_envs(1)


def test_the_envhub_folder_is_what_lerobot_loads(monkeypatch):
    from lerobot.envs import make_env
    from lerobot.envs.configs import HubEnvConfig

    folder = Path(__file__).parents[2] / "integrations" / "envhub"
    # In place of the Hub: the folder as it would be pushed.
    monkeypatch.setattr(
        "lerobot.envs.utils.hf_hub_download", lambda filename, **_: str(folder / filename)
    )
    suites = make_env("somebody/hvs", n_envs=2, trust_remote_code=True)
    observation, _ = suites["align-easy"][0].reset(seed=[1000, 1001])
    assert observation["pixels"]["eth"].shape == (2, 112, 112, 3)
    asked = HubEnvConfig(hub_path="somebody/hvs", task="align-fixed,align-thesis")
    others = make_env(asked, trust_remote_code=True)
    assert list(others) == ["align-fixed", "align-thesis"]
    for vectors in (suites | others).values():
        vectors[0].close()


def test_several_tasks_are_made_at_once_if_they_show_the_same(package):
    suites = package.HvsEnvConfig(task="track-line,align-easy", options=SMALL).create_envs(1)
    assert list(suites) == ["track-line", "align-easy"]
    for task, vectors in suites.items():
        assert vectors[0].call("task") == (task,)
        vectors[0].close()
    family = [name for name, spec in hvs_suite.TASKS.items() if spec.family == "track"]
    assert [spec.name for spec in package.HvsEnvConfig(task="track", options=SMALL).specs] == family
    with pytest.raises(OptionError, match="make them alike"):
        package.HvsEnvConfig(task="align-easy,track-line")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"eth_resolution": 112}, "as 3 x 48 x 48, and align-easy as 3 x 112 x 112; --env.options"),
        ({"observations": "eih+eth+joint_positions"}, "state as 14, and align-easy as 7$"),
    ],
)
def test_a_policy_of_other_sizes_is_refused_at_the_door(package, act, options, reason, monkeypatch):
    config = package.HvsEnvConfig(task="align-easy", options=SMALL | options)
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={act}"])
    with pytest.raises(PolicyError, match=reason):
        config.create_envs(1)
    fitting = package.HvsEnvConfig(task="align-easy", options=SMALL)
    fitting.create_envs(1)["align-easy"][0].close()


@pytest.fixture(scope="module")
def act(package, tmp_path_factory):
    """A checkpoint of LeRobot's ACT that has learned nothing, for pictures of 48 x 48."""
    import torch
    from lerobot.envs import env_to_policy_features
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    features = env_to_policy_features(package.HvsEnvConfig(options=SMALL))
    config = ACTConfig(
        input_features={k: f for k, f in features.items() if k != "action"},
        output_features={"action": features["action"]},
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_decoder_layers=1,
        chunk_size=4,
        n_action_steps=4,
        use_vae=False,
    )
    folder = tmp_path_factory.mktemp("policy") / "act"
    ACTPolicy(config).save_pretrained(folder)
    stats = {
        name: {
            "mean": torch.zeros(3, 1, 1) if "images" in name else torch.zeros(f.shape),
            "std": torch.ones(3, 1, 1) if "images" in name else torch.ones(f.shape),
        }
        for name, f in features.items()
    }
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


@pytest.mark.timeout(600)
def test_lerobot_eval_scores_a_policy_on_several_tasks_in_one_call(act, tmp_path, capsys):
    # No flag says where the environment is: an installed distribution does.
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_eval"),
        "--env.type=hvs",
        "--env.task=align-easy,track-line",
        "--env.episode_length=20",
        f"--env.options={json.dumps(SMALL)}",
        f"--policy.path={act}",
        "--policy.device=cpu",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        "--eval.n_episodes=2",
        f"--output_dir={tmp_path / 'out'}",
    ]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr[-3000:]
    result = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert result["overall"]["n_episodes"] == 4
    assert result["overall"]["pc_success"] == 0.0
    assert len(result["overall"]["video_paths"]) == 4
    assert list(result["per_group"]) == ["align-easy", "track-line"]
    words = f"import-lerobot {tmp_path / 'out/eval_info.json'} --policy act --task"
    assert run([*words.split(), "track-line", "--out", str(tmp_path / "track.json")]) == 0
    assert "act on track-line, unverified: 0 of 2" in capsys.readouterr().out
    assert run([*words.split(), "align-hard", "--out", str(tmp_path / "hard.json")]) == 2
    assert "holds align-easy, track-line, and align-hard not once" in capsys.readouterr().err
