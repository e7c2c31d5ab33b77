"""The policy to be scored, found by name.

Light to import: a policy's own process starts with this, and holds nothing of the simulator.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from hvs_suite.errors import PolicyError
from hvs_suite.eval.scoring import provenance
from hvs_suite.policies.catalogue import AS_NAMED, policy_factory
from hvs_suite.policies.context import Blindfolded
from hvs_suite.policies.imported import ImportedFactory
from hvs_suite.rollout import PolicyFactory

PRIVILEGED = ("expert", "random")
"""Policies that may look behind the observations: at the true state, or at the scenario's index."""
BLIND = ("expert", "zero", "random")
"""Policies that look at no picture; without pictures they are played in a third of the time."""


@dataclasses.dataclass(frozen=True)
class Contender:
    """The policy to be scored, and what the result says of it.

    Attributes:
        name: As shown in the result.
        kind: ``builtin``, ``checkpoint``, ``module`` or ``server``.
        make: Builds it for an environment.
        hash: As ``policy_hash`` in the result.
        parameters: As ``policy_parameters``.
        training_steps: As in the result.
        training_hours: As in the result.
        looks: Whether it looks at pictures.
    """

    name: str
    kind: Literal["builtin", "checkpoint", "module", "server"]
    make: PolicyFactory
    hash: str | None = None
    parameters: int | None = None
    training_steps: int | None = None
    training_hours: float | None = None
    looks: bool = True


def find(policy: str, task: str, options: Mapping[str, Any] = AS_NAMED) -> Contender:
    """Finds the policy behind a name.

    Args:
        policy: As `policy_factory` takes it.
        task: Named task.
        options: Options that it is played with, where they differ from it.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: An option does not exist or its value makes no sense.
        PolicyError: There is no such policy, or it does not fit the task.
    """
    make = policy_factory(policy, task, options)
    # An absolute path would reveal the user and the machine.
    name = Path(policy).name if Path(policy).is_absolute() else policy
    if isinstance(make, ImportedFactory):
        source = make.source()
        return Contender(
            name=name,
            kind="module",
            make=make,
            hash=None if source is None else provenance.file_hash(source),
        )
    # A policy that comes from a checkpoint, shipped or not, knows its folder.
    folder: str | None = getattr(make, "folder", None)
    if folder is None:
        make = make if policy in PRIVILEGED else Blindfolded(make)
        return Contender(name=name, kind="builtin", make=make, looks=policy not in BLIND)
    training = provenance.training(Path(folder))
    return Contender(
        name=name,
        kind="checkpoint",
        make=Blindfolded(make),
        hash=provenance.checkpoint_hash(Path(folder)),
        parameters=provenance.parameters(Path(folder)),
        training_steps=training.steps,
        training_hours=training.hours,
    )


def check_public(policy: str) -> None:
    """Checks that a policy needs only the observations of a task.

    Args:
        policy: As `policy_factory` takes it.

    Raises:
        PolicyError: It needs more than the observations.
    """
    if policy in PRIVILEGED:
        raise PolicyError(
            f"{policy} needs more than the observations, which are all that a server gets; "
            "evaluate it without one"
        )
