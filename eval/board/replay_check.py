"""Which results were played again before they went on the board, and how many scenarios of each.

The build of the board plays them. A ledger records this by each file's content, so that a build
plays only new results. The ledger is one of the builder's own files, never a submitted file,
because anyone could write what is submitted.
"""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import pydantic

from hvs_suite import files, reading
from hvs_suite.errors import OptionError, ResultError
from hvs_suite.eval.board.submission import Submission
from hvs_suite.eval.scoring import verification

SAMPLE: Final = 20
"""Scenarios of a new result that a build plays: a second a result, and one altered row in ten does
not get past it seven times out of eight."""

Digest = Annotated[str, pydantic.Field(pattern="^[0-9a-f]{64}$")]


class _Ledger(pydantic.BaseModel):
    """How many scenarios were played, by the SHA-256 of the result, which names the log's."""

    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)

    played: dict[Digest, Annotated[int, pydantic.Field(ge=1)]]


def own_ledger() -> Path:
    """Returns where this user's ledger lies: in ``$XDG_CACHE_HOME``, or ``~/.cache``."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    folder = Path(cache) if Path(cache).is_absolute() else Path.home() / ".cache"
    return folder / "hvs_suite" / "replays.json"


def check(
    submissions: Sequence[Submission],
    ledger: Path,
    *,
    sample: int = SAMPLE,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, int]:
    """Plays results again, unless the ledger says that it was done, and notes it there.

    Args:
        submissions: Results, each in its ``<policy>/<task>.json``.
        ledger: File of earlier builds; made if missing.
        sample: Scenarios of each to play, drawn anew for each build; at least 1.
        say: Told about each that is played.

    Returns:
        How many scenarios of each were asked for and came out again, by ``<policy>/<task>``.

    Raises:
        ResultError: A result does not come out again, or the ledger is malformed.
        OptionError: `sample` is below 1.
        OutputError: The ledger cannot be written.
    """
    if sample < 1:
        raise OptionError(f"at least 1 scenario of each result is played again, not {sample}")
    files.check_writable(ledger)
    known = _read(ledger)
    nonce = verification.new_nonce()
    found: dict[str, int] = {}
    for entry in submissions:
        name = f"{entry.path.parent.name}/{entry.path.stem}"
        n_wanted = min(sample, entry.result.summary.n_episodes)
        sha256 = hashlib.sha256(entry.path.read_bytes()).hexdigest()
        if known.get(sha256, 0) < n_wanted:
            drawn = f", drawn with nonce {nonce}" if sample == n_wanted else ""
            say(f"playing {n_wanted} scenarios of {name} again{drawn}")
            verdict = verification.verify(entry.path, sample=sample, nonce=nonce)
            known[sha256] = verdict.n_played
            # At once: a later result that is refused does not make this one be played again.
            _write(ledger, known)
        found[name] = n_wanted
    return found


def _write(ledger: Path, played: dict[str, int]) -> None:
    with files.replacing(ledger) as temporary:
        content = _Ledger(played=dict(sorted(played.items()))).model_dump()
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _read(ledger: Path) -> dict[str, int]:
    if not ledger.exists():
        return {}
    try:
        content = reading.read_json(ledger, error=ResultError)
        return dict(reading.validated(_Ledger, content, ledger, error=ResultError).played)
    except ResultError as error:
        raise ResultError(
            f"{ledger}: is no ledger of replays; delete it and build again ({error})"
        ) from error
