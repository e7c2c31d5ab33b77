"""Which results were played again before they went on the board, and how many scenarios of each.

``verified.json`` beside the board remembers it by each file's hash, so that a build plays only what
is new and needs no simulator where nothing is. It is a note, not evidence: the tests play a sample
of every committed result again, and anybody may with ``hvs verify``.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

import pydantic

from hvs_suite import files
from hvs_suite.errors import OptionError, ResultError
from hvs_suite.eval import action_log, result_file, verification
from hvs_suite.eval.submission import Submission

LEDGER: Final = "verified.json"
SAMPLE: Final = 20
"""Scenarios of a new result that a build plays: a second a result, and one altered row in ten does
not get past it seven times out of eight."""


class Replay(pydantic.BaseModel):
    """What was found out about a result.

    Attributes:
        sha256: SHA-256 of the result file, which names the action log's.
        n_played: Scenarios that were played again, and came out as the file says.
    """

    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)

    sha256: Annotated[str, pydantic.Field(pattern="^[0-9a-f]{64}$")]
    n_played: Annotated[int, pydantic.Field(ge=1)]


_LEDGER = pydantic.TypeAdapter(dict[str, Replay])


def check(
    submissions: Sequence[Submission],
    ledger: Path,
    *,
    sample: int = SAMPLE,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, Replay]:
    """Plays results again, unless the ledger says that it was done.

    Args:
        submissions: Results, each in its ``<policy>/<task>.json``.
        ledger: File of an earlier build; may be missing. It is not written, see `write`.
        sample: Scenarios of each to play, drawn by the file's hash; at least 1.
        say: Told about each that is played.

    Returns:
        The ledger as it is now, by ``<policy>/<task>``.

    Raises:
        ResultError: An action log is not the one of its result, a result does not come out again,
            or the ledger is malformed.
        OptionError: `sample` is below 1.
    """
    if sample < 1:
        raise OptionError(f"at least 1 scenario of each result is played again, not {sample}")
    known = _read(ledger)
    found: dict[str, Replay] = {}
    for entry in submissions:
        name = f"{entry.path.parent.name}/{entry.path.stem}"
        sha256 = hashlib.sha256(entry.path.read_bytes()).hexdigest()
        replay = known.get(name)
        n_wanted = min(sample, entry.result.summary.n_episodes)
        if replay is None or replay.sha256 != sha256 or replay.n_played < n_wanted:
            say(f"playing {n_wanted} scenarios of {name} again")
            verdict = verification.verify(entry.path, sample=sample)
            replay = Replay(sha256=sha256, n_played=verdict.n_played)
        else:
            log = result_file.actions_path(entry.path)
            if action_log.digest(log) != entry.result.metadata.actions_sha256:
                raise ResultError(f"{log}: is not the action log that its result was written with")
        found[name] = replay
    return found


def write(ledger: Path, replays: Mapping[str, Replay]) -> None:
    """Writes the ledger; equal content gives equal bytes.

    Raises:
        OutputError: The file cannot be written.
    """
    content = {name: replays[name].model_dump() for name in sorted(replays)}
    with files.replacing(ledger) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8", newline="\n")


def _read(ledger: Path) -> dict[str, Replay]:
    try:
        return _LEDGER.validate_json(ledger.read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ResultError(
            f"{ledger}: is no ledger of replays; delete it and build again"
        ) from error
