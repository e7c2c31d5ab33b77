"""Policy search on the way: begins as its base, shifts nothing near the goal, resumes."""

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
from hvs_suite.policies.belief.acting import CompiledBelief, act
from hvs_suite.policies.belief.choice import MOST, Choice
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy, load_network
from hvs_suite.policies.residual.folding import load_base, with_choice, write_folded
from hvs_suite.policies.residual.search import search
from hvs_suite.policies.residual.way_settings import WaySettings

pytestmark = pytest.mark.timeout(600)

TASK = "track-curve"
WIDE = {"position_tolerance_mm": 5000.0, "tilt_tolerance_deg": 180.0}
SHORT = {"time_limit_steps": 8, "hold_steps": 8}
SMALL = WaySettings(population=4, scenes=2, patience_steps=6)
CALL = {"settings": SMALL, "eval_episodes": 1, "eval_every": 1000, "steps": 100}


@pytest.fixture(scope="module")
def chosen(base, tmp_path_factory):
    """The same with a choice that has learned something."""
    network = with_choice(load_base(base), 0.001)
    torch.manual_seed(1)
    with torch.no_grad():
        network.choice.weight.normal_()
    folder = tmp_path_factory.mktemp("chosen")
    write_folded(base, network.choice, network.shape, folder, hvs_suite.TASKS[TASK])
    return folder


def played(decide, network, n=3):
    """Actions on some observations."""
    spec, memory, actions = hvs_suite.TASKS[TASK], network.start(1), []
    for observation in observations(spec, n):
        batch = one(spec, observation)
        images = {name: batch[f"observation.images.{name}"] for name in ("eih", "eth")}
        with torch.no_grad():
            action, memory = decide(images, batch["observation.state"], memory)
        actions.append(action)
    return torch.cat(actions)


def acting(network):
    """Decides step by step."""
    return lambda *observed: act(network, *observed)


def test_it_leaves_the_actions_as_they_are_at_first_and_then_changes_them(base, chosen):
    plain, changed = load_base(base), load_network(chosen)
    before = played(acting(plain), plain)
    with_nothing = with_choice(plain, 0.001)
    after = played(acting(with_nothing), with_nothing)
    torch.testing.assert_close(after, before, rtol=0.0, atol=0.0)
    assert (played(acting(changed), changed) - before).abs().max() > 1e-6


def test_what_is_compiled_for_it_notices_a_new_choice(base):
    network = with_choice(load_base(base), 0.001)
    compiled = CompiledBelief(network, is_frozen=False)
    before = played(acting(network), network)
    torch.testing.assert_close(played(compiled, network), before, atol=1e-5, rtol=0.0)
    torch.manual_seed(1)
    with torch.no_grad():
        network.choice.weight.normal_()
    wanted = played(acting(network), network)
    assert (wanted - before).abs().max() > 1e-6
    torch.testing.assert_close(played(compiled, network), wanted, atol=1e-5, rtol=0.0)


def test_near_the_goal_nothing_is_shifted_and_far_from_it_more():
    choice = Choice(2, 0.01)
    with torch.no_grad():
        choice.weight.copy_(torch.tensor([[0.1, 2.0], [0.2, 0.0]]))
    shift = choice(torch.tensor([[0.009], [0.0101], [0.1], [1.0], [10.0]]))
    expected = [[0.0, 0.0], [0.1, 1.0], [0.2, 1.0], [0.3, 1.0], [0.3, 1.0]]
    torch.testing.assert_close(shift, MOST * torch.tensor(expected), atol=0.005, rtol=0.0)


def test_its_checkpoint_is_played_alike_with_and_without_lerobot(chosen):
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy

    spec = hvs_suite.TASKS[TASK]
    policy = HvsPolicy.from_pretrained(chosen, local_files_only=True)
    alone = CheckpointPolicy(chosen, spec)
    for player in (policy, alone):
        player.reset()
    for observation in observations(spec, 3):
        np.testing.assert_allclose(
            policy.select_action(one(spec, observation))[0].numpy(),
            alone.select_action(observation),
            atol=1e-5,
        )


@pytest.fixture(scope="module")
def whole(base, tmp_path_factory):
    """A run that was left alone, played by two processes."""
    out = tmp_path_factory.mktemp("way") / "whole"
    return out, search(base, TASK, out, options=SHORT, workers=2, **CALL)


def test_what_does_not_arrive_costs_all_its_patience_and_ends_there(whole, base):
    out, outcome = whole
    generations = json.loads((out / "training" / "generations.json").read_text())
    # Four candidates and two scenes, each six steps long; the last generation goes over.
    assert [each["env_steps"] for each in generations] == [48, 48, 48]
    assert outcome.env_steps == 144
    assert outcome.episodes == 24
    costs = np.array([each["costs"] for each in generations])
    # The rest is the penalty, which differs.
    assert ((costs > 6.0) & (costs < 7.0)).all()
    assert len(np.unique(costs)) == 12
    before, after = (load_file(path / "model.safetensors") for path in (base, out))
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert after.keys() - before.keys() == {"network.choice.weight"}


def test_what_arrives_costs_its_steps_outside_and_ends_when_it_has_settled(base, tmp_path):
    settings = dataclasses.replace(SMALL, penalty=0.0)
    search(base, TASK, tmp_path, options=SHORT | WIDE, **{**CALL, "settings": settings, "steps": 1})
    (generation,) = json.loads((tmp_path / "training" / "generations.json").read_text())
    assert generation["costs"] == [0.0] * 4
    assert generation["env_steps"] == 4 * 2 * 5


def test_where_goals_follow_each_other_a_scene_is_played_to_its_end(tmp_path):
    from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

    task, options = "sequence-thesis", {"n_targets": 2, "target_steps": 4, "time_limit_steps": 8}
    save_checkpoint(new_policy(task), tmp_path / "base")
    config = tmp_path / "base" / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"options": options}))
    call = {**CALL, "settings": dataclasses.replace(SMALL, penalty=0.0), "steps": 1}
    search(tmp_path / "base", task, tmp_path / "out", options=options, **call)
    (generation,) = json.loads((tmp_path / "out" / "training" / "generations.json").read_text())
    assert generation["costs"] == [8.0] * 4
    assert generation["env_steps"] == 4 * 2 * 8


class Killed(BaseException):
    """What a kill looks like to the loop."""


def test_a_killed_run_ends_like_one_that_was_left_alone_by_any_number_of_processes(
    whole, base, tmp_path
):
    out, _ = whole

    def kill(progress):
        if (progress.stage, progress.updates) == ("training", 2):
            raise Killed

    call = {**CALL, "options": SHORT}
    with pytest.raises(Killed):
        search(base, TASK, tmp_path, on_progress=kill, **call)
    search(base, TASK, tmp_path, **call)
    cut, expected = (
        [
            each["costs"]
            for each in json.loads((folder / "training" / "generations.json").read_text())
        ]
        for folder in (tmp_path, out)
    )
    assert cut == expected
    mine, wanted = (
        load_file(folder / "training" / "candidate" / "model.safetensors")["network.choice.weight"]
        for folder in (tmp_path, out)
    )
    torch.testing.assert_close(mine, wanted, rtol=0.0, atol=0.0)
    assert mine.any()


class Elsewhere:
    """A worker that has none of this machine's files."""

    def __init__(self, folder):
        self.folder = folder

    def size(self):
        return 1

    def spread(self, make, indices, *, ahead, on_note):
        hidden = self.folder.rename(self.folder.with_name("hidden"))
        try:
            with make(on_note) as call:
                yield from map(call, indices)
        finally:
            hidden.rename(self.folder)


def test_candidates_are_played_where_the_base_is_not(base, tmp_path):
    folder = tmp_path / "base"
    shutil.copytree(base, folder)
    call = {**CALL, "steps": 1, "options": SHORT}
    outcome = search(folder, TASK, tmp_path / "out", workers=Elsewhere(folder), **call)
    assert outcome.env_steps == 48


def test_it_is_shipped_like_any_other(whole, tmp_path):
    out, outcome = whole
    shipped = tmp_path / "shipped"
    assert run(["ship", str(out), "--to-folder", str(shipped)]) == 0
    text = (shipped / "README.md").read_text()
    assert f"{outcome.env_steps} environment steps" in text
    assert "CMA-ES" in text


@pytest.mark.parametrize(
    "setting",
    [{"population": 3}, {"scenes": 0}, {"patience_steps": 0}, {"spread": 0.0}, {"penalty": -1.0},
     {"reach_m": 1.0}],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(OptionError):
        WaySettings(**setting)


def test_the_command_makes_a_policy_and_draws_its_run(base, tmp_path, capsys):
    words = ["--policy", str(base), "--task", TASK, "--out", str(tmp_path), "--workers", "1"]
    small = ["--population", "4", "--scenes", "1", "--steps", "1", "--eval-episodes", "1"]
    short = ["--option", "time_limit_steps=3", "--option", "hold_steps=3"]
    assert run(["finetune-way", *words, *small, *short]) == 0
    assert "12 environment steps" in capsys.readouterr().out
    assert (tmp_path / "model.safetensors").exists()
    assert (tmp_path / "training" / "training.png").stat().st_size > 10_000


def test_what_cannot_be_fine_tuned_is_refused_in_a_line(chosen, base, tmp_path, capsys):
    with pytest.raises(PolicyError, match="fine-tuned already"):
        search(chosen, TASK, tmp_path / "twice", **CALL)
    words = ["finetune-way", "--policy", str(base), "--out", str(tmp_path / "out"), "--steps", "1"]
    assert run([*words, "--task", "align-easy"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
