"""What each choice of the `hvs` policy contributes: trained without it, on the same scenarios.

Every policy has the same data, seed and number of optimiser steps as the whole one, but for the one
thing that its cell names.
"""

from pathlib import Path
from typing import Any

from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import TRIAL, Imitation
from hvs_suite.policies.imitation.settings import INPUTS, Settings
from hvs_suite.policies.training.dataset import read_manifest

WHOLE = "everything"
NO_DAGGER = "no DAgger"
LINEAR_SCALE = 0.5
"""A joint's step is seldom above this (rad), so errors weigh the same all over."""


def plan(
    data: Path,
    *,
    steps: int,
    dagger_rounds: int,
    dagger_frames: int,
    episodes: int,
    quick: bool = False,
) -> Plan:
    """The policy as it is, and without one thing at a time.

    Args:
        data: Recorded dataset, whose task is played.
        steps: Optimiser steps of every policy.
        dagger_rounds: Rounds of DAgger, where not left out.
        dagger_frames: Frames a round.
        episodes: Scenarios that each policy is judged on.
        quick: Make everything in minutes, of next to no training.

    Raises:
        DatasetError: The dataset cannot be read.
        OptionError: A number makes no sense.
    """
    manifest = read_manifest(data)
    alone: dict[str, Any] = {"dagger_rounds": 0}
    # A policy needs two episodes, one of them held out.
    few = {
        f"{NO_DAGGER}, 1/{k} of the data": manifest.n_episodes // k
        for k in (4, 16)
        if manifest.n_episodes >= 2 * k
    }
    left_out: dict[str, dict[str, Any]] = {
        WHOLE: {},
        "windows of one frame": {
            "window_steps": 1,
            "windows": Settings.windows * Settings.window_steps,
        },
        "linear joint steps": {"error_scale": LINEAR_SCALE},
        NO_DAGGER: alone,
        "no eye in hand": {"inputs": tuple(name for name in INPUTS if name != "eih")},
        "no eye to hand": {"inputs": tuple(name for name in INPUTS if name != "eth")},
        **{name: {**alone, "episodes": n} for name, n in few.items()},
    }
    budget = {"dagger_rounds": dagger_rounds, "dagger_frames": dagger_frames}
    if quick:
        steps, episodes = TRIAL.steps, 2
        budget = {"dagger_rounds": TRIAL.dagger_rounds, "dagger_frames": TRIAL.dagger_frames}
    cells = [
        Cell(
            group=manifest.task,
            name=name,
            way=Imitation(data=data.resolve(), steps=steps, settings={**budget, **settings}),
            on=[Scenes(task=manifest.task)],
            against=None if name == WHOLE else NO_DAGGER if name in few else WHOLE,
        )
        for name, settings in left_out.items()
    ]
    return Plan(
        name="ablation",
        question="What does each choice contribute? Policies that lack one thing each.",
        cells=cells,
        seeds=1,
        episodes=episodes,
    )
