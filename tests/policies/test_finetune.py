"""RL fine-tuning: begins as its base, learns from what it sees, resumes, leaves an `hvs` policy."""

import dataclasses
import json
import math

import gymnasium
import miniature
import numpy as np
import pytest
import torch
from rl_state import state_of
from safetensors.torch import load_file

import hvs_suite
from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S, set_point_after
from hvs_suite.cli.finetune import Finetune
from hvs_suite.cli.main import run
from hvs_suite.datasets.expert import Expert
from hvs_suite.errors import OptionError, PolicyError
from hvs_suite.gym import TaskEnv
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy
from hvs_suite.policies.finetune.folding import load_base, with_residual, write_folded
from hvs_suite.policies.finetune.outlook import Outlook
from hvs_suite.policies.finetune.residual_td3 import WARM_UP_UPDATES, ResidualPolicy
from hvs_suite.policies.finetune.settings import Settings
from hvs_suite.policies.finetune.stage import (
    FEATURES,
    PRIVILEGED,
    PRIVILEGED_SIZE,
    ResidualStage,
)
from hvs_suite.policies.finetune.training import finetune
from hvs_suite.policies.imitation.pretrain import pretrain
from hvs_suite.policies.network.network import CONTROL_PERIOD_S, SET_POINT
from hvs_suite.policies.residual.settings import Settings as ResidualSettings
from hvs_suite.policies.rl.evaluation import Evaluation, fallen
from hvs_suite.policies.rl.journal import Journal
from hvs_suite.rollout import run_episode

pytestmark = pytest.mark.timeout(600)

SIDE = 28
OPTIONS = {"eih_resolution": SIDE, "eth_resolution": SIDE, "time_limit_steps": 5}
SMALL = Settings(
    batch_size=8, replay_size=24, warm_up_steps=12, collect_steps=6, updates=2, hidden=16,
    eye_rounds=1, eye_frames=12, eye_steps=2, environments=1, lost_share=0.5,
)  # fmt: skip
CALL = {
    "options": OPTIONS, "settings": SMALL, "eval_every": 1000, "eval_episodes": 2,
    "checkpoint_period_s": 0.0,
}  # fmt: skip
STEPS = 42


class LoseThose(gymnasium.Env):
    """Episodes of a single step, of which some scenes' are lost."""

    def __init__(self, lost):
        self.lost, self.played = lost, []

    def reset(self, *, seed=None, options=None):
        self.played.append(options["scenario"])
        return 0, {}

    def step(self, action):
        return 0, 0.0, True, False, {"is_success": self.played[-1] not in self.lost}


class Killed(BaseException):
    """What a kill looks like to the loop."""


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A policy that has hardly learned anything, for tiny images."""
    root = tmp_path_factory.mktemp("data") / "tiny"
    columns = miniature.scene(40, side=SIDE)
    miniature.write_dataset(root, columns, miniature.episodes(40), options=OPTIONS)
    out = tmp_path_factory.mktemp("base") / "policy"
    pretrain(root, out, steps=2, batch_size=4)
    return out


@pytest.fixture(scope="module")
def whole(base, tmp_path_factory):
    """A run that was left alone."""
    out = tmp_path_factory.mktemp("finetune") / "whole"
    reports = []
    outcome = finetune(base, "align-easy", out, steps=STEPS, on_progress=reports.append, **CALL)
    return out, outcome, reports


@pytest.fixture
def stage(base):
    """The environment of fine-tuning, on scenes of its own."""
    env = TaskEnv("align-easy", split="train", **OPTIONS)
    with_base = ResidualStage(env, base, bound=0.6, shaping=0.1, gamma=0.9)
    yield with_base
    with_base.close()


def played(folder, options=OPTIONS):
    """Actions of the first scene of `dev`."""
    with hvs_suite.load("align-easy", split="dev", **options) as env:
        return run_episode(env, CheckpointPolicy(folder, env.spec), 0).actions


def sent(folder):
    """Where those actions send the arm, step by step; one that asks for more gets no more."""
    set_point, way = np.zeros(7), []
    for action in played(folder):
        set_point = set_point_after(set_point, action * JOINT_RANGE_RAD, CONTROL_PERIOD_S)
        way.append(set_point)
    return np.array(way)


def test_a_residual_adds_nothing_at_first_and_no_more_than_its_bound_ever(base, tmp_path):
    plain = load_base(base)
    network = with_residual(plain, hidden=16, bound=0.6)
    write_folded(base, network, tmp_path / "folded", hvs_suite.TASKS["align-easy"])
    np.testing.assert_allclose(sent(tmp_path / "folded"), sent(base), atol=1e-6)
    with torch.no_grad():
        network.residual[-2].bias.fill_(100.0)
    images = {name: torch.rand(3, 3, SIDE, SIDE) for name in ("eih", "eth")}
    state = torch.rand(3, 14)
    with torch.no_grad():
        added = network(images, state).out - plain(images, state).features[:, -7:]
    torch.testing.assert_close(added, torch.full_like(added, 0.6))


def test_a_residual_holds_an_arm_back_that_the_base_wants_to_go_faster_than_joints_can(base):
    network = with_residual(load_base(base), hidden=16, bound=0.6)
    images = {name: torch.rand(1, 3, SIDE, SIDE) for name in ("eih", "eth")}
    state = torch.zeros(1, 14)
    ways = {}
    with torch.no_grad():
        network.head[-1].bias.fill_(30.0)
        for shares in (0.0, -100.0):
            network.residual[-2].bias.fill_(shares)
            decision = network(images, state)
            action = network.to_action(decision.out, network.origin(state, decision.memory))
            ways[shares] = network.commanded(decision.memory, action)[0, SET_POINT]
    longest = torch.as_tensor(JOINT_SPEED_RAD_S, dtype=torch.float32) * CONTROL_PERIOD_S
    torch.testing.assert_close(ways[0.0], longest)
    torch.testing.assert_close(ways[-100.0], longest * math.exp(-0.6), rtol=0.05, atol=0.0)


def test_the_action_zero_plays_the_base(base):
    own = TaskEnv("align-easy", split="dev", **OPTIONS)
    dev = ResidualStage(own, base, bound=0.6, shaping=0.0, gamma=0.9)
    dev.reset(options={"scenario": 0})
    with hvs_suite.load("align-easy", split="dev", **OPTIONS) as env:
        env.reset(scenario=0)
        for action in played(base):
            env.step(action)
            dev.step(np.zeros(7, np.float32))
            np.testing.assert_allclose(own.environment.setpoint, env.setpoint, atol=1e-5)
    dev.close()


def test_shaping_changes_no_return_but_by_where_it_began(stage):
    """Discounted, a potential that is 0 at the end adds up to minus its beginning."""
    _, info = stage.reset(options={"scenario": 5})
    bounds = stage.unwrapped.environment.spec.tolerances
    first = 0.1 * sum(np.arcsinh(info["errors"][name] / bound) for name, bound in bounds.items())
    total, discount, over = 0.0, 1.0, False
    while not over:
        _, reward, terminated, truncated, info = stage.step(np.zeros(7, np.float32))
        over = terminated or truncated
        total += discount * reward
        discount *= 0.9
    own = {"is_success": 1.0, "collision": -1.0}
    task = sum(worth for name, worth in own.items() if info[name])
    assert total == pytest.approx(first + discount / 0.9 * task, abs=1e-6)


def test_the_actor_knows_nothing_privileged(stage, base):
    policy = ResidualPolicy(
        stage.observation_space,
        stage.action_space,
        lambda _: 1e-3,
        net_arch=[16],
        n_critics=2,
        outlook=Outlook(load_base(base), 0.6),
    )
    with torch.no_grad():
        policy.actor.mu[-2].weight.normal_()
        one = {FEATURES: torch.rand(4, stage.observation_space[FEATURES].shape[0])}
        action = torch.rand(4, 7)
        answers, values = [], []
        for _ in range(2):
            seen = one | {PRIVILEGED: torch.rand(4, PRIVILEGED_SIZE)}
            answers.append(policy.actor(seen))
            values.append(torch.cat(policy.critic(seen, action), dim=1))
    assert answers[0].abs().max() > 0
    torch.testing.assert_close(answers[0], answers[1], rtol=0.0, atol=0.0)
    assert (values[0] - values[1]).abs().max() > 1e-4
    assert values[0].shape == (4, 2)


@pytest.mark.parametrize(
    ("latency", "from_set_point"), [(0, False), (1, False), (2, False), (1, True), (2, True)]
)
def test_critics_see_where_a_command_leads(base, latency, from_set_point):
    options = {**OPTIONS, "latency_steps": latency, "time_limit_steps": 9}
    own = TaskEnv("align-easy", split="dev", **options)
    dev = ResidualStage(own, base, bound=0.6, shaping=0.0, gamma=0.9)
    network = load_base(base)
    network.shape = dataclasses.replace(network.shape, from_set_point=from_set_point)
    dev._network.shape = network.shape
    seen, _ = dev.reset(options={"scenario": 0})
    ahead = Outlook(network, 0.6)
    foreseen, came = [], []
    for _ in range(4 + latency):
        action = np.zeros(7, np.float32)
        action[1] = 0.3
        # The base has hardly learned anything; one that turns A2 fast says a quarter of a radian.
        said = torch.zeros(1, 7)
        said[0, 1] = 3.0
        dev._out = said
        seen[FEATURES][-7:] = said[0].numpy()
        batch = [
            torch.from_numpy(each)[None] for each in (seen[FEATURES], seen[PRIVILEGED], action)
        ]
        foreseen.append(ahead(*batch)[0, :6])
        seen, *_ = dev.step(action)
        # The way and the turn that are left, as the next state has them.
        came.append(torch.from_numpy(seen[PRIVILEGED][14:20]))
    dev.close()
    scale = load_base(base).shape.error_scale
    led, went = (torch.sinh(torch.stack(each)) * scale for each in (foreseen, came))
    # What is foreseen comes as many steps later as there is latency.
    led, went = led[: len(led) - latency], went[latency:]
    # A critic that predicts the set point alone is wrong by a third of the way.
    astray, way = (led - went)[1:].norm(dim=1), went.diff(dim=0).norm(dim=1)
    assert way.mean() > 0.1
    assert astray.mean() < 0.03 * way.mean()


def test_a_run_asks_no_expert_and_trains_the_eyes_alone_before_the_residual(
    base, tmp_path, monkeypatch
):
    def never(self):
        raise AssertionError("the expert was asked")

    monkeypatch.setattr(Expert, "label", never)
    finetune(base, "align-easy", tmp_path / "out", steps=24, **CALL)
    before, after = (
        load_file(base / "model.safetensors"),
        load_file(tmp_path / "out" / "model.safetensors"),
    )
    changed = {name for name, value in before.items() if not torch.equal(value, after[name])}
    assert changed
    assert all(name.startswith("network.eyes.") for name in changed)
    added = set(after) - set(before)
    assert added
    assert all(name.startswith("network.residual.") for name in added)


def test_critics_warm_up_before_the_actor_moves(base, tmp_path):
    still = dataclasses.replace(SMALL, warm_up_steps=1000)
    finetune(base, "align-easy", tmp_path / "out", steps=24, **{**CALL, "settings": still})
    weights = load_file(tmp_path / "out" / "model.safetensors")
    last = [value for name, value in weights.items() if name.startswith("network.residual.6.")]
    assert len(last) == 2
    assert all(not value.any() for value in last)


def test_a_run_is_evaluated_before_it_learns_and_counts_what_it_did(whole):
    out, outcome, reports = whole
    assert outcome.env_steps == STEPS
    # The first two iterations are the warm-up.
    assert outcome.step == 2 * (2 * WARM_UP_UPDATES + STEPS // 6 - 2)
    stages = [report.stage for report in reports]
    order = ("evaluating", "looking", "training eyes", "training")
    assert sorted(order, key=stages.index) == list(order)
    evaluations = json.loads((out / "training" / "evaluations.json").read_text())
    assert [row["env_steps"] for row in evaluations] == [0, STEPS]
    clips = sorted(path.name for path in (out / "training" / "clips").iterdir())
    assert clips == ["0000000000.mp4", f"{STEPS:010d}.mp4"]
    kinds = {p.suffix for p in out.rglob("*") if p.is_file() and "tfevents" not in p.name}
    assert kinds == {".json", ".safetensors", ".npz", ".npy", ".mp4", ".png"}


def test_a_killed_run_ends_like_one_that_was_left_alone(whole, base, tmp_path):
    out, _, _ = whole
    cut = tmp_path / "cut"

    def kill(progress):
        if (progress.stage, progress.env_steps) == ("training", kill.at):
            raise Killed
        if kill.at < 0 and progress.stage == "training eyes":
            raise Killed

    # While the eyes are trained, in the middle of an episode, and when the memory forgets.
    for kill.at in (-1, 18, 30):
        with pytest.raises(Killed):
            finetune(base, "align-easy", cut, steps=STEPS, on_progress=kill, **CALL)
    finetune(base, "align-easy", cut, steps=STEPS, **CALL)
    (tensors, header), (expected, expected_header) = state_of(cut), state_of(out)
    assert header == expected_header
    for name, value in expected.items():
        torch.testing.assert_close(tensors[name], value, rtol=0.0, atol=0.0, msg=name)
    left, right = load_file(cut / "model.safetensors"), load_file(out / "model.safetensors")
    assert all(torch.equal(left[name], value) for name, value in right.items())


def test_two_environments_share_the_scenes(base, tmp_path):
    two = dataclasses.replace(SMALL, environments=2, eye_rounds=0)
    outcome = finetune(base, "align-easy", tmp_path / "two", steps=24, **{**CALL, "settings": two})
    assert outcome.env_steps == 24
    _, header = state_of(tmp_path / "two")
    assert len(header["places"]) == 2


def test_scenes_that_were_lost_come_again_in_turn_between_new_ones():
    journal = Journal(LoseThose({2, 3}), seed=0, lost_share=0.5)
    for _ in range(9):
        journal.reset()
        journal.step(np.zeros(7, np.float32))
    played = journal.unwrapped.played
    assert played == [0, 1, 2, 2, 3, 3, 4, 2, 5]
    restored = Journal(LoseThose({2, 3}), seed=0, lost_share=0.5)
    restored.load_state_dict(journal.state_dict())
    for each in (journal, restored):
        each.reset()
    assert restored.unwrapped.played == journal.unwrapped.played[9:]


def test_lerobot_plays_what_comes_of_it(whole):
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy

    out, _, _ = whole
    policy = HvsPolicy.from_pretrained(out, local_files_only=True)
    assert policy.config.residual_hidden == SMALL.hidden
    with hvs_suite.load("align-easy", split="dev", **OPTIONS) as env:
        seen = env.reset(scenario=0).observation
    batch = {
        f"observation.images.{name}": torch.from_numpy(seen[name]).permute(2, 0, 1)[None] / 255.0
        for name in ("eih", "eth")
    }
    joints = np.concatenate([seen["joint_positions"], seen["joint_velocities"]])
    batch["observation.state"] = torch.from_numpy(joints.astype(np.float32))[None]
    np.testing.assert_allclose(policy.select_action(batch)[0].numpy(), played(out)[0], atol=1e-5)


def test_a_fine_tuned_policy_is_shipped_like_any_other(whole, tmp_path):
    out, outcome, _ = whole
    shipped = tmp_path / "shipped"
    assert run(["ship", str(out), "--to-folder", str(shipped)]) == 0
    text = (shipped / "README.md").read_text()
    assert f"{outcome.env_steps} environment steps" in text
    assert "no expert" in text
    assert (shipped / "training" / "training.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("rates", "expected"),
    [([], False), ([0.9], False), ([0.9, 0.85], False), ([0.9, 0.6], True), ([0.5, 0.9], False),
     ([0.9, 0.6, 0.88], False)],
)  # fmt: skip
def test_success_has_fallen_where_chance_does_not_explain_it(rates, expected):
    evaluations = [Evaluation(i, i, 100, 0.0, 1.0, rate, 0.0, {}) for i, rate in enumerate(rates)]
    assert fallen(evaluations) is expected


def pretend(monkeypatch, rates):
    """Let evaluations have these success rates, one after the other."""
    coming = iter(rates)

    def evaluate(self, policy, env_steps, updates, clip=None, on_episode=None):
        return Evaluation(env_steps, updates, 100, 0.0, 1.0, next(coming), 0.0, {})

    monkeypatch.setattr("hvs_suite.policies.rl.evaluation.Evaluator.evaluate", evaluate)


@pytest.mark.parametrize(("success", "keeps"), [(0.8, False), (0.9, True)])
def test_eyes_with_which_fewer_scenes_are_solved_are_not_kept(
    base, tmp_path, monkeypatch, success, keeps
):
    pretend(monkeypatch, [0.9, success, 0.9, 0.9])
    finetune(base, "align-easy", tmp_path / "out", steps=6, **CALL)
    before, after = (load_file(each / "model.safetensors") for each in (base, tmp_path / "out"))
    changed = [name for name, value in before.items() if not torch.equal(value, after[name])]
    assert bool(changed) is keeps


def test_a_run_whose_success_falls_ends_and_keeps_what_it_had(base, tmp_path, monkeypatch):
    # The base, with new eyes, where RL begins, and where it has led.
    pretend(monkeypatch, [0.9, 0.9, 0.9, 0.1])
    call = {**CALL, "eval_every": 18}
    outcome = finetune(base, "align-easy", tmp_path / "out", steps=STEPS, **call)
    assert outcome.has_fallen
    assert outcome.env_steps == 18
    weights = load_file(tmp_path / "out" / "model.safetensors")
    assert not weights["network.residual.6.weight"].any()
    # Given again, the same command does not go on where it was ended.
    again = finetune(base, "align-easy", tmp_path / "out", steps=STEPS, **call)
    assert again.env_steps == 18


@pytest.mark.parametrize(("success", "moves"), [(0.89, False), (0.9, True), (0.95, True)])
def test_what_plays_is_what_was_evaluated_best(base, tmp_path, monkeypatch, success, moves):
    # Without eyes: where RL begins, and where it has led.
    pretend(monkeypatch, [0.9, success])
    settings = dataclasses.replace(SMALL, eye_rounds=0, warm_up_steps=6)
    finetune(base, "align-easy", tmp_path / "out", steps=18, **{**CALL, "settings": settings})
    weights = load_file(tmp_path / "out" / "model.safetensors")
    assert weights["network.residual.6.weight"].any().item() is moves


@pytest.mark.parametrize(
    "setting",
    [{"critics": 1}, {"noise": -0.1}, {"bound": 0.0}, {"gamma": 1.5}, {"collect_steps": 7},
     {"eye_frames": 0}, {"actor_rate": float("nan")}, {"lost_share": 1.0}],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(OptionError):
        Settings(**setting)


def test_the_command_leaves_to_the_method_what_is_not_given():
    command = {field.name: field.default for field in dataclasses.fields(Finetune)}
    for method in (Settings, ResidualSettings):
        shared = command.keys() & {field.name for field in dataclasses.fields(method)}
        assert "warm_up_steps" in shared
        assert {command[name] for name in shared} == {None}


def test_what_cannot_be_fine_tuned_is_refused(whole, base, tmp_path, capsys):
    out, _, _ = whole
    with pytest.raises(PolicyError, match="fine-tuned already"):
        finetune(out, "align-easy", tmp_path / "twice", steps=6, **CALL)
    with pytest.raises(OptionError, match="scoring"):
        finetune(base, "align-easy", tmp_path / "test", steps=6, split="test", **CALL)
    # The tiny images are not the named task's.
    words = ["--policy", str(base), "--task", "align-easy", "--out", str(tmp_path / "cli")]
    assert run(["finetune", *words]) == 2
    assert "does not fit align-easy" in capsys.readouterr().err
    assert not (tmp_path / "cli").exists()


def test_the_options_of_the_run_are_in_checkpoint_and_notes(whole):
    out, _, _ = whole
    assert json.loads((out / "config.json").read_text())["options"] == OPTIONS
    assert json.loads((out / "train_config.json").read_text())["settings"]["options"] == OPTIONS
