"""What a policy was trained for, as its checkpoint says it, and whether a task is that.

A network that learned at ten decisions a second, over a level table, cannot notice that a task
differs: it would play it badly without any warning. So ``config.json`` names the family of tasks,
the control period and the options of the task. Checkpoints from before these were kept are of the
family ``align``, at 0.1 s, without options.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import pydantic

from hvs_suite.errors import PolicyError
from hvs_suite.names import shown
from hvs_suite.reading import validated
from hvs_suite.registry import options_of
from hvs_suite.tasks.shared.option_types import listed
from hvs_suite.tasks.shared.spec import Disturbances, Spec

FAMILY = "align"
CONTROL_PERIOD_S = 0.1
"""What checkpoints are for that do not say it."""

OURS = ("hvs", "hvs_sac")
"""Types of policies that say what they are for, or are from before it was kept."""

_MOST_WORDS = 200
"""Characters of a message that a checkpoint's own options may fill."""
_FREE = frozenset(
    {
        # Where episodes begin and end, what they pay, and what disturbs them: a policy that was
        # trained with one is to be tried with another.
        *(field.name for field in dataclasses.fields(Disturbances)),
        "start",
        "goal",
        "time_limit_steps",
        "time_limit",
        "hold_steps",
        "discount",
        "rewards",
        "multisampling",
        # The shapes of the inputs say these.
        "observations",
        "normalise_observation",
        "action_mode",
        "eih_resolution",
        "eth_resolution",
        "eih_channels",
        "eth_channels",
    }
)


class TrainedFor(pydantic.BaseModel):
    """What a policy was trained for.

    Attributes:
        family: Family of tasks.
        control_period_s: Length of a control step (s).
        options: Options of the task that differed from the named one, by name.
    """

    family: Annotated[str, pydantic.StringConstraints(strict=True, max_length=100)] = FAMILY
    control_period_s: Annotated[float, pydantic.Field(gt=0.0, allow_inf_nan=False)] = (
        CONTROL_PERIOD_S
    )
    options: Mapping[str, Any] = {}


def trained_for(spec: Spec) -> TrainedFor:
    """What a policy is for that learns a task.

    Args:
        spec: Parameters of the task, its options included.
    """
    return TrainedFor(
        family=spec.family, control_period_s=spec.control_period_s, options=options_of(spec)
    )


def check_trained_for(config: Mapping[str, Any], folder: Path, spec: Spec) -> None:
    """Check that a task is what a policy was trained for.

    Where an episode starts, how long it may take, what it pays, what is called solved and what
    disturbs it may differ.

    Args:
        config: Of the checkpoint.
        folder: The checkpoint, for the message.
        spec: The task.

    Raises:
        PolicyError: It is another one, or the configuration is damaged.
    """
    content = {name: config[name] for name in TrainedFor.model_fields if name in config}
    if not content and config.get("type") not in OURS:
        # Policies of other packages do not tell; only their inputs and actions are known.
        return
    trained = validated(TrainedFor, content, folder / "config.json", error=PolicyError)
    played = trained_for(spec)
    mismatch = f"{folder} does not fit {spec.name}: it was trained"
    if trained.family != played.family:
        raise PolicyError(
            f"{mismatch} for the family {shown(trained.family)}, the task is of {played.family}"
        )
    if trained.control_period_s != played.control_period_s:
        raise PolicyError(
            f"{mismatch} for control steps of {trained.control_period_s:g} s, those of the task "
            f"take {played.control_period_s:g} s"
        )
    before, now = _binding(trained.options), _binding(played.options)
    differing = sorted(
        name for name in {*before, *now} if before.get(name, ...) != now.get(name, ...)
    )
    if differing:
        raise PolicyError(
            f"{mismatch} with {_in_words(before, differing)}, the task is played with "
            f"{_in_words(now, differing)}; play it with the options of the training"
        )


def _binding(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those options that training and playing have to share; the period is looked at apart."""
    return {
        name: value
        for name, value in options.items()
        if name not in _FREE and name != "control_period_s" and "tolerance" not in name
    }


def _in_words(options: Mapping[str, Any], names: list[str]) -> str:
    words = (
        listed({name: options[name]}) if name in options else f"{name} as named" for name in names
    )
    return shown(", ".join(words)[:_MOST_WORDS])
