"""Builds the board from result files: Markdown, and one web page that needs no network.

Run as ``python eval/leaderboard.py`` or ``hvs leaderboard``. Results lie as
``<results>/<policy>/<task>.json``; one that is malformed, a duplicate, or made with another version
of its task stops the build with the reason, because a board is only as good as its worst row.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from hvs_suite import files, registry
from hvs_suite.errors import HvsError, ResultError
from hvs_suite.eval import result_file
from hvs_suite.eval.board_page import page
from hvs_suite.eval.board_tables import Entry, markdown

RESULTS = Path("eval/results")
OUT = Path("eval")


def build(results_folder: Path = RESULTS, out: Path = OUT) -> tuple[Path, Path]:
    """Writes ``LEADERBOARD.md`` and ``leaderboard.html``; equal results give equal bytes.

    Args:
        results_folder: Holds ``<policy>/<task>.json``.
        out: Folder to write to; made if missing.

    Returns:
        The two files.

    Raises:
        ResultError: A result is refused, or there is none; nothing is written.
        OutputError: A file cannot be written.
    """
    entries = collect(results_folder)
    written = out / "LEADERBOARD.md", out / "leaderboard.html"
    for path, text in zip(written, (markdown(entries), page(entries)), strict=True):
        with files.replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    return written


def collect(results_folder: Path) -> list[Entry]:
    """Reads every result of a folder and refuses what does not belong on one board.

    Raises:
        ResultError: Names the file and the reason.
        UnknownTaskError: A result names a task that does not exist.
    """
    paths = sorted(results_folder.rglob("*.json"))
    if not paths:
        raise ResultError(
            f"there are no results below {results_folder}; make one with 'hvs evaluate ... --out "
            f"{results_folder}/<policy>/<task>.json'"
        )
    entries: list[Entry] = []
    places: dict[Path, Entry] = {}
    for path in paths:
        policy, *rest = path.relative_to(results_folder).parts
        if len(rest) != 1:
            raise ResultError(f"{path}: results lie as {results_folder}/<policy>/<task>.json")
        entry = Entry(policy, result_file.load(path))
        variant = registry.find(entry.result.summary.task)
        if entry.result.metadata.task_version != variant.version:
            raise ResultError(
                f"{path}: played on {entry.task}, but this hvs_suite has v{variant.version}; "
                "evaluate again"
            )
        if path.stem != entry.result.summary.task:
            raise ResultError(
                f"{path}: the file is named after one task, but holds a result of "
                f"{entry.result.summary.task}; rename it"
            )
        if entry.result.metadata.options:
            options = ", ".join(sorted(entry.result.metadata.options))
            raise ResultError(
                f"{path}: the task was changed ({options}); only the task as named is scored"
            )
        for earlier_path, earlier in places.items():
            _check_pair(path, entry, earlier_path, earlier)
        places[path] = entry
        entries.append(entry)
    return entries


def _check_pair(path: Path, entry: Entry, earlier_path: Path, earlier: Entry) -> None:
    """Refuses two results that cannot stand on the same board."""
    ours, theirs = entry.result, earlier.result
    if ours.summary.task != theirs.summary.task:
        return
    for what, mine, other in (
        ("task_digest", ours.metadata.task_digest, theirs.metadata.task_digest),
        ("split", ours.summary.split, theirs.summary.split),
    ):
        if mine != other:
            raise ResultError(
                f"{path}: {what} is {mine!r}, but {other!r} in {earlier_path}; evaluate both with "
                "the same version on the same split"
            )
    # Timings differ between two runs of the same thing, the rows of one policy do not.
    if (
        ours.summary.policy == theirs.summary.policy
        and ours.metadata.policy_hash == theirs.metadata.policy_hash
    ):
        raise ResultError(
            f"{path}: duplicate of {earlier_path}: policy {ours.summary.policy} on the same task; "
            "remove one"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the script; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--results",
        type=Path,
        default=RESULTS,
        help="folder that holds <policy>/<task>.json (default: %(default)s)",
    )
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder to write the board to (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    try:
        for path in build(options.results, options.out):
            print(path)
    except HvsError as error:
        print(f"leaderboard: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
