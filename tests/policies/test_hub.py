"""Checkpoints by Hub id: what was fetched once plays offline, what was not says so in one line.

The Hub's client looks into a cache of the test's own, laid out as it does itself.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import huggingface_hub.constants
import pytest
from hub_server import running_hub

from hvs_suite.cli import main
from hvs_suite.errors import PolicyError
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.policies.checkpoints import hub

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


def test_no_code_and_no_pickle_is_ever_fetched(tmp_path: Path) -> None:
    plain = {"config.json", "model.safetensors", "train/config.json"}
    other = {"modeling.py", "pytorch_model.bin", "model.pkl", "train/optimizer.pt", "README.md"}
    program = "from hvs_suite.policies.checkpoints import hub; print(hub.fetch('someone/servoing'))"
    with running_hub() as server:
        server.files = {name: name.encode() for name in plain | other}
        done = subprocess.run(
            [sys.executable, "-c", program],
            env={
                **os.environ,
                "HF_HOME": str(tmp_path),
                "HF_ENDPOINT": server.url,
                "HF_HUB_OFFLINE": "0",
            },
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    folder = Path(done.stdout.strip())
    fetched = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert fetched == plain
    asked = [path.partition(f"/resolve/{'0' * 40}/")[2] for _, path in server.requests]
    assert {name for name in asked if name} == plain


@pytest.mark.parametrize("spec", ["a/b/c", "/absolute/path", "../up", "name", "a b/c", "a/b@"])
def test_what_is_no_id_is_not_asked_for(spec: str) -> None:
    with pytest.raises(PolicyError, match="no Hub id"):
        hub.fetch(spec)
