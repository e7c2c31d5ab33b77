"""Names on the board that are ours, and the actions of the results that may have them.

``eval/ours.json`` holds the SHA-256 of the action log of each ``<policy>/<task>`` that the suite's
own policies stand on the board with. A submission does not touch it. After they were scored again,
``python -m hvs_suite.eval.board.ours`` writes it from ``eval/results``.
"""

import json
from pathlib import Path

from hvs_suite import files, names, reading
from hvs_suite.errors import ResultError
from hvs_suite.eval.scoring import action_log
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.policies import catalogue
from hvs_suite.tasks.shared import lock

FILE = Path(__file__).resolve().parents[1] / "ours.json"


def check(path: Path, result: Result) -> None:
    """Checks that a result has a name of ours only if it is ours.

    Args:
        path: ``<policy>/<task>.json``.
        result: What it holds.

    Raises:
        ResultError: It has such a name, or one that looks like it, with other actions.
    """
    folder, summary = path.parent.name, result.summary
    for name in (folder, summary.policy):
        ours = names.look_alike(name, catalogue.NAMES)
        if ours is None:
            continue
        if name != ours:
            raise ResultError(
                f"{path}: {names.shown(name)!r} passes for {ours!r}, a policy of the suite; choose "
                "another name"
            )
        # Of tasks that other packages register there is none of ours; on their boards our names
        # stand for what plays again when the board is built.
        known = shipped().get(f"{ours}/{summary.task}")
        is_foreign = not lock.is_own(summary.task) and result.metadata.policy_kind == "builtin"
        if known != result.metadata.actions_sha256 and not is_foreign:
            raise ResultError(
                f"{path}: {ours!r} is a policy of the suite, and these are not the actions of its "
                "own result; choose another name"
            )
        if folder != ours:
            raise ResultError(f"{path}: is {ours}'s own result; it lies in the folder {ours}")
    if result.metadata.policy_kind == "builtin" and summary.policy not in catalogue.BUILTIN:
        raise ResultError(f"{path}: {names.shown(summary.policy)!r} is no built-in policy")


def is_shipped(path: Path, result: Result) -> bool:
    """Returns whether a result is one of those that we ship.

    Args:
        path: ``<policy>/<task>.json``.
        result: What it holds.
    """
    name = f"{path.parent.name}/{result.summary.task}"
    return shipped().get(name) == result.metadata.actions_sha256


def shipped() -> dict[str, str]:
    """Returns the SHA-256 of the action log of each result of ours, by ``<policy>/<task>``."""
    return reading.read_object(FILE, error=ResultError)


def found(results: Path) -> dict[str, str]:
    """Returns what `shipped` should be, of the results in a folder."""
    return {
        f"{name}/{path.name.removesuffix('.actions.npz')}": action_log.digest(path)
        for name in sorted(catalogue.NAMES)
        for path in sorted((results / name).glob("*.actions.npz"))
    }


if __name__ == "__main__":
    with files.replacing(FILE) as temporary:
        content = found(FILE.with_name("results"))
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
