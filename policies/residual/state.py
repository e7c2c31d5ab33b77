"""All that a run needs to go on after a kill, in one file that is replaced whole; no pickle."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from hvs_suite.errors import OutputError, first_line
from hvs_suite.files import replacing
from hvs_suite.policies.residual.replay import Replay

Part = nn.Module | Optimizer | Replay


def save_state(path: Path, parts: Mapping[str, Part], counts: Mapping[str, Any]) -> None:
    """Write the state of a run.

    Args:
        path: The file.
        parts: What learns and remembers, by name.
        counts: The rest, as JSON has it.
    """
    tensors = {
        f"{name}/{key}": value.contiguous()
        for name, part in parts.items()
        for key, value in _tensors(part).items()
    }
    with replacing(path) as temporary:
        save_file(tensors, temporary, {"counts": json.dumps(counts)})


def load_state(path: Path, parts: Mapping[str, Part]) -> dict[str, Any] | None:
    """Go on from what `save_state` wrote.

    Args:
        path: The file.
        parts: As it was given them; they are filled.

    Returns:
        The counts; None if there is no file.

    Raises:
        OutputError: The file is damaged.
    """
    if not path.exists():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            counts: dict[str, Any] = json.loads(file.metadata()["counts"])
        for name, part in parts.items():
            prefix = f"{name}/"
            own = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
            _put(part, own)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise OutputError(
            f"{path} cannot be resumed ({first_line(error)}); name another --out"
        ) from error
    return counts


def _tensors(part: Part) -> dict[str, Tensor]:
    if isinstance(part, Replay):
        return part.state()
    if isinstance(part, nn.Module):
        return part.state_dict()
    return {
        f"{index}/{name}": value
        for index, moments in part.state_dict()["state"].items()
        for name, value in moments.items()
    }


def _put(part: Part, tensors: Mapping[str, Tensor]) -> None:
    if isinstance(part, Replay):
        part.load(tensors)
    elif isinstance(part, nn.Module):
        part.load_state_dict(tensors)
    else:
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            index, name = key.split("/")
            moments.setdefault(int(index), {})[name] = value
        groups = part.state_dict()["param_groups"]
        part.load_state_dict({"state": moments, "param_groups": groups})
