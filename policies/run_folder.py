"""The folder of a training run: whose it is, and what it was started with."""

import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hvs_suite.errors import OutputError
from hvs_suite.files import check_writable, replacing

CONFIG = "train_config.json"
PACKAGES = ("hvs-suite", "mujoco", "numpy", "stable-baselines3", "torch")


def claim(
    out: Path, settings: Mapping[str, Any], budget: Mapping[str, Any], *, device: str
) -> None:
    """Take a folder, or recognise it as an interrupted run with the same settings.

    Args:
        out: The folder; made if missing.
        settings: What the run is a function of, as JSON has it.
        budget: How long to train; may differ from one sitting to the next.
        device: Noted beside the versions of what trains.

    Raises:
        OutputError: It cannot be written, or holds something else.
    """
    import torch

    config = out / CONFIG
    check_writable(config)
    try:
        begun = json.loads(config.read_text())["settings"]
    except OSError:
        if any(out.iterdir()):
            raise OutputError(f"{out} is not empty; name another --out") from None
    except (ValueError, KeyError, TypeError):
        raise OutputError(f"{config} is damaged; name another --out") from None
    else:
        differing = sorted(name for name in settings if begun.get(name) != settings[name])
        if differing:
            raise OutputError(
                f"{out} holds a run with another {', '.join(differing)}; name another --out"
            )
    content = {
        "format": 1,
        "settings": settings,
        "budget": budget,
        "device": device,
        "threads": torch.get_num_threads(),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
    }
    with replacing(config) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")
