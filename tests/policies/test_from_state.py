"""docs/experiments/from_state.py: PPO and hindsight replay learn from the true state, scored."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "docs" / "experiments" / "from_state.py"
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("from_state", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_ppo_learns_from_the_state_and_is_scored(script, tmp_path, monkeypatch):
    out = tmp_path / "runs" / "ppo.json"
    words = ["ppo", "--steps", "2048", "--episodes", "2", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["from_state.py", *words])
    monkeypatch.setattr(script, "EVALUATIONS", 1)
    script.main()
    result = json.loads(out.read_text())
    assert (result["method"], result["task"], result["out"]) == ("ppo", "align-easy", "ppo.json")
    assert [row["steps"] for row in result["on_the_way"]] == [2048]
    for row in (result["test"], *result["on_the_way"]):
        assert 0.0 <= row["success"] <= 1.0
        assert row["position_error_mm"] > 0.0


def test_hindsight_finds_goals_where_chance_finds_none(script):
    env = script.make_env("align-easy", "her", "train", "joint_velocity")
    model = script.make_model(env, "her", seed=0)
    model.learning_starts = 40
    model.learn(60)
    assert model._n_updates == 20
    assert model.replay_buffer.rewards[:60].sum() == 0.0
    assert float(model.replay_buffer.sample(256).rewards.sum()) > 0.0


def test_without_hindsight_the_same_learner_has_the_goals_of_the_scenes_alone(script):
    env = script.make_env("align-easy", "sac", "train", "joint_velocity")
    model = script.make_model(env, "sac", seed=0)
    model.learn(30)
    assert float(model.replay_buffer.sample(256).rewards.sum()) == 0.0
    assert script.evaluate(model, env, 1)["success"] == 0.0


def test_a_guide_finds_the_goals_of_the_scenes(script):
    env = script.make_env("align-easy", "guided", "train", "joint_position")
    model = script.make_model(env, "guided", seed=1)
    model.learn(500)
    assert model.replay_buffer.rewards[:500].sum() >= 1.0
