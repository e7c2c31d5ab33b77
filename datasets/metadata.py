"""``hvs.json``: what a dataset was recorded from, beside LeRobot's own ``meta/``."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hvs_suite.errors import DatasetError
from hvs_suite.files import replacing

METADATA_FILE = "hvs.json"
FORMAT = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class DatasetMetadata:
    """Origin of a dataset: enough to play its scenarios again.

    Attributes:
        task: Registered name.
        task_version: Version of that name.
        split: Stream that the scenarios come from.
        options: Options of the task that differ from the named one.
        noise: Standard deviation of the perturbation of executed actions, far from the goal (rad).
        command: What recorded it, for people.
        task_digest: What the task's name meant then, as ``hvs_suite.tasks.shared.lock`` says it;
            empty in datasets from before it was kept.
        format: Version of this file.
    """

    task: str
    task_version: int
    split: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    noise: float = 0.0
    command: str = ""
    task_digest: str = ""
    format: int = FORMAT

    def same_recording(self, other: "DatasetMetadata") -> bool:
        """Whether both describe the same demonstrations, whatever command asked for them."""
        own, others = self, other
        if not (self.task_digest and other.task_digest):
            own, others = (dataclasses.replace(each, task_digest="") for each in (self, other))
        return dataclasses.replace(own, command="") == dataclasses.replace(others, command="")


def write_metadata(root: Path, metadata: DatasetMetadata) -> None:
    """Writes ``hvs.json`` into a dataset's root, atomically.

    Raises:
        OutputError: The folder cannot be written.
    """
    text = json.dumps(dataclasses.asdict(metadata), indent=2) + "\n"
    with replacing(root / METADATA_FILE) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_metadata(root: str | Path) -> DatasetMetadata:
    """Reads ``hvs.json`` from a dataset's root.

    Args:
        root: Folder that holds ``meta/`` and ``hvs.json``.

    Returns:
        Origin of the dataset; options as JSON gives them (tuples are lists).

    Raises:
        DatasetError: There is no such file, or it was not written by this suite.
    """
    path = Path(root) / METADATA_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise DatasetError(
            f"{root} holds no {METADATA_FILE}: name the root of a dataset made by 'hvs record'"
        ) from None
    except ValueError as error:
        raise DatasetError(f"{path} is damaged ({error}); record the dataset again") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise DatasetError(f"{path} has another format than {FORMAT}; update hvs-suite")
    names = {field.name for field in dataclasses.fields(DatasetMetadata)}
    content.setdefault("task_digest", "")
    try:
        return DatasetMetadata(**{name: content[name] for name in names})
    except KeyError as error:
        raise DatasetError(f"{path} lacks {error}; record the dataset again") from None


def jsonable(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options as JSON gives them back, so that written and fresh ones compare equal."""
    loaded: dict[str, Any] = json.loads(json.dumps(dict(options), sort_keys=True))
    return loaded
