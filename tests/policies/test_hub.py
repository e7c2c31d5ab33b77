"""Checkpoints by Hub id: what was fetched once plays offline, what was not says so in one line.

The Hub's client looks into a cache of the test's own, laid out as it does itself.
"""

import shutil
from pathlib import Path

import huggingface_hub.constants
import pytest

from hvs_suite.cli import main
from hvs_suite.errors import PolicyError
from hvs_suite.policies import hub
from hvs_suite.policies.catalogue import policy_factory

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    return tmp_path


def test_a_fetched_checkpoint_is_played_offline(cache: Path, checkpoint: Path) -> None:
    kept = cache / "models--someone--servoing"
    shutil.copytree(checkpoint, kept / "snapshots" / COMMIT)
    (kept / "refs").mkdir()
    (kept / "refs" / "main").write_text(COMMIT)
    (kept / "refs" / "v1").write_text(COMMIT)
    for spec in ("someone/servoing", "someone/servoing@v1", f"someone/servoing@{COMMIT}"):
        factory = policy_factory(spec, "align-easy")
        assert Path(factory.folder) == kept / "snapshots" / COMMIT  # type: ignore[attr-defined]
    with pytest.raises(PolicyError, match="does not fit"):
        policy_factory("someone/servoing", "align-limit")


def test_what_was_never_fetched_is_refused_in_one_line_with_2(
    cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = f"evaluate --policy someone/else --task align-easy --out {cache}/result.json"
    assert main.run(words.split()) == 2
    complaint = capsys.readouterr().err
    assert len(complaint.splitlines()) == 1
    assert "someone/else" in complaint


def test_no_code_and_no_pickle_is_ever_fetched() -> None:
    assert hub.FILES == ("*.json", "*.safetensors")


@pytest.mark.parametrize("spec", ["a/b/c", "/absolute/path", "../up", "name", "a b/c", "a/b@"])
def test_what_is_no_id_is_not_asked_for(spec: str) -> None:
    with pytest.raises(PolicyError, match="no Hub id"):
        hub.fetch(spec)
