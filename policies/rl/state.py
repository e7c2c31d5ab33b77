"""Everything that an SB3 run needs to go on after a kill, without pickle, which SB3's format is.

``state.safetensors`` holds networks and optimisers, with counters and random states as JSON in its
header: one file, replaced in one step. Rows are only ever added, so that each checkpoint
writes those since the last one, as ``replay/<first>-<end>.npz``, and drops what the memory forgot.
"""

import dataclasses
import json
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from torch import Tensor

from hvs_suite.errors import OutputError
from hvs_suite.files import replacing

STATE = "state.safetensors"
REPLAY = "replay"
Rows = dict[str, npt.NDArray[Any]]


@dataclasses.dataclass
class Counters:
    """How far a run has come, beyond what SB3 counts.

    Attributes:
        elapsed_s: Time spent playing and learning over all sittings (s).
        stored: Transitions that went into the replay memory, forgotten ones included.
    """

    elapsed_s: float = 0.0
    stored: int = 0


def save_run(folder: Path, model: SAC, counters: Counters) -> None:
    """Write the state of a run; call it between two iterations.

    Args:
        folder: Where the state lives.
        model: Networks, optimisers, replay memory, counters and a `Journal` as its environment.
        counters: Gets the rows that are now stored.
    """
    assert model.env is not None
    stored = model.num_timesteps
    _save_rows(folder / REPLAY, _memory(model), counters.stored, stored)
    counters.stored = stored
    rng = np.random.get_state()  # noqa: NPY002 - SB3 draws batches from this generator
    assert isinstance(rng, tuple)
    header = {
        "elapsed_s": counters.elapsed_s,
        "stored": stored,
        "env_steps": model.num_timesteps,
        "updates": model._n_updates,
        "episodes": model._episode_num,
        "place": model.env.env_method("state_dict")[0],
        "recent": list(model.ep_info_buffer or ()),
        "recent_success": list(model.ep_success_buffer or ()),
        "numpy_rng": [rng[0], rng[1].tolist(), *rng[2:]],
        "action_rng": model.action_space.np_random.bit_generator.state,
    }
    tensors = unshared(_tensors(model))
    with replacing(folder / STATE) as temporary:
        temporary.write_bytes(save(tensors, {"state": json.dumps(header)}))
    _forget_rows(folder / REPLAY, stored, _memory(model).buffer_size)


def load_run(folder: Path, model: SAC) -> Counters:
    """Put a run back to where it was saved; a folder without a state is a run not begun.

    Args:
        folder: As given to `save_run`.
        model: Of the same settings, fresh; the next reset of its environment leads into the
            middle of an episode.

    Returns:
        How far the run had come.

    Raises:
        OutputError: The state is damaged, or of other settings.
    """
    path = folder / STATE
    if not path.exists():
        return Counters()
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads(file.metadata()["state"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        _put_tensors(model, tensors)
        model.num_timesteps = int(header["env_steps"])
        model._n_updates = int(header["updates"])
        model._episode_num = int(header["episodes"])
        window = model._stats_window_size
        model.ep_info_buffer = deque(header["recent"], maxlen=window)
        model.ep_success_buffer = deque(header["recent_success"], maxlen=window)
        assert model.env is not None
        model.env.env_method("load_state_dict", header["place"])
        name, key, *rest = header["numpy_rng"]
        np.random.set_state((name, np.array(key, np.uint32), *rest))  # noqa: NPY002
        torch.set_rng_state(tensors["torch_rng"])
        model.action_space.np_random.bit_generator.state = header["action_rng"]
        counters = Counters(float(header["elapsed_s"]), int(header["stored"]))
        _load_rows(folder / REPLAY, _memory(model), counters.stored)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise OutputError(f"{path} cannot be resumed ({reason}); name another --out") from error
    return counters


def unshared(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors as safetensors takes them: on the CPU, in one piece, each with memory of its own.

    Args:
        tensors: By name; networks that share a part name it twice.
    """
    taken: set[int] = set()
    found: dict[str, Tensor] = {}
    for name, value in tensors.items():
        own = value.detach().cpu().contiguous()
        found[name] = own.clone() if own.data_ptr() in taken else own
        taken.add(own.data_ptr())
    return found


def _memory(model: SAC) -> DictReplayBuffer:
    assert isinstance(model.replay_buffer, DictReplayBuffer)
    return model.replay_buffer


def _optimizers(model: SAC) -> dict[str, torch.optim.Optimizer]:
    found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
    if model.ent_coef_optimizer is not None:
        found["temperature"] = model.ent_coef_optimizer
    return found


def _tensors(model: SAC) -> dict[str, Tensor]:
    """Networks, optimiser moments, temperature and torch's random state, by name."""
    tensors = {f"policy/{name}": value for name, value in model.policy.state_dict().items()}
    for which, optimizer in _optimizers(model).items():
        for index, moments in optimizer.state_dict()["state"].items():
            for name, value in moments.items():
                tensors[f"{which}/{index}/{name}"] = value
    if model.log_ent_coef is not None:
        tensors["log_ent_coef"] = model.log_ent_coef
    return {**tensors, "torch_rng": torch.get_rng_state()}


def _put_tensors(model: SAC, tensors: dict[str, Tensor]) -> None:
    prefix = "policy/"
    model.policy.load_state_dict(
        {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    )
    for which, optimizer in _optimizers(model).items():
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"{which}/"):
                _, index, name = key.split("/")
                moments.setdefault(int(index), {})[name] = value
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": moments, "param_groups": groups})
    if model.log_ent_coef is not None:
        with torch.no_grad():
            model.log_ent_coef.copy_(tensors["log_ent_coef"])


def _arrays(memory: DictReplayBuffer) -> Rows:
    """The memory's own arrays by name, (capacity, environments, ...) each."""
    arrays: Rows = {
        name: getattr(memory, name) for name in ("actions", "rewards", "dones", "timeouts")
    }
    for part in ("observations", "next_observations"):
        for name, array in getattr(memory, part).items():
            arrays[f"{part}.{name}"] = array
    return arrays


def _save_rows(folder: Path, memory: DictReplayBuffer, first: int, end: int) -> None:
    """Write rows ``first`` to ``end`` - 1 of a run, as far as the memory has them."""
    first = max(first, end - memory.buffer_size)
    if first == end:
        return
    rows = np.arange(first, end) % memory.buffer_size
    content = {name: array[rows] for name, array in _arrays(memory).items()}
    with replacing(folder / f"{first:010d}-{end:010d}.npz") as temporary:
        np.savez(temporary, **content)


def _load_rows(folder: Path, memory: DictReplayBuffer, stored: int) -> None:
    """Fill the memory with the last rows of a run, and remove what a kill left beyond."""
    wanted = max(0, stored - memory.buffer_size)
    arrays = _arrays(memory)
    for path, first, end in _shards(folder):
        if end > stored:
            path.unlink()
            continue
        if end <= wanted:
            continue
        if first > wanted:
            break
        rows = np.arange(first, end)
        kept = rows >= wanted
        with np.load(path, allow_pickle=False) as content:
            for name, array in arrays.items():
                array[rows[kept] % memory.buffer_size] = content[name][kept]
        wanted = end
    if wanted != stored:
        raise ValueError(f"rows {wanted} to {stored - 1} are missing")
    memory.pos = stored % memory.buffer_size
    memory.full = stored >= memory.buffer_size


def _forget_rows(folder: Path, stored: int, capacity: int) -> None:
    for path, _, end in _shards(folder):
        if end <= stored - capacity:
            path.unlink()


def _shards(folder: Path) -> list[tuple[Path, int, int]]:
    """Files of rows in order, each with its first and the one after its last."""
    found = []
    for path in sorted(folder.glob("[0-9]*-[0-9]*.npz")):
        first, _, end = path.stem.partition("-")
        found.append((path, int(first), int(end)))
    return found
