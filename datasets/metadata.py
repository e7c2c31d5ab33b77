"""``hvs.json``: what a dataset was recorded from, beside LeRobot's own ``meta/``."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import pydantic

from hvs_suite.errors import DatasetError
from hvs_suite.files import replacing
from hvs_suite.names import check_name
from hvs_suite.reading import read_object, validated

METADATA_FILE = "hvs.json"
FORMAT: Final = 1
EXPERT: Final = "expert"
_ADDED_LATER = frozenset({"task_digest", "demonstrator"})
_MOST_BYTES = 2**20


# Shown in cards, films and terminals.
_Name = Annotated[
    str,
    pydantic.Strict(),
    pydantic.AfterValidator(lambda name: check_name(name, "a name", error=DatasetError)),
]


class DatasetMetadata(pydantic.BaseModel, frozen=True):
    """Origin of a dataset: enough to play its scenarios again.

    Attributes:
        task: Registered name.
        task_version: Version of that name.
        split: Stream that the scenarios come from.
        options: Options of the task that differ from the named one.
        noise: Standard deviation of the perturbation of executed actions, far from the goal (rad).
        demonstrator: The policy that chose the actions, as ``hvs record --policy`` names it.
        command: Command that recorded it, for readers.
        task_digest: What the task's name meant then, as ``hvs_suite.tasks.shared.lock`` says it;
            empty in datasets from before it was kept.
        format: Version of this file.
    """

    task: _Name
    task_version: Annotated[int, pydantic.Field(strict=True, ge=0)]
    split: _Name
    options: Mapping[str, Any] = {}
    noise: Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)] = 0.0
    demonstrator: _Name = EXPERT
    command: Annotated[str, pydantic.StringConstraints(strict=True, max_length=100_000)] = ""
    task_digest: Annotated[str, pydantic.StringConstraints(pattern="^([0-9a-f]{64})?$")] = ""
    format: Literal[1] = FORMAT

    def same_recording(self, other: "DatasetMetadata") -> bool:
        """Whether both describe the same demonstrations, whatever command asked for them."""
        own, others = self, other
        if not (self.task_digest and other.task_digest):
            own, others = (each.model_copy(update={"task_digest": ""}) for each in (self, other))
        left, right = (each.model_copy(update={"command": ""}) for each in (own, others))
        return left == right


def write_metadata(root: Path, metadata: DatasetMetadata) -> None:
    """Writes ``hvs.json`` into a dataset's root, atomically.

    Raises:
        OutputError: The folder cannot be written.
    """
    text = json.dumps(metadata.model_dump(), indent=2) + "\n"
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
    if not os.path.lexists(path):
        raise DatasetError(
            f"{root} holds no {METADATA_FILE}: name the root of a dataset made by 'hvs record'; "
            f"for one that LeRobot's tools edited, 'hvs attach {root} --origin DIR' restores it"
        )
    content = read_object(path, error=DatasetError, within=Path(root), most=_MOST_BYTES)
    if content.get("format") != FORMAT:
        raise DatasetError(f"{path} has another format than {FORMAT}; update hvs-suite")
    for name in sorted(set(DatasetMetadata.model_fields) - _ADDED_LATER):
        if name not in content:
            raise DatasetError(f"{path} lacks {name!r}; record the dataset again")
    return validated(DatasetMetadata, content, path, error=DatasetError)
