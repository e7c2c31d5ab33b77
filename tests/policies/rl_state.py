"""Reads what an RL run keeps, to compare runs."""

import json

from safetensors import safe_open
from safetensors.torch import load_file


def state_of(folder):
    """Tensors and header of a run's state, without what a clock decides."""
    path = folder / "training" / "state.safetensors"
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["state"])
    header.pop("elapsed_s")
    for episode in header["recent"]:
        episode.pop("t")
    return load_file(path), header
