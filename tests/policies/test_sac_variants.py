"""Variants of SAC that the thesis asks for: a shared trunk, shared or pretrained eyes, a guide."""

import json

import numpy as np
import pytest
import torch
from gymnasium import spaces
from rl_state import state_of
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hvs_suite.cli.main import run
from hvs_suite.datasets.expert import make_expert
from hvs_suite.errors import OptionError
from hvs_suite.policies.catalogue import checkpoint_folder, policy_factory
from hvs_suite.policies.rl.guide import GUIDED, PLAYED, Guide, Guided, PlayedActions
from hvs_suite.policies.sac.network import ThesisExtractor
from hvs_suite.policies.sac.settings import Settings
from hvs_suite.policies.sac.training import train_sac
from hvs_suite.registry import load

pytestmark = pytest.mark.timeout(300)

SIZES = {
    "batch_size": 4,
    "replay_size": 24,
    "random_steps": 8,
    "collect_steps": 6,
    "hidden": (8,),
}
QUICK = {"eval_every": 1000, "eval_episodes": 1, "checkpoint_period_s": 0.0}
SMALL = {
    "eih_resolution": 16,
    "eth_resolution": 16,
    "time_limit_steps": 6,
    "observations": "eih+eth+joint_positions+joint_torques",
}
SHARING = {
    "settings": Settings(**SIZES, eyes="shared", shared_trunk=True),
    "guide": Guide("expert", make_expert, 0.5),
    "options": SMALL,
    "seed": 5,
    **QUICK,
}
STEPS = 48


class Killed(BaseException):
    """What a kill looks like to the loop."""


@pytest.fixture(scope="module")
def sharing(tmp_path_factory):
    """A run in which everything is shared and the expert plays half of the episodes."""
    out = tmp_path_factory.mktemp("sac") / "sharing"
    train_sac("align-easy", out, steps=STEPS, **SHARING)
    return out


@pytest.fixture(scope="module")
def seeing(tmp_path_factory):
    """A run with the eyes of the shipped weights, made by the command."""
    out = tmp_path_factory.mktemp("sac") / "seeing"
    words = ["--task", "align-thesis", "--out", str(out), "--steps", "9", "--random-steps", "2",
             "--batch-size", "2", "--replay-size", "8", "--collect-steps", "3",
             "--hidden-units", "8", "--eval-episodes", "1", "--eyes", "pretrained"]  # fmt: skip
    assert run(["train-sac", *words]) == 0
    return out


def space(**sides):
    """Images of these sides, and joints."""
    images = {name: spaces.Box(0, 255, (3, side, side), np.uint8) for name, side in sides.items()}
    return spaces.Dict({**images, "joint_positions": spaces.Box(-3.0, 3.0, (7,))})


def test_shared_eyes_are_one_network_for_images_of_any_size():
    apart = ThesisExtractor(space(eih=16, eth=32))
    shared = ThesisExtractor(space(eih=16, eth=32), eyes="shared")
    assert shared.features_dim == apart.features_dim
    eye = sum(p.numel() for p in apart.branches["eih"].parameters())
    sizes = [sum(p.numel() for p in each.parameters()) for each in (apart, shared)]
    assert sizes[0] - sizes[1] == eye
    same = ThesisExtractor(space(eih=16, eth=16), eyes="shared")
    image = torch.rand(1, 3, 16, 16)
    features = same({"eih": image, "eth": image, "joint_positions": torch.zeros(1, 7)})
    per_image = (same.features_dim - 64) // 2
    torch.testing.assert_close(features[:, :per_image], features[:, per_image : 2 * per_image])


def test_a_shared_trunk_is_the_actor_s_and_the_critics_(sharing):
    weights, _ = state_of(sharing)
    trunk = "features_extractor.branches.joint_positions.0.weight"
    assert torch.equal(weights[f"policy/actor.{trunk}"], weights[f"policy/critic.{trunk}"])
    begun = load_file(sharing / "model.safetensors")
    assert torch.equal(weights[f"policy/actor.{trunk}"], begun[trunk])


def test_a_killed_run_with_a_guide_ends_like_one_that_was_left_alone(sharing, tmp_path):
    cut = tmp_path / "cut"

    def kill(progress):
        if progress.stage == "training" and progress.env_steps == 36:
            raise Killed

    with pytest.raises(Killed):
        train_sac("align-easy", cut, steps=STEPS, on_progress=kill, **SHARING)
    train_sac("align-easy", cut, steps=STEPS, **SHARING)
    (tensors, header), (expected, expected_header) = state_of(cut), state_of(sharing)
    assert header == expected_header
    for name, value in expected.items():
        torch.testing.assert_close(tensors[name], value, rtol=0.0, atol=0.0, msg=name)


def test_the_share_of_guided_episodes_is_logged(sharing):
    board = EventAccumulator(str(sharing / "training" / "tensorboard")).Reload()
    guided = [episode["guided"] for episode in state_of(sharing)[1]["recent"]]
    assert {True, False} == set(guided)
    assert board.Scalars("rollout/guided")[-1].value == pytest.approx(np.mean(guided))


def test_a_guide_plays_its_episodes_from_start_to_goal_and_no_others():
    import gymnasium

    plain = gymnasium.make("hvs_suite/align-easy-v1", observations="state")
    env = Guided(plain, Guide("expert", make_expert, 0.5), seed=1)
    proposed = np.zeros(7, np.float32)
    mine = []
    for scenario in range(12):
        _, info = env.reset(options={"scenario": scenario})
        mine.append(info[GUIDED])
        over = False
        while not over:
            _, _, terminated, truncated, info = env.step(proposed)
            assert info[GUIDED] == mine[-1] == (PLAYED in info)
            over = terminated or truncated
        assert info["is_success"] == mine[-1]
    assert 2 <= sum(mine) <= 10
    again = [env.reset(options={"scenario": i})[1][GUIDED] for i in range(12)]
    assert again == mine
    other = Guided(plain, Guide("expert", make_expert, 0.5), seed=2)
    assert [other.reset(options={"scenario": i})[1][GUIDED] for i in range(12)] != mine


def test_the_replay_memory_holds_what_the_guide_did():
    seen = spaces.Dict({"joint_positions": spaces.Box(-3.0, 3.0, (7,))})
    memory = PlayedActions(4, seen, spaces.Box(-1.0, 1.0, (7,)))
    row = {"joint_positions": np.zeros((1, 7), np.float32)}
    proposed, played = np.zeros((1, 7), np.float32), np.full(7, 0.5, np.float32)
    for info in ({PLAYED: played}, {}):
        memory.add(row, row, proposed, np.zeros(1), np.zeros(1), [info])
    np.testing.assert_array_equal(memory.actions[:2, 0], [played, proposed[0]])


def test_pretrained_eyes_are_the_shipped_ones_and_stay_so(seeing):
    shipped = load_file(checkpoint_folder("pretrained", "align-thesis") / "model.safetensors")
    learnt = load_file(seeing / "model.safetensors")
    compared = 0
    for name, value in learnt.items():
        if ".eye." in name:
            camera, _, rest = name.removeprefix("features_extractor.branches.").partition(".0.eye.")
            assert torch.equal(value, shipped[f"network.eyes.{camera}.{rest}"]), name
            compared += 1
    assert compared > 40
    state, _ = state_of(seeing)
    trained = [name for name in state if name.startswith("actor/") and name.endswith("exp_avg")]
    # Two layers of each input, two behind them, mean and deviation: a weight and a bias each.
    assert len(trained) == 2 * (4 * 2 + 2 + 2)


def test_a_folder_with_pretrained_eyes_plays(seeing, named):
    env = named("align-thesis")
    observation = env.reset(scenario=0).observation
    policy = policy_factory(str(seeing), "align-thesis")(env)
    policy.reset()
    assert (np.abs(policy.select_action(observation)) <= 1.0).all()


def test_a_folder_with_shared_eyes_plays(sharing):
    with load("align-easy", **SMALL) as env:
        policy = policy_factory(str(sharing), "align-easy", SMALL)(env)
        policy.reset()
        action = policy.select_action(env.reset(scenario=0).observation)
    assert action.shape == (7,)


def test_joint_torques_are_an_input(sharing):
    inputs = json.loads((sharing / "config.json").read_text())["inputs"]
    assert inputs["joint_torques"]["high"] == [176, 176, 110, 110, 110, 40, 40]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--eyes", "pretrained", "--option", "eih_resolution=64"], "do not take eih"),
        (["--eyes", "shared", "--option", "observations=eih"], "need both pictures"),
        (["--eyes", "crossed"], "crossed"),
        (["--guide", "expret"], "did you mean expert"),
        (["--guide", "expert", "--guide-share", "0"], "guide_share must be above 0"),
        (["--guide", "expert", "--option", "action_mode=joint_delta"], "joint_position"),
    ],
)
def test_variants_that_make_no_sense_are_refused_in_one_line(tmp_path, words, reason, capsys):
    out = str(tmp_path / "out")
    assert run(["train-sac", "--task", "align-easy", "--out", out, "--steps", "1", *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert reason in err


def test_settings_and_checkpoint_have_to_agree_about_the_eyes(tmp_path):
    with pytest.raises(OptionError, match="whose eyes to use"):
        train_sac("align-easy", tmp_path / "out", steps=1, settings=Settings(eyes="pretrained"))
    with pytest.raises(OptionError, match="apart, shared or pretrained"):
        Settings(eyes="crossed")
