r"""What the maintainers found when they ran a policy themselves, on a new split.

Playing logged actions again proves what they did, but not that the named policy chose them. Running
the policy itself proves that too: its weights or its server, on scenarios that were not known in
advance. Such results lie in a folder of the maintainers', as ``<policy>/<task>.json``, which no
submission touches::

    hvs evaluate --policy my/checkpoint --task align-easy --split <unseen> \
      --episodes 200 --out reruns/my-policy/align-easy.json
    hvs leaderboard --reruns reruns
"""

from collections.abc import Sequence
from pathlib import Path

from hvs_suite.errors import ResultError
from hvs_suite.eval.board.submission import Submission
from hvs_suite.eval.scoring import result_file
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.eval.scoring.verification import check_as_named, check_task


def check(submissions: Sequence[Submission], folder: Path) -> dict[str, Result]:
    """Reads the re-runs of results and compares the results with them.

    Args:
        submissions: Results of the board.
        folder: The maintainers' own; holds ``<policy>/<task>.json`` for some of them.

    Returns:
        Re-runs by ``<policy>/<task>``.

    Raises:
        ResultError: A re-run is of another policy, task or weights, was played on the split that
            the board shows, or its interval of success lies below or above that of the result.
    """
    found: dict[str, Result] = {}
    for entry in submissions:
        name = f"{entry.path.parent.name}/{entry.path.stem}"
        path = folder / f"{name}.json"
        if not path.exists():
            continue
        rerun, result = result_file.load(path), entry.result
        check_as_named(path, rerun)
        check_task(path, rerun)
        for what, theirs, ours in (
            ("task", rerun.summary.task, result.summary.task),
            ("policy_kind", rerun.metadata.policy_kind, result.metadata.policy_kind),
            ("policy_hash", rerun.metadata.policy_hash, result.metadata.policy_hash),
        ):
            if theirs != ours:
                raise ResultError(f"{path}: {what} is {theirs}, but {ours} in {entry.path}")
        if rerun.summary.split == result.summary.split:
            raise ResultError(
                f"{path}: was played on {rerun.summary.split!r}; take an unseen split"
            )
        (low, high), (least, most) = rerun.summary.pc_success_ci95, result.summary.pc_success_ci95
        if high < least or low > most:
            raise ResultError(
                f"{entry.path}: claims a success of {least:.1f} to {most:.1f} %, but the policy "
                f"itself reached {low:.1f} to {high:.1f} % on {rerun.summary.n_episodes} scenarios "
                "that it had not seen"
            )
        found[name] = rerun
    return found
