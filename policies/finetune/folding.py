"""A fine-tuned network as an ordinary `hvs` checkpoint, the residual folded in."""

import dataclasses
import json
import shutil
from pathlib import Path

from safetensors.torch import save

from hvs_suite.errors import PolicyError
from hvs_suite.files import replacing
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import NETWORK_PREFIX, STANDARD_STEPS, load_network
from hvs_suite.policies.network.network import HvsNetwork
from hvs_suite.policies.trained_for import trained_for
from hvs_suite.tasks.shared.spec import Spec


def load_base(folder: Path) -> HvsNetwork:
    """Load the network of a checkpoint that can be fine-tuned.

    Args:
        folder: The checkpoint.

    Raises:
        PolicyError: It is not of an `hvs` policy, has no joint inputs, or was fine-tuned already.
    """
    config = read_config(folder)
    if config.get("type") != "hvs":
        raise PolicyError(f"{folder} holds a policy of type {config.get('type')}, not hvs")
    network = load_network(folder, config)
    if not network.shape.state_dim:
        raise PolicyError(f"{folder} reads no joints, and a joint step is what fine-tuning changes")
    if network.residual is not None:
        raise PolicyError(f"{folder} was fine-tuned already; go on from the policy before that")
    return network


def with_residual(base: HvsNetwork, hidden: int, bound: float) -> HvsNetwork:
    """The same network with a residual that adds nothing yet.

    Args:
        base: Without one.
        hidden: Width of the residual's layers.
        bound: The most that it can add.
    """
    shape = dataclasses.replace(base.shape, residual_hidden=hidden, residual_bound=bound)
    network = HvsNetwork(shape)
    network.load_state_dict(base.state_dict(), strict=False)
    return network.eval()


def write_folded(base: Path, network: HvsNetwork, out: Path, spec: Spec) -> None:
    """Write a network as a checkpoint that LeRobot and the suite load, each file whole.

    Args:
        base: Checkpoint that it was made from; gives configuration and processors.
        network: Its inputs are the base's.
        out: Gets ``config.json``, ``model.safetensors`` and the two processors.
        spec: Task that it was trained on last, its options included.
    """
    out.mkdir(parents=True, exist_ok=True)
    config = read_config(base)
    config |= trained_for(spec).model_dump()
    config["residual_hidden"] = network.shape.residual_hidden
    config["residual_bound"] = network.shape.residual_bound
    weights = {
        NETWORK_PREFIX + name: value.detach().contiguous()
        for name, value in network.state_dict().items()
    }
    for name in STANDARD_STEPS:
        # A processor may keep numbers in a file of its own beside it.
        for path in base.glob(f"{Path(name).stem}*"):
            shutil.copy(path, out / path.name)
    with replacing(out / "model.safetensors") as temporary:
        temporary.write_bytes(save(weights, {"format": "pt"}))
    with replacing(out / "config.json") as temporary:
        temporary.write_text(json.dumps(config, indent=2, sort_keys=True) + "\n")
