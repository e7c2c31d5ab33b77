"""Builds the board from result files: Markdown, and one web page that needs no network.

Run as ``python eval/leaderboard.py`` or ``hvs leaderboard``. Results lie as
``<results>/<policy>/<task>.json`` with their action logs beside them. One that is malformed,
altered, a duplicate, made with another version of its task, or does not come out again when its
actions are played stops the build with the reason: a board is only as good as its worst row.

Equal results give equal bytes, on any machine, as long as ``clips`` and ``verified.json`` stay
beside the board: what was drawn and played once is not drawn and played again.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hvs_suite import files
from hvs_suite.errors import HvsError, ResultError
from hvs_suite.eval import board_clips, board_replays, result_file, submission
from hvs_suite.eval.board_page import page
from hvs_suite.eval.board_tables import make_entries, markdown
from hvs_suite.eval.submission import Submission
from hvs_suite.eval.verification import check_task

RESULTS = Path("eval/results")
OUT = Path("eval")


def build(
    results_folder: Path = RESULTS,
    out: Path = OUT,
    *,
    replay: int = board_replays.SAMPLE,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Path, Path]:
    """Writes ``LEADERBOARD.md`` and ``leaderboard.html``, and what a rebuild needs beside them.

    Args:
        results_folder: Holds ``<policy>/<task>.json``.
        out: Folder to write to; made if missing.
        replay: Scenarios of each new result to play again, drawn by the file's hash; a number that
            a result does not have plays all of it.
        say: Told what takes time.

    Returns:
        The two files.

    Raises:
        ResultError: A result is refused, or there is none; the board stays as it was.
        OptionError: `replay` is below 1.
        OutputError: A file cannot be written.
        RenderError: A clip is to be drawn and nothing here can.
    """
    submissions = collect(results_folder)
    written = out / "LEADERBOARD.md", out / "leaderboard.html"
    for path in written:
        files.check_writable(path)
    ledger = out / board_replays.LEDGER
    replays = board_replays.check(submissions, ledger, sample=replay, say=say)
    entries = make_entries(submissions, replays)
    clips = board_clips.clips(submissions, out / board_clips.FOLDER, say)
    board_replays.write(ledger, replays)
    for path, text in zip(written, (markdown(entries), page(entries, clips)), strict=True):
        with files.replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    return written


def collect(results_folder: Path) -> list[Submission]:
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
    found: list[Submission] = []
    for path in paths:
        entry = Submission(path, result_file.load(path))
        submission.check_place(entry, results_folder)
        check_task(path, entry.result)
        for earlier in found:
            submission.check_pair(entry, earlier)
        found.append(entry)
    return found


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
    parser.add_argument(
        "--replay",
        type=int,
        default=board_replays.SAMPLE,
        help="scenarios of each new result to play again; 1000 plays all (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    try:
        for path in build(options.results, options.out, replay=options.replay, say=_say):
            print(path)
    except HvsError as error:
        print(f"leaderboard: {error}", file=sys.stderr)
        return 2
    return 0


def _say(line: str) -> None:
    print(f"leaderboard: {line}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
