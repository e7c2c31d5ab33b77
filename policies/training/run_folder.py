"""The folder of a training run: which run it belongs to, and what it was started with."""

import contextlib
import importlib.metadata
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from hvs_suite.errors import OutputError
from hvs_suite.files import check_writable, only_writer, replacing
from hvs_suite.reading import read_object

CONFIG = "train_config.json"


@contextlib.contextmanager
def claimed(out: Path, settings: Mapping[str, Any]) -> Iterator[None]:
    """Take a folder, or recognise it as an interrupted run with the same settings.

    No other process can while the block lasts.

    Args:
        out: The folder; made if missing.
        settings: What the run is a function of, the budget aside.

    Raises:
        OutputError: It cannot be written, holds something else, or another process has it.
    """
    check_writable(out / CONFIG)
    with only_writer(out):
        _check_same_run(out, settings)
        yield


def _check_same_run(out: Path, settings: Mapping[str, Any]) -> None:
    """Refuse a folder that holds something else than an interrupted run with these settings."""
    config = out / CONFIG
    if not config.exists():
        if any(out.iterdir()):
            raise OutputError(f"{out} is not empty; name another --out")
        return
    begun = read_object(config, error=OutputError).get("settings")
    if not isinstance(begun, dict):
        raise OutputError(f"{config} is damaged; name another --out")
    wanted = json.loads(json.dumps(settings))
    differing = sorted(name for name in wanted if begun.get(name) != wanted[name])
    if differing:
        raise OutputError(
            f"{out} holds a run with another {', '.join(differing)}; name another --out"
        )


def write_train_config(
    out: Path,
    settings: Mapping[str, Any],
    budget: Mapping[str, Any],
    packages: Iterable[str],
    **notes: Any,
) -> None:
    """Write ``train_config.json``, from which a run can be repeated.

    Args:
        out: A `claimed` folder.
        settings: As claimed.
        budget: How long to train; may differ from one sitting to the next.
        packages: What trains; their versions are noted.
        **notes: What else is worth knowing, as JSON has it.
    """
    import torch

    content = {
        "format": 1,
        "settings": settings,
        "budget": budget,
        **notes,
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "threads": torch.get_num_threads(),
    }
    with replacing(out / CONFIG) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")
