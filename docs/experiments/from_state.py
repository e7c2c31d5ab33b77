"""PPO, and SAC by itself, with hindsight or with a guide, from the true state: see from-state.md.

    python docs/experiments/from_state.py her --action-mode joint_velocity --steps 100000 \
        --out runs/her.json

The models are Stable-Baselines3's own, with its defaults where nothing else is said here.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

import hvs_suite
from hvs_suite.datasets.expert import make_expert
from hvs_suite.files import replacing
from hvs_suite.policies.rl.guide import Guide, Guided, PlayedActions
from hvs_suite.tasks.shared.spec import THESIS_REWARDS

METHODS = ("ppo", "sac", "her", "guided")
EVALUATIONS = 10
"""On the way; one more comes at the end."""


def make_env(task: str, method: str, split: str, action_mode: str) -> gymnasium.Env[Any, Any]:
    """The task from its true state: PPO is paid the thesis's rewards, the others for being there.

    Args:
        task: Named task.
        method: One of `METHODS`.
        split: Stream of scenes.
        action_mode: As the task's option.
    """
    version = hvs_suite.TASKS[task].version
    if method == "ppo":
        return gymnasium.make(
            f"hvs_suite/{task}-v{version}",
            split=split,
            observations="state",
            normalise_observation=True,
            rewards=THESIS_REWARDS,
            action_mode=action_mode,
        )
    return gymnasium.make(f"hvs_suite/{task}-goal-v{version}", split=split, action_mode=action_mode)


def make_model(env: gymnasium.Env[Any, Any], method: str, seed: int) -> BaseAlgorithm:
    """The learner: four of five goals are from later in the same episode, in hindsight.

    Args:
        env: As `make_env` makes it; the expert plays a fifth of its episodes if it is to guide.
        method: One of `METHODS`.
        seed: Of weights, exploration and batches.
    """
    if method == "ppo":
        return PPO("MultiInputPolicy", env, seed=seed, device="cpu")
    memory: dict[str, Any] = {}
    if method == "her":
        memory = {
            "replay_buffer_class": HerReplayBuffer,
            "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        }
    if method == "guided":
        env = Guided(env, Guide("expert", make_expert), seed)
        memory = {"replay_buffer_class": PlayedActions}
    return SAC(
        "MultiInputPolicy",
        env,
        gamma=0.95,
        learning_starts=1000,
        seed=seed,
        device="cpu",
        **memory,
    )


def evaluate(model: BaseAlgorithm, env: gymnasium.Env[Any, Any], episodes: int) -> dict[str, float]:
    """Play the first scenes of a split without exploration.

    Args:
        model: What was learnt.
        env: As `make_env` makes it.
        episodes: Scenes.

    Returns:
        Shares of successes and collisions, and median errors where episodes ended (mm, deg).
    """
    ends = []
    for scenario in range(episodes):
        seen, info = env.reset(options={"scenario": scenario})
        over = False
        while not over:
            action, _ = model.predict(seen, deterministic=True)
            seen, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        ends.append(info)
    errors = {
        name: float(np.median([end["errors"][name] for end in ends])) for name in ends[0]["errors"]
    }
    return {
        "success": float(np.mean([end["is_success"] for end in ends])),
        "collision": float(np.mean([end["collision"] for end in ends])),
        **errors,
    }


class Watch(BaseCallback):
    """Evaluates on the way, and keeps the figures as they come.

    Args:
        env: Of split ``validation``.
        every: Environment steps between two evaluations.
        out: JSON file; what is in it already comes first.
        result: What else is in the file.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], every: int, out: Path, result: dict[str, Any]
    ) -> None:
        super().__init__()
        self._env, self._every, self._out, self._result = env, every, out, result
        self._due, self._began = every, time.perf_counter()
        result["on_the_way"] = []

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._due:
            self._due += self._every
            row = evaluate(self.model, self._env, 20)
            minutes = (time.perf_counter() - self._began) / 60.0
            self._result["on_the_way"].append(
                {"steps": self.num_timesteps, "minutes": round(minutes, 2), **row}
            )
            write(self._out, self._result)
        return True


def write(out: Path, result: dict[str, Any]) -> None:
    """Write the figures as JSON."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as temporary:
        temporary.write_text(json.dumps(result, indent=2) + "\n")


def main() -> None:
    """Train, evaluate on the test split, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("--task", default="align-easy")
    parser.add_argument("--action-mode", default="joint_position")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=200, help="scenes of the test split")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    train, validation, test = (
        make_env(asked.task, asked.method, split, asked.action_mode)
        for split in ("train", "validation", "test")
    )
    model = make_model(train, asked.method, asked.seed)
    result: dict[str, Any] = {**vars(asked), "out": asked.out.name}
    watch = Watch(validation, max(1, asked.steps // EVALUATIONS), asked.out, result)
    model.learn(asked.steps, callback=watch)
    result["test"] = evaluate(model, test, asked.episodes)
    write(asked.out, result)
    print(json.dumps(result["test"], indent=2))


if __name__ == "__main__":
    main()
