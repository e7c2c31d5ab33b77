"""The thesis's fourteen runs of SAC from scratch, at a budget that one names.

The thesis says which values its runs had: six seeds, a replay memory of 10,000 or 50,000
transitions, 500 or up to 10,000 random episodes first, and one run at a tenth of the learning rate.
The recipes here are those values with the six seeds; which letter had which is not told here, so a
letter is the name of a recipe and no record of that very run. Random episodes are counted in steps,
of which they have 20, and take half of the budget at most, where there are many three quarters.

Budget: on one core an update takes 4 to 5 s and comes after every 20 environment steps, and 10,000
random steps take 3 minutes (docs/baselines.md). 20,000 steps, half of them random, take 45 minutes,
the fourteen runs 10 hours on one core, 5 on two. The thesis had up to 500,000 steps.
"""

from typing import Any

from hvs_suite.errors import OptionError
from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import Scratch
from hvs_suite.policies.sac.settings import Settings

TASK = "align-thesis"
SEEDS = (12, 123, 1234, 12345, 123456, 1234567)
STEPS = 20_000
MANY_RANDOM_STEPS = 200_000
RUNS: dict[str, tuple[int, dict[str, Any]]] = {
    **{letter: (seed, {}) for letter, seed in zip("ABCDEF", SEEDS, strict=True)},
    **{
        letter: (seed, {"replay_size": 50_000})
        for letter, seed in zip("GHIJKL", SEEDS, strict=True)
    },
    "M": (SEEDS[0], {"learning_rate": 3e-5}),
    "N": (SEEDS[0], {"random_steps": MANY_RANDOM_STEPS}),
}
"""Name to seed, and what differs from `hvs_suite.policies.sac.settings.Settings`."""


def plan(*, steps: int = STEPS, quick: bool = False) -> Plan:
    """The fourteen runs.

    Args:
        steps: Environment steps of each.
        quick: Make everything in minutes, of next to no training.

    Raises:
        OptionError: There are too few steps.
    """
    if steps < 1:
        raise OptionError(f"steps must be at least 1, not {steps}")
    steps = 60 if quick else steps
    cells = []
    for letter, (seed, changed) in RUNS.items():
        many = changed.get("random_steps")
        random = min(many, 3 * steps // 4) if many else min(Settings.random_steps, steps // 2)
        settings = {**changed, "random_steps": random}
        if quick:
            settings |= {"batch_size": 4}
        words = ", ".join(f"{name} {value:g}" for name, value in changed.items())
        cells.append(
            Cell(
                group=TASK,
                name=f"{letter}: seed {seed}{', ' if words else ''}{words.replace('_', ' ')}",
                way=Scratch(
                    task=TASK, steps=steps, settings=settings, eval_episodes=2 if quick else 20
                ),
                on=[Scenes(task=TASK)],
                seeds=(seed,),
            )
        )
    return Plan(
        name="thesis-runs",
        question="What do the thesis's fourteen runs of SAC from scratch reach here?",
        cells=cells,
        seeds=1,
        episodes=2 if quick else 200,
    )
