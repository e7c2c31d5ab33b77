"""A policy with a residual or a choice as an ordinary `hvs` checkpoint."""

import dataclasses
import json
import shutil
from pathlib import Path

from safetensors.torch import load_file, save

from hvs_suite.errors import PolicyError
from hvs_suite.files import replacing
from hvs_suite.policies.belief.choice import Choice
from hvs_suite.policies.belief.network import BeliefNetwork, Shape
from hvs_suite.policies.belief.residual import Residual
from hvs_suite.policies.checkpoints.files import CONFIG, WEIGHTS, read_config
from hvs_suite.policies.checkpoints.loading import (
    NETWORK_PREFIX,
    STANDARD_STEPS,
    load_network,
)
from hvs_suite.policies.residual.settings import Settings
from hvs_suite.policies.trained_for import trained_for
from hvs_suite.tasks.shared.spec import Spec

SIZES = ("residual_hidden", "residual_step_m", "residual_reach_m", "choice_beyond_m")
"""Of `Shape`: what fine-tuning adds."""


def load_base(folder: Path) -> BeliefNetwork:
    """Load the network of a checkpoint that can be fine-tuned.

    Args:
        folder: The checkpoint.

    Raises:
        PolicyError: It is not of an `hvs` policy, or was fine-tuned already.
    """
    network = load_network(folder)
    if network.residual is not None or network.choice is not None:
        raise PolicyError(f"{folder} was fine-tuned already; go on from the policy before that")
    return network


def with_residual(base: BeliefNetwork, settings: Settings) -> BeliefNetwork:
    """The same network with a residual that adds nothing yet.

    Args:
        base: Without one.
        settings: Its sizes.
    """
    shape = dataclasses.replace(
        base.shape,
        residual_hidden=settings.hidden,
        residual_step_m=(settings.sideways_m, settings.along_m),
        residual_reach_m=settings.reach_m,
    )
    network = BeliefNetwork(shape, base.cell)
    network.load_state_dict(base.state_dict(), strict=False)
    return network.eval()


def with_choice(base: BeliefNetwork, beyond_m: float) -> BeliefNetwork:
    """The same network with a choice that shifts nothing yet.

    Args:
        base: Without one.
        beyond_m: How far from the goal it is to act (m).
    """
    network = BeliefNetwork(dataclasses.replace(base.shape, choice_beyond_m=beyond_m), base.cell)
    network.load_state_dict(base.state_dict(), strict=False)
    return network.eval()


def write_folded(base: Path, added: Residual | Choice, shape: Shape, out: Path, spec: Spec) -> None:
    """Write a base with what was learned on it as a checkpoint that LeRobot and the suite load.

    Args:
        base: Checkpoint that gives configuration, processors and all other weights.
        added: Made for it, see `with_residual` and `with_choice`.
        shape: Of the network with it.
        out: Gets ``config.json``, ``model.safetensors`` and the two processors, each whole.
        spec: Task that it was trained on last, its options included.
    """
    out.mkdir(parents=True, exist_ok=True)
    config = read_config(base) | trained_for(spec).model_dump()
    config |= {name: getattr(shape, name) for name in SIZES}
    part = "choice" if isinstance(added, Choice) else "residual"
    # The base's own as they are, in half precision mostly.
    weights = load_file(base / WEIGHTS)
    weights |= {
        f"{NETWORK_PREFIX}{part}.{name}": value.detach().contiguous()
        for name, value in added.state_dict().items()
    }
    for name in STANDARD_STEPS:
        shutil.copy(base / name, out / name)
    with replacing(out / WEIGHTS) as temporary:
        temporary.write_bytes(save(weights, {"format": "pt"}))
    with replacing(out / CONFIG) as temporary:
        temporary.write_text(json.dumps(config, indent=2, sort_keys=True) + "\n")
