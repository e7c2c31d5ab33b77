"""Everything a training run needs to go on after a kill, in one file without pickle.

Weights, optimiser moments and counters go into a single safetensors file that replaces the last
one in one step, so weights and optimiser can never be of different ages.
"""

import dataclasses
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hvs_suite.errors import OutputError, first_line
from hvs_suite.files import replacing
from hvs_suite.reading import check_regular

WEIGHT = "weight."
MOMENT = "moment."


@dataclasses.dataclass(frozen=True)
class Counters:
    """How far a run has come.

    Attributes:
        step: Optimiser steps done.
        elapsed_s: Training time over all sittings (s).
    """

    step: int = 0
    elapsed_s: float = 0.0


def save_state(
    path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, counters: Counters
) -> None:
    """Write the state of a run.

    Args:
        path: File to replace.
        model: Weights to keep.
        optimizer: Moments to keep; those of its parameters in order.
        counters: How far the run has come.
    """
    tensors = {WEIGHT + name: value.contiguous() for name, value in model.state_dict().items()}
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            tensors[f"{MOMENT}{index}.{name}"] = value.contiguous()
    metadata = {"step": str(counters.step), "elapsed_s": repr(counters.elapsed_s)}
    with replacing(path) as temporary:
        # Its `save_file` hides that the disk is full behind an error of its own.
        temporary.write_bytes(save(tensors, metadata))


def load_state(path: Path, model: nn.Module, optimizer: torch.optim.Optimizer) -> Counters:
    """Put a run back to where it was saved.

    Args:
        path: File that `save_state` wrote; a missing one is a run that has not begun.
        model: Gets the weights.
        optimizer: Gets the moments; must hold the same parameters.

    Returns:
        How far the run had come.

    Raises:
        OutputError: The file is damaged or of another network.
    """
    if not path.exists():
        return Counters()
    check_regular(path, error=OutputError)
    weights: dict[str, Tensor] = {}
    moments: dict[int, dict[str, Tensor]] = {}
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
            for key in file.keys():  # noqa: SIM118 - not a dict
                value = file.get_tensor(key)
                if key.startswith(WEIGHT):
                    weights[key.removeprefix(WEIGHT)] = value
                else:
                    index, name = key.removeprefix(MOMENT).split(".", 1)
                    moments.setdefault(int(index), {})[name] = value
        model.load_state_dict(weights)
        counters = Counters(int(metadata["step"]), float(metadata["elapsed_s"]))
        optimizer.load_state_dict(
            {"state": moments, "param_groups": optimizer.state_dict()["param_groups"]}
        )
    except (SafetensorError, OSError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise OutputError(
            f"{path} cannot be resumed ({first_line(error)}); name another --out"
        ) from error
    return counters
