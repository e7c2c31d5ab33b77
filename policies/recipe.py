"""How the shipped weights were made: the commands of each named task, to repeat it.

``recipes/<task>.json`` holds the training command of a policy, where it begins with the eyes or all
weights of an earlier training the commands of that one, and where the suite ships a fine-tuned
policy the command that makes it; the dataset's recipe in ``datasets/recipes`` has the recording
command. Tasks that differ in tolerance alone share a policy.
"""

import dataclasses
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from hvs_suite import registry
from hvs_suite.errors import OptionError

HERE = Path(__file__).resolve().parent
DATASET_RECIPES = HERE.parent / "datasets" / "recipes"

SHARED: Mapping[str, str] = MappingProxyType(
    {
        "align-fixed": "align-thesis",
        "align-easy": "align-thesis",
        "track-line": "track-curve",
    }
)
"""Tasks that the policy of another task plays: the same pictures of the same target, and nothing is
asked that the other does not ask."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """The commands, in order.

    Attributes:
        task: Named task whose policy this is.
        record: Words after ``hvs`` that record the demonstrations.
        earlier: Words after ``hvs`` of each command that makes what ``pretrain`` begins with, eyes
            or all weights; none if it begins afresh or with eyes that the suite ships for other
            tasks.
        pretrain: Words after ``hvs`` that train on them.
        finetune: Words after ``hvs`` that fine-tune what came of it; None if that is not shipped.
    """

    task: str
    record: tuple[str, ...]
    earlier: tuple[tuple[str, ...], ...]
    pretrain: tuple[str, ...]
    finetune: tuple[str, ...] | None


def trained_on(task: str) -> str:
    """The named task that a task's shipped policy was trained on.

    Args:
        task: Named task.
    """
    return SHARED.get(task, task)


def recipe(task: str) -> Recipe:
    """How the policy of a task was made.

    Args:
        task: Named task.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: The suite ships no policy of it.
    """
    registry.find(task)
    name = trained_on(task)
    if not (HERE / "recipes" / f"{name}.json").is_file():
        raise OptionError(
            f"the suite ships no policy of {task}, so there is none to make again; record and "
            "pretrain one yourself"
        )
    recorded, learned = (
        json.loads((folder / f"{name}.json").read_text())
        for folder in (DATASET_RECIPES, HERE / "recipes")
    )
    # Fine-tuned weights ship for the task alone on which they are better.
    finetune = learned.get("finetune") if task == name else None
    return Recipe(
        name,
        record=_words(recorded["command"]),
        earlier=tuple(_words(command) for command in learned.get("earlier", ())),
        pretrain=_words(learned["command"]),
        finetune=_words(finetune) if finetune else None,
    )


def _words(command: str) -> tuple[str, ...]:
    return tuple(shlex.split(command)[1:])
