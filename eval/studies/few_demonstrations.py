"""Where RL should matter most: a policy that learned from a few demonstrations, made better.

For every number of demonstrations a base is trained by cloning alone. From there on several ways
have the same number of environment steps: RL fine-tuning, which asks no expert, and DAgger, in
which a teacher labels every one of those steps. RL from scratch has them without a base.
"""

from collections.abc import Sequence

from hvs_suite.errors import OptionError
from hvs_suite.eval.studies.grid import Cell, Plan
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import (
    EVERYWHERE_M,
    NOISE_RAD,
    Finetuning,
    Imitation,
    Recording,
    Scratch,
    Way,
)
from hvs_suite.policies.imitation.dagger import TeacherName
from hvs_suite.policies.rl.curriculum import Kind
from hvs_suite.registry import find

BASE, FINETUNED, SCRATCH = "base", "RL fine-tuning", "RL from scratch"
EVALUATIONS = 5
"""How often RL is evaluated on its way, each time on so many scenes at most:"""
EVAL_EPISODES = 100


def plan(
    task: str,
    *,
    demonstrations: Sequence[int],
    teachers: Sequence[TeacherName],
    env_steps: int,
    base_steps: int,
    imitation_steps: int,
    imitation_rounds: int,
    episodes: int,
    noise: float = NOISE_RAD,
    reach_m: float = EVERYWHERE_M,
    curriculum: Kind | None = None,
    eyes: str | None = None,
    quick: bool = False,
) -> Plan:
    """Bases, what comes of each, and RL without one.

    Args:
        task: Named task.
        demonstrations: How many to learn from, the first ones of one recording.
        teachers: Who label the steps of DAgger, a cell each.
        env_steps: Environment steps of each way.
        base_steps: Optimiser steps of each base.
        imitation_steps: Optimiser steps of DAgger, its base's included.
        imitation_rounds: Rounds that its environment steps are spread over.
        episodes: Scenes that each policy is judged on.
        noise: Of the recording, see `Recording`.
        reach_m: How far from the goal fine-tuning moves it (m).
        curriculum: Easier levels that fine-tuning begins on; None for none.
        eyes: Named task of whose shipped weights all eyes begin with; None for fresh ones.
        quick: Make everything in minutes, of next to no training.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: A number makes no sense.
    """
    find(task)
    if quick:
        demonstrations, env_steps, episodes = (3,), 40, 2
        base_steps, imitation_steps, imitation_rounds = 2, 6, 2
    for name, number in (
        ("base_steps", base_steps),
        ("imitation_steps", imitation_steps),
        ("imitation_rounds", imitation_rounds),
        ("env_steps", env_steps // max(1, imitation_rounds)),
    ):
        if number < 1:
            raise OptionError(
                f"{name} must be at least {'imitation_rounds' if name == 'env_steps' else 1}"
            )
    for count in demonstrations:
        if count < 2:
            raise OptionError(f"demonstrations must be at least 2, not {count}")
    data = Recording(
        task=task, episodes=max(demonstrations), options={"start": "mixed"}, noise=noise
    )
    on = [Scenes(task=task)]
    few, evaluations = min(EVAL_EPISODES, episodes), 1 if quick else EVALUATIONS
    cells = []
    for count in demonstrations:
        base = Imitation(data=data, steps=base_steps, settings={"episodes": count}, eyes=eyes)
        ways: dict[str, tuple[Way, str | None]] = {
            BASE: (base, None),
            FINETUNED: (
                Finetuning(
                    base=base,
                    task=task,
                    steps=env_steps,
                    settings={"reach_m": reach_m},
                    curriculum=curriculum,
                    evaluations=evaluations,
                    eval_episodes=few,
                ),
                BASE,
            ),
        }
        for teacher in teachers:
            taught = Imitation(
                data=data,
                steps=imitation_steps,
                settings={
                    "episodes": count,
                    "dagger_rounds": imitation_rounds,
                    "dagger_frames": env_steps // imitation_rounds,
                    "dagger_teacher": teacher,
                },
                eyes=eyes,
            )
            ways[f"DAgger, {teacher}"] = taught, FINETUNED
        cells += [
            Cell(group=f"{task}, {count} demonstrations", name=name, way=way, on=on, against=other)
            for name, (way, other) in ways.items()
        ]
    scratch = Scratch(task=task, steps=env_steps, evaluations=evaluations, eval_episodes=few)
    cells.append(Cell(group=f"{task}, no demonstrations", name=SCRATCH, way=scratch, on=on))
    return Plan(
        name="few-demonstrations",
        question="What does RL add where demonstrations are few, and what does more imitation?",
        cells=cells,
        seeds=1 if quick else 3,
        episodes=episodes,
    )
