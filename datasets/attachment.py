"""Restores the origin of a dataset that LeRobot's tools edited, after checking it."""

from collections.abc import Callable, Sequence
from pathlib import Path

from hvs_suite.datasets import reader
from hvs_suite.datasets.check import check_dataset
from hvs_suite.datasets.metadata import DatasetMetadata, read_metadata, write_metadata
from hvs_suite.errors import DatasetError


def attach(
    root: Path,
    origins: Sequence[Path],
    *,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> DatasetMetadata:
    """Writes ``hvs.json`` into a dataset that was made of others, if its episodes agree with it.

    LeRobot's tools copy neither this file nor unknown entries of ``info.json``. All episodes are
    played again, without pictures. If one does not fit the origins' task, split and options, this
    raises an error and writes nothing.

    Args:
        root: The edited dataset.
        origins: The datasets that it was made of, which may differ in noise and command alone.
        workers: Processes that share the episodes.
        progress: As in `check_dataset`.

    Returns:
        What was written.

    Raises:
        DatasetError: The origins differ in task, split, options or demonstrator, or an episode
            is not what they say.
        OutputError: The folder cannot be written.
    """
    reader.read_info(root)
    metadata = _joined(root, [(origin, read_metadata(origin)) for origin in origins])
    report = check_dataset(
        root, metadata=metadata, workers=workers, pictures=False, progress=progress
    )
    if report.damage:
        raise DatasetError(
            f"{root} is not made of {', '.join(map(str, origins))} alone, or damaged: "
            f"{report.damage[0]}"
        )
    write_metadata(root, metadata)
    return metadata


def _joined(root: Path, origins: Sequence[tuple[Path, DatasetMetadata]]) -> DatasetMetadata:
    """The one origin of several recordings.

    Raises:
        DatasetError: They are not recordings of the same task in the same way.
    """
    (first, joined), *others = origins
    for place, other in others:
        if not joined.same_recording(other.model_copy(update={"noise": joined.noise})):
            raise DatasetError(
                f"{first} and {place} differ in task, split, options or demonstrator, and "
                f"{root} can be of one alone; take it apart with lerobot-edit-dataset"
            )
    # Where the noise differs, the largest one fits all episodes.
    return joined.model_copy(
        update={
            "noise": max(metadata.noise for _, metadata in origins),
            "command": "; ".join(dict.fromkeys(metadata.command for _, metadata in origins)),
        }
    )
