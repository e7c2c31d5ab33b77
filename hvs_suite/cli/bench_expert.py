"""What ``hvs bench --expert`` measures: the expert's steps against what the limits allow."""

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvs_suite.cli import console

if TYPE_CHECKING:
    from hvs_suite.rollout import Policy
    from hvs_suite.tasks.shared.spec import Spec

SPLIT = "test"
SETTLING_STEPS = 1

LABELS = {
    "episodes": "test scenarios played",
    "successes": "solved",
    "collisions": "collisions",
    "mean_steps": "mean steps to the goal",
    "bound_steps": "mean lower bound under speed and acceleration limits (steps)",
    "bound_s": "the same before rounding up to steps (s)",
    "speed_bound_steps": "mean lower bound under speed limits alone (steps)",
    "speed_bound_s": "the same before rounding up to steps (s)",
    "ratio": "steps over (bound + 1 step to settle)",
    "speed_ratio": "steps over (speed-only bound + 1 step to settle)",
    "decision_us_mean": "CPU time of a decision, mean (us)",
    "decision_us_p50": "the same, median (us)",
    "decision_us_p99": "the same, 99th percentile (us)",
}


def expert_figures(task: str, options: Mapping[str, Any], episodes: int) -> dict[str, float]:
    """Plays test scenarios with the expert, without cameras.

    Args:
        task: A named task.
        options: Options of it.
        episodes: Test scenarios to play, from 0 on.

    Returns:
        Figures by the names of ``LABELS``; steps are means over solved episodes.
    """
    import hvs_suite
    from hvs_suite.datasets.expert import make_expert
    from hvs_suite.rollout import run_episode

    steps: list[int] = []
    bounds: list[tuple[float, float, int, int]] = []
    collisions = 0
    with (
        hvs_suite.load(task, split=SPLIT, **{**options, "observations": "state"}) as env,
        console.progress(f"expert on {task}", episodes) as advance,
    ):
        expert = Timed(make_expert(env))
        for scenario in range(episodes):
            episode = run_episode(env, expert, scenario)
            truth = env.privileged()
            collisions += episode.collision
            if episode.success:
                steps.append(episode.steps)
                bounds.append(
                    least_times(
                        env.spec,
                        env.scenario.start,
                        truth["goal_position"],
                        truth["goal_normal"],
                    )
                )
            advance()
    mean_steps = float(np.mean(steps)) if steps else math.nan
    seconds, speed_seconds, bound, speed_bound = (
        np.mean(bounds, axis=0).tolist() if bounds else [math.nan] * 4
    )
    micros = np.array(expert.decisions_s) * 1e6
    return {
        "episodes": episodes,
        "successes": len(steps),
        "collisions": collisions,
        "mean_steps": mean_steps,
        "bound_steps": bound,
        "bound_s": seconds,
        "speed_bound_steps": speed_bound,
        "speed_bound_s": speed_seconds,
        "ratio": mean_steps / (bound + SETTLING_STEPS),
        "speed_ratio": mean_steps / (speed_bound + SETTLING_STEPS),
        "decision_us_mean": float(micros.mean()),
        "decision_us_p50": float(np.percentile(micros, 50)),
        "decision_us_p99": float(np.percentile(micros, 99)),
    }


def least_times(
    spec: "Spec",
    start: npt.NDArray[np.float64],
    goal: npt.NDArray[np.float64],
    normal: npt.NDArray[np.float64],
) -> tuple[float, float, int, int]:
    """Least time to any reachable configuration of the goal, from rest to rest.

    Args:
        spec: Whose period, hold and latency count.
        start: Joint angles (7,) in rad.
        goal: Flange position at the goal (3,) in m.
        normal: Outward surface normal (3,).

    Returns:
        Under speed and acceleration limits (s), under speed limits alone (s), and both in control
        steps to success.
    """
    from hvs_suite.cell.kinematics import kinematics, travel_time

    reachable = kinematics().goal_configurations_at_tool_angle(goal, normal, float(start[6]))
    limited, quick = (
        float(travel_time(start, reachable, acceleration_limits=limits).min())
        for limits in (True, False)
    )
    further = spec.hold_steps - 1 + spec.latency_steps

    def steps(seconds: float) -> int:
        return max(1, math.ceil(seconds / spec.control_period_s - 1e-9)) + further

    return limited, quick, steps(limited), steps(quick)


class Timed:
    """A policy whose decisions are timed.

    Attributes:
        decisions_s: CPU time of each decision (s), which others on the machine do not lengthen.
    """

    def __init__(self, policy: "Policy") -> None:
        self.decisions_s: list[float] = []
        self._policy = policy

    def reset(self) -> None:
        """As the policy."""
        self._policy.reset()

    def select_action(self, observation: Any) -> npt.NDArray[np.float32]:
        """As the policy."""
        started = time.thread_time()
        action = self._policy.select_action(observation)
        self.decisions_s.append(time.thread_time() - started)
        return action
