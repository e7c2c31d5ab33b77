"""RL fine-tuning: begins as its base, resumes, leaves such a policy."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from test_hvs_policy import new_policy, observations, one

import hvs_suite
from hvs_suite.cli.main import run
from hvs_suite.errors import OptionError, PolicyError
from hvs_suite.policies.belief.acting import CompiledBelief, CompiledParts, act
from hvs_suite.policies.belief.network import FELT
from hvs_suite.policies.belief.residual import (
    MOST_STEPS,
    RESIDUAL_SIZE,
    SHIFT,
    Residual,
    goal_axes,
)
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy, load_network
from hvs_suite.policies.residual.folding import load_base, with_residual, write_folded
from hvs_suite.policies.residual.replay import Replay
from hvs_suite.policies.residual.settings import Settings
from hvs_suite.policies.residual.stage import PRIVILEGED, READ, MakeStage, Place
from hvs_suite.policies.residual.td3 import Learner, finetune
from hvs_suite.policies.rl.evaluation import Evaluation, fallen

pytestmark = pytest.mark.timeout(600)

TASK = "insert-feel"
OPTIONS = {"time_limit_steps": 3}
# What has learned nothing comes near no goal: it acts wherever it is.
SMALL = Settings(
    batch_size=4,
    replay_size=12,
    warm_up_steps=4,
    updates=1,
    hidden=16,
    environments=1,
    reach_m=10.0,
)
CALL = {
    "options": OPTIONS, "settings": SMALL, "eval_every": 1000, "eval_episodes": 1,
    "checkpoint_period_s": 0.0,
}  # fmt: skip
STEPS = 13


class Killed(BaseException):
    """What a kill looks like to the loop."""


@pytest.fixture(scope="module")
def moved(base, tmp_path_factory):
    """The same with a residual that has learned something."""
    network = with_residual(load_base(base), SMALL)
    torch.manual_seed(1)
    with torch.no_grad():
        network.residual.layers[-2].weight.normal_()
    folder = tmp_path_factory.mktemp("moved")
    write_folded(base, network.residual, network.shape, folder, hvs_suite.TASKS[TASK])
    return folder


def played(network, n=4):
    """Actions on some observations, step by step and compiled."""
    spec = hvs_suite.TASKS[TASK]
    compiled, fast, memory = CompiledBelief(network), None, network.start(1)
    actions = []
    for observation in observations(spec, n):
        batch = one(spec, observation)
        images = {name: batch[f"observation.images.{name}"] for name in ("eih", "eth")}
        felt = batch["observation.wrench"]
        with torch.no_grad():
            action, memory = act(network, images, batch["observation.state"], memory, None, felt)
            same, fast = compiled(images, batch["observation.state"], fast, None, felt)
        torch.testing.assert_close(same, action, atol=1e-5, rtol=0.0)
        actions.append(action)
    return torch.cat(actions), memory


def test_a_residual_leaves_the_actions_as_they_are_at_first(base):
    plain = load_base(base)
    before, _ = played(plain)
    after, _ = played(with_residual(plain, SMALL))
    torch.testing.assert_close(after, before, rtol=0.0, atol=0.0)


def test_a_residual_moves_the_goal_by_no_more_than_its_step_and_its_bound(base):
    network = with_residual(load_base(base), SMALL)
    with torch.no_grad():
        network.residual.layers[-2].bias.fill_(100.0)
    largest = np.array([SMALL.sideways_m, SMALL.sideways_m, SMALL.along_m])
    for n in (1, 2, 20):
        _, memory = played(network, n)
        shift = memory[0, FELT][SHIFT].norm().item()
        expected = np.linalg.norm(min(n, MOST_STEPS) * largest)
        assert shift == pytest.approx(expected, rel=0.2)
        assert shift <= expected + 1e-9


def test_far_from_the_goal_nothing_is_moved():
    residual = Residual(3, 8, (0.001, 0.001), 0.02, 0.1)
    nothing = torch.zeros(2, RESIDUAL_SIZE, dtype=torch.float64)
    memory = residual.remember(nothing, torch.zeros(2, 3), torch.zeros(2, 3), None)
    axes = torch.eye(3).double().expand(2, 3, 3)
    goal = torch.tensor([[0.0, 0.0, 0.019], [0.0, 0.0, 0.021]]).double()
    shift = residual.move(memory, torch.ones(2, 3), goal, axes)[:, SHIFT]
    torch.testing.assert_close(shift[0], torch.full((3,), 0.001).double())
    assert not shift[1].any()


def test_what_is_felt_is_remembered_for_four_steps():
    residual = Residual(0, 8, (0.001, 0.001), 0.02, 0.1)
    memory = torch.zeros(1, RESIDUAL_SIZE, dtype=torch.float64)
    axes = goal_axes(torch.eye(3)[None].double(), torch.tensor([[0.0, 0.0, 1.0]]).double())
    read = []
    for step in range(6):
        felt = torch.zeros(1, 6)
        felt[0, 2] = 30.0 * (step == 0)
        memory = residual.remember(memory, torch.zeros(1, 3), torch.zeros(1, 3), felt)
        inputs = residual.inputs(memory, torch.zeros(1, 0), torch.zeros(1, 3).double(), axes)
        assert inputs.shape == (1, residual.n_inputs)
        # All but the clock, which goes on.
        read.append(inputs[0, :-1].any().item())
    assert read == [True] * 4 + [False] * 2


def test_a_checkpoint_with_a_residual_is_played_alike_with_and_without_lerobot(moved, base):
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy

    spec = hvs_suite.TASKS[TASK]
    policy = HvsPolicy.from_pretrained(moved, local_files_only=True)
    alone, without = CheckpointPolicy(moved, spec), CheckpointPolicy(base, spec)
    differ = 0.0
    for player in (policy, alone, without):
        player.reset()
    for observation in observations(spec, 3):
        action = alone.select_action(observation)
        np.testing.assert_allclose(
            policy.select_action(one(spec, observation))[0].numpy(), action, atol=1e-5
        )
        differ = max(differ, float(abs(action - without.select_action(observation)).max()))
    assert differ > 1e-6


def test_the_parts_that_learning_plays_are_the_whole(moved):
    network = load_network(moved)
    parts, memory = CompiledParts(network), network.start(1)
    spec = hvs_suite.TASKS[TASK]
    whole, _ = played(network)
    for observation, expected in zip(observations(spec, 4), whole, strict=True):
        batch = one(spec, observation)
        images = {name: batch[f"observation.images.{name}"] for name in ("eih", "eth")}
        state, felt = batch["observation.state"], batch["observation.wrench"]
        with torch.no_grad():
            memory, sightings, read = parts.perceive(images, state, memory, None, felt)
            share = network.residual(read)
            action, memory = parts.respond(memory, sightings, state, share, felt)
        torch.testing.assert_close(action[0], expected, atol=1e-5, rtol=0.0)


def test_a_memory_forgets_the_oldest_and_goes_on_where_it_was():
    replay = Replay(3, {"x": 1})
    for k in range(5):
        replay.add({"x": np.array([[k]], np.float32)})
    again = Replay(3, {"x": 1})
    again.load(replay.state())
    for each in (replay, again):
        each.add({"x": np.array([[5]], np.float32)})
        assert set(each.sample(50, np.random.default_rng(0))["x"].flatten().tolist()) == {3, 4, 5}


def test_an_actor_learns_what_is_worth_more():
    torch.manual_seed(0)
    random = np.random.default_rng(0)
    residual = Residual(0, 16, (0.001, 0.001), 0.02, 0.1)
    learner = Learner(residual, 1, dataclasses.replace(SMALL, actor_rate=1e-2, critic_rate=1e-2))
    width = residual.n_inputs
    for k in range(60):
        action = torch.from_numpy(random.uniform(-1, 1, (64, 3))).float()
        seen = {READ: torch.zeros(64, width), PRIVILEGED: torch.zeros(64, 1)}
        batch = {**seen, **{f"next_{n}": value for n, value in seen.items()}, "action": action}
        batch |= {"reward": action[:, :1], "over": torch.ones(64, 1)}
        learner.update(batch, random, with_actor=k > 30)
    assert learner.actor(torch.zeros(1, width))[0, 0].item() > 0.2
    # What plays follows slowly.
    assert 0.0 < learner.average(torch.zeros(1, width))[0, 0].item() < 0.2


@pytest.fixture(scope="module")
def whole(base, tmp_path_factory):
    """A run that was left alone."""
    out = tmp_path_factory.mktemp("finetune") / "whole"
    reports = []
    outcome = finetune(base, TASK, out, steps=STEPS, on_progress=reports.append, **CALL)
    return out, outcome, reports


def state_of(out):
    """Tensors and counts of a run's state, without what a clock decides."""
    from safetensors import safe_open

    path = out / "training" / "state.safetensors"
    with safe_open(path, framework="pt") as file:
        counts = json.loads(file.metadata()["counts"])
    counts.pop("elapsed_s")
    return load_file(path), counts


def test_a_run_is_evaluated_before_it_learns_and_counts_what_it_did(whole, base):
    out, outcome, reports = whole
    assert outcome.env_steps == STEPS
    assert outcome.step == STEPS - SMALL.batch_size
    assert outcome.episodes == STEPS // OPTIONS["time_limit_steps"]
    assert {report.stage for report in reports} == {"evaluating", "training"}
    evaluations = json.loads((out / "training" / "evaluations.json").read_text())
    assert [row["env_steps"] for row in evaluations] == [0, STEPS]
    assert len(list((out / "training" / "tensorboard").iterdir())) == 1
    assert (out / "training" / "training.png").stat().st_size > 10_000
    assert json.loads((out / "config.json").read_text())["options"] == OPTIONS
    kinds = {p.suffix for p in out.rglob("*") if p.is_file() and "tfevents" not in p.name}
    assert kinds == {".json", ".safetensors", ".mp4", ".png"}
    # All but the residual is as it was.
    before, after = load_file(base / "model.safetensors"), load_file(out / "model.safetensors")
    assert all(torch.equal(after[name], value) for name, value in before.items())
    added = after.keys() - before.keys()
    assert added
    assert all(name.startswith("network.residual.") for name in added)


def test_a_killed_run_ends_like_one_that_was_left_alone(whole, base, tmp_path):
    out, _, _ = whole
    cut = tmp_path / "cut"

    def kill(progress):
        if (progress.stage, progress.env_steps) == ("training", 8):
            raise Killed

    # In the middle of an episode, in the middle of what is learned.
    with pytest.raises(Killed):
        finetune(base, TASK, cut, steps=STEPS, on_progress=kill, **CALL)
    finetune(base, TASK, cut, steps=STEPS, **CALL)
    (tensors, counts), (expected, expected_counts) = state_of(cut), state_of(out)
    assert counts == expected_counts
    for name, value in expected.items():
        torch.testing.assert_close(tensors[name], value, rtol=0.0, atol=0.0, msg=name)


def last_layer(folder):
    weights = load_file(folder / "model.safetensors")
    return [weights[f"network.residual.layers.4.{name}"] for name in ("weight", "bias")]


def test_critics_learn_alone_at_first(base, tmp_path):
    still = dataclasses.replace(SMALL, warm_up_steps=1000)
    finetune(base, TASK, tmp_path / "out", steps=9, **{**CALL, "settings": still})
    assert not any(value.any() for value in last_layer(tmp_path / "out"))
    tensors, _ = state_of(tmp_path / "out")
    names = [name for name in tensors if name.startswith("critics/")]
    assert any(
        not torch.equal(tensors[n], tensors[n.replace("critics/", "targets/")]) for n in names
    )


def test_players_share_the_scenes_and_go_back_to_the_middle_of_one(base):
    two = dataclasses.replace(SMALL, environments=2)
    scenes, action = [], np.full(3, 0.5, np.float32)
    for part in (0, 1):
        make = MakeStage(TASK, OPTIONS, "train", str(base), two, 0, part)
        stage = make()
        for _ in range(2):
            stage.reset()
            scenes.append(stage._env.scenario.index)
            over = False
            while not over:
                seen, _, over, _, info = stage.step(action)
        stage.close()
    assert scenes == [0, 2, 1, 3]
    # The same again, from the middle of the last of them.
    again = dataclasses.replace(
        make, place=Place(1, [action.tolist()] * 2, 5, 0, info["recent"][:-1])
    )()
    again.reset()
    same, _, over, _, counted = again.step(action)
    again.close()
    assert over
    assert counted == info
    np.testing.assert_array_equal(same[READ], seen[READ])
    np.testing.assert_array_equal(same[PRIVILEGED], seen[PRIVILEGED])


WIDE = {"position_tolerance_mm": 5000.0, "tilt_tolerance_deg": 180.0, "hold_steps": 2}


@pytest.mark.parametrize(("wide", "expected"), [({}, [-0.01, -0.01, -0.01]), (WIDE, [0.0, 1.0])])
def test_each_of_several_goals_is_an_episode_that_pays_if_it_is_reached(wide, expected, tmp_path):
    from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

    task, options = "sequence-thesis", {"n_targets": 2, "target_steps": 3, "time_limit_steps": 6}
    save_checkpoint(new_policy(task), tmp_path)
    settings = dataclasses.replace(SMALL, shaping=0.0)
    make = MakeStage(task, options | wide, "train", str(tmp_path), settings, 0)
    stage, scenes, length, earned = make(), [], len(expected), max(0.0, *expected)
    for _ in range(3):
        seen, _ = stage.reset()
        assert seen[PRIVILEGED].shape == (make.n_privileged,)
        over, rewards = False, []
        while not over:
            _, reward, over, _, info = stage.step(np.zeros(3, np.float32))
            rewards.append(reward)
        # A step inside the tolerances costs nothing.
        assert rewards == expected
        assert (info["length"], info["return"]) == (length, earned)
        assert info["success"] == bool(earned)
        scenes.append(info["episode"])
    # Two goals a scene; its end is counted with the second.
    assert scenes == [0, 1, 1]
    # Killed after the first goal of the second scene, it goes on with the second.
    again = dataclasses.replace(
        make, place=Place(1, info["actions"], info["played"], 0, info["recent"])
    )()
    _, counted = again.reset()
    assert counted["played"] == info["played"] == 3 * length
    assert again._env.control_steps == length
    again.close()
    stage.close()


def test_players_climb_a_curriculum_and_are_put_back_on_their_level(base):
    learnt = Place(recent=(True,) * 50)
    make = MakeStage(TASK, OPTIONS, "train", str(base), SMALL, 0, 0, learnt, "tolerance")
    stage, wanted = make(), hvs_suite.TASKS[TASK].depth_tolerance_mm
    assert stage._env.spec.depth_tolerance_mm == 8 * wanted
    _, info = stage.reset()
    assert stage._env.spec.depth_tolerance_mm == 4 * wanted
    assert (info["level"], info["recent"]) == (1, [])
    stage.close()
    again = dataclasses.replace(make, place=Place(level=3))()
    again.reset()
    assert again._env.spec.depth_tolerance_mm == wanted
    again.close()


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
    evaluations = [
        Evaluation(i, i, 100, 0.0, 1.0, 1.0, rate, 0.0, {}) for i, rate in enumerate(rates)
    ]
    assert fallen(evaluations) is expected


def pretend(monkeypatch, rates):
    """Let evaluations have these success rates, one after the other."""
    coming = iter(rates)

    def evaluate(self, policy, env_steps, updates, clip=None, on_episode=None):
        return Evaluation(env_steps, updates, 100, 0.0, 1.0, 1.0, next(coming), 0.0, {})

    monkeypatch.setattr("hvs_suite.policies.rl.evaluation.Evaluator.evaluate", evaluate)


def test_a_run_whose_success_falls_ends_and_keeps_what_it_had(base, tmp_path, monkeypatch):
    pretend(monkeypatch, [0.9, 0.1])
    call = {**CALL, "eval_every": 9}
    outcome = finetune(base, TASK, tmp_path / "out", steps=STEPS, **call)
    assert outcome.has_fallen
    assert outcome.env_steps == 9
    assert not any(value.any() for value in last_layer(tmp_path / "out"))
    # Given again, the same command does not go on where it was ended.
    again = finetune(base, TASK, tmp_path / "out", steps=STEPS, **call)
    assert again.env_steps == 9


@pytest.mark.parametrize(("success", "moves"), [(0.89, False), (0.9, True), (0.95, True)])
def test_what_plays_is_what_was_evaluated_best(base, tmp_path, monkeypatch, success, moves):
    pretend(monkeypatch, [0.9, success])
    finetune(base, TASK, tmp_path / "out", steps=STEPS, **CALL)
    assert any(value.any() for value in last_layer(tmp_path / "out")) is moves


@pytest.mark.parametrize(
    "setting",
    [{"noise": -0.1}, {"sideways_m": 0.0}, {"gamma": 1.5}, {"updates": 0},
     {"actor_rate": float("nan")}, {"reach_m": 11.0}],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(OptionError):
        Settings(**setting)


def test_what_cannot_be_fine_tuned_is_refused(moved, base, tmp_path, capsys):
    with pytest.raises(PolicyError, match="fine-tuned already"):
        finetune(moved, TASK, tmp_path / "twice", steps=6, settings=SMALL)
    with pytest.raises(OptionError, match="scoring"):
        finetune(base, TASK, tmp_path / "test", steps=6, split="test", **CALL)
    words = ["--policy", str(base), "--out", str(tmp_path / "cli")]
    assert run(["finetune", *words, "--task", "align-easy"]) == 2
    assert "the task is of align" in capsys.readouterr().err
    assert not (tmp_path / "cli").exists()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [({"residual_hidden": -1}, "residual_hidden"), ({"residual_hidden": 8}, "residual"),
     ({"residual_step_m": [0.0, 1.0]}, "residual_step")],
)  # fmt: skip
def test_a_strange_residual_is_refused(moved, tmp_path, change, complaint):
    shutil.copytree(moved, tmp_path / "strange")
    config = json.loads((moved / "config.json").read_text())
    (tmp_path / "strange" / "config.json").write_text(json.dumps({**config, **change}))
    with pytest.raises(PolicyError, match=complaint):
        CheckpointPolicy(tmp_path / "strange", hvs_suite.TASKS[TASK])
