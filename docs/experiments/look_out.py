"""Which posture shows a hidden target soonest: ``python docs/experiments/look_out.py TASK SCENES``.

Plays the demonstrator on the scenes of split ``dev`` whose target both cameras miss at the start,
once for each candidate posture, and prints the best ones.
"""

import itertools
import sys

import numpy as np

import hvs_suite
from hvs_suite.datasets import looking
from hvs_suite.datasets.expert import Expert

A1_DEG = (-150, -100, -70, -37, -10, 20, 60, 100)
A2_RAD = (0.5, 0.8)
A4_RAD = -0.6
A6_RAD = 0.6


def main(task: str, scenes: int) -> None:
    """Print failures, mean and greatest steps to the goal for the best postures."""
    with hvs_suite.load(task, split="dev", observations="state") as env:
        hidden = []
        for scenario in range(scenes):
            env.reset(scenario=scenario)
            truth = env.privileged()
            if max(truth["target_eih"][3], truth["target_eth"][3]) < 0.5:
                hidden.append(scenario)

        def steps(policy: Expert) -> np.ndarray:
            taken = []
            for scenario in hidden:
                time_step, count = env.reset(scenario=scenario), 0
                policy.reset()
                while not time_step.last():
                    time_step = env.step(policy.select_action({}))
                    count += 1
                taken.append(count if env.info["is_success"] else np.inf)
            return np.array(taken)

        print(f"{len(hidden)} of {scenes} hidden; expert's steps: {steps(Expert(env)).mean():.2f}")
        rows = []
        for a1, a2 in itertools.product(np.deg2rad(A1_DEG), A2_RAD):
            looking.LOOK_OUT_RAD = np.array([a1, a2, 0.0, A4_RAD, 0.0, A6_RAD, 0.0])
            taken = steps(looking.Demonstrator(env))
            solved = taken[np.isfinite(taken)]
            rows.append((int(np.isinf(taken).sum()), solved.mean(), solved.max(), a1, a2))
        for failures, mean, most, a1, a2 in sorted(rows)[:8]:
            print(
                f"A1 {np.rad2deg(a1):4.0f} deg, A2 {a2:.1f} rad: {failures} failed, "
                f"steps mean {mean:.2f}, max {most:.0f}"
            )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
