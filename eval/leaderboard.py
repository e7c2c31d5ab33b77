"""Builds the board from result files: Markdown, and one web page that needs no network.

Run as ``python eval/leaderboard.py`` or ``hvs leaderboard``. Results lie as
``<results>/<policy>/<task>.json`` with their action logs beside them. A result that breaks a rule
of `submission.check`, or that differs when its actions are played again, stops the build with the
reason, because every row of the board has to be trustworthy.

Equal results give equal bytes, on any machine, as long as ``clips`` stays beside the board. What
was played again once is not played again on the same machine; see `replay_check`.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hvs_suite import files
from hvs_suite.errors import HvsError, OptionError
from hvs_suite.eval.board import clips, replay_check, rerun_check, submission
from hvs_suite.eval.board.markdown import markdown
from hvs_suite.eval.board.page import page
from hvs_suite.eval.board.tables import make_entries
from hvs_suite.eval.scoring import robustness_file
from hvs_suite.names import shown

RESULTS = Path("eval/results")
OUT = Path("eval")
ROBUSTNESS = "robustness"
"""Name of the folder of studies beside the results."""


def build(
    results_folder: Path = RESULTS,
    out: Path = OUT,
    *,
    replay: int = replay_check.SAMPLE,
    reruns: Path | None = None,
    ledger: Path | None = None,
    draft: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Path, Path]:
    """Writes ``LEADERBOARD.md`` and ``leaderboard.html``, and the clips beside them.

    Args:
        results_folder: Holds ``<policy>/<task>.json``. Robustness studies, if there are any, lie in
            the same way in the folder ``robustness`` beside it.
        out: Folder to write to; made if missing.
        replay: Scenarios of each new result to play again, drawn anew; a number that a result does
            not have plays all of it.
        reruns: Folder of the maintainers' own results on an unseen split, laid out likewise; see
            `rerun_check`.
        ledger: Where this machine remembers what it played; `replay_check.own_ledger` by default.
        draft: Also show results that are not scores yet, and mark the board as a draft; see
            `submission.check`.
        say: Called with a line of text about each long step.

    Returns:
        The two files.

    Raises:
        ResultError: A result or a robustness study is refused, or there is no result; the board
            stays as it was.
        OptionError: `replay` is below 1, or the ledger lies among the results.
        OutputError: A file cannot be written.
        RenderError: A clip is to be drawn and nothing here can.
    """
    ledger = replay_check.own_ledger() if ledger is None else ledger
    if ledger.resolve().is_relative_to(results_folder.resolve()):
        raise OptionError(f"{ledger} lies among the results; what was played is noted elsewhere")
    submissions = submission.check(results_folder, draft=draft)
    written = out / "LEADERBOARD.md", out / "leaderboard.html"
    for path in written:
        files.check_writable(path)
    replays = replay_check.check(submissions, ledger, sample=replay, say=say)
    rerun = {} if reruns is None else rerun_check.check(submissions, reruns)
    entries = make_entries(submissions, replays, rerun)
    films = clips.clips(submissions, out / clips.FOLDER, say)
    studies = robustness_file.load_all(results_folder.with_name(ROBUSTNESS))
    texts = markdown(entries, draft=draft), page(entries, films, studies=studies, draft=draft)
    for path, text in zip(written, texts, strict=True):
        with files.replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    return written


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
        default=replay_check.SAMPLE,
        help="scenarios of each new result to play again; 1000 plays all (default: %(default)s)",
    )
    parser.add_argument("--reruns", type=Path, help="folder of the maintainers' own re-runs")
    parser.add_argument(
        "--ledger", type=Path, help="where to remember what was played (default: the user's cache)"
    )
    parser.add_argument("--draft", action="store_true", help="show what is no score yet")
    options = parser.parse_args(arguments)
    try:
        for path in build(
            options.results,
            options.out,
            replay=options.replay,
            reruns=options.reruns,
            ledger=options.ledger,
            draft=options.draft,
            say=_say,
        ):
            print(path)
    except HvsError as error:
        _say(str(error))
        return 2
    return 0


def _say(line: str) -> None:
    print(f"leaderboard: {shown(line)}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
