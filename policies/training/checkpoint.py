"""Writes a LeRobot policy so that an earlier one stays intact until it is replaced."""

import json
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hvs_suite.errors import OutputError, first_line
from hvs_suite.files import replacing


def write_checkpoint(
    policy: Any, processors: Iterable[Any], folder: Path, *, half: bool = False
) -> None:
    """Write a checkpoint that LeRobot and the suite load, each file whole or not at all.

    Args:
        policy: A LeRobot policy.
        processors: Its pre- and post-processor.
        folder: Gets ``config.json``, ``model.safetensors`` and the two processors.
        half: Write single-precision weights in half precision, which takes half the room; they are
            single again once they are loaded.

    Raises:
        OutputError: It cannot be written; what stood there before still does.
    """
    from safetensors import SafetensorError

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".checkpoint-") as name:
            scratch = Path(name)
            policy.save_pretrained(scratch)
            if half:
                _halve(scratch / "model.safetensors")
            for processor in processors:
                processor.save_pretrained(scratch)
            # LeRobot reads the type before it knows the class; keep the file stable for diffs.
            config = json.loads((scratch / "config.json").read_text())
            (scratch / "config.json").write_text(
                json.dumps(config, indent=2, sort_keys=True) + "\n"
            )
            for path in sorted(scratch.iterdir()):
                # safetensors makes files that only their owner may read.
                with replacing(folder / path.name) as temporary:
                    shutil.copyfile(path, temporary)
    except (OSError, SafetensorError) as error:
        raise OutputError(f"cannot write {folder}: {first_line(error)}") from error


def _halve(path: Path) -> None:
    import torch
    from safetensors.torch import load_file, save_file

    weights = {
        name: weight.half() if weight.dtype == torch.float32 else weight
        for name, weight in load_file(path).items()
    }
    save_file(weights, path, {"format": "pt"})
