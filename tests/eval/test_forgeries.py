"""Whatever gate a forged result comes to, it is played again and found out."""

from collections.abc import Callable
from pathlib import Path

import pytest
from forgeries import SAMPLE, forged_ledger, ground_sample, near_a_bound

from hvs_suite.cli import main

FORGERIES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a goal that was near one bound of two": (near_a_bound, "success is True"),
    "blanks that choose the sample": (ground_sample, "position_error_mm is 1.0"),
    "a note that all was played": (forged_ledger, "position_error_mm is 1.0"),
}
GATES = {
    "verify": "verify {path}",
    "verify a sample": f"verify {{path}} --sample {SAMPLE}",
    "submission": f"verify --submission --results {{results}} {{path}} --sample {SAMPLE}",
    "board": f"leaderboard --results {{results}} --out {{out}} --replay {SAMPLE}",
}


@pytest.fixture(scope="module", params=FORGERIES)
def forgery(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    make, reason = FORGERIES[request.param]
    return make(tmp_path_factory.mktemp("forged")), reason


@pytest.mark.parametrize("gate", GATES)
def test_a_forgery_is_found_out(
    gate: str,
    forgery: tuple[Path, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, reason = forgery
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    results = path.parents[1]
    words = GATES[gate].format(path=path, results=results, out=results.with_name("out"))
    # Twice: a sample of twenty misses 400 rows of 1,000 once in 28,000 times by chance.
    ends = [main.run(words.split()) for _ in range(2)]
    assert any(ends)
    assert reason in capsys.readouterr().err.splitlines()[-1]
    assert not (results.with_name("out") / "LEADERBOARD.md").exists()
