"""Sharing a policy: what others need goes, with a card that says what was measured."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hub_server import running_hub

from hvs_suite.cli.main import run
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.policies.checkpoints import card, files

TOKEN = "hf_" + "NeverToBeSeen" * 2
FILES = {card.CARD, *files.FILES, *card.TRAINING_FILES}


def files_below(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_a_shipped_folder_holds_what_others_need_and_plays(checkpoint, tmp_path):
    result = tmp_path / "align-easy.json"
    score = f"evaluate --policy {checkpoint} --task align-easy --episodes 2 --out {result}"
    assert run(score.split()) == 0
    out = tmp_path / "shipped"
    words = ["ship", str(checkpoint), "--to-folder", str(out), "--result", str(result)]
    assert run([*words, "--command", "hvs pretrain --steps 2"]) == 0
    assert files_below(out) == FILES
    policy_factory(str(out), "align-easy")
    text = (out / card.CARD).read_text()
    for found in ("align-easy", "of 2 (", "hvs pretrain --steps 2", "library_name: lerobot"):
        assert found in text


def test_without_a_place_to_go_the_card_goes_into_the_checkpoint(checkpoint, tmp_path):
    policy = tmp_path / "policy"
    shutil.copytree(checkpoint, policy)
    (policy / card.CARD).unlink(missing_ok=True)
    before = files_below(policy)
    assert run(["ship", str(policy)]) == 0
    assert files_below(policy) == before | {card.CARD}
    assert "library_name: lerobot" in (policy / card.CARD).read_text()


def test_the_hub_gets_every_file_and_nobody_sees_the_token(checkpoint, tmp_path):
    local = tmp_path / "policy"
    shutil.copytree(checkpoint, local)
    with running_hub() as hub:
        environment = {
            **os.environ,
            "HF_HOME": str(tmp_path / "hf"),
            "HF_ENDPOINT": hub.url,
            "HF_TOKEN": TOKEN,
            "HF_HUB_OFFLINE": "0",
        }
        program = Path(sys.executable).with_name("hvs")
        done = subprocess.run(
            [program, "ship", local, "--to-hub", "somebody/servoing", "--private"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    assert set(hub.files) == FILES
    assert all(hub.files[name] == (local / name).read_bytes() for name in FILES)
    [created] = hub.created
    # Versions of the client say it differently.
    assert created.get("private") or created.get("visibility") == "private"
    assert hub.authorizations - {None} == {f"Bearer {TOKEN}"}
    assert TOKEN not in done.stdout + done.stderr


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_text("null"),
        lambda path: path.write_text("[" * 100_000),
        lambda path: (path.unlink(), path.symlink_to("/etc/hostname")),
        lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
    ],
    ids=["null", "deep", "link out", "device"],
)
def test_notes_of_a_strange_run_are_refused_in_one_line(checkpoint, tmp_path, capsys, spoil):
    strange = tmp_path / "strange"
    shutil.copytree(checkpoint, strange)
    spoil(strange / "training" / "outcome.json")
    assert run(["ship", str(strange), "--to-folder", str(tmp_path / "out")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["{empty}"], "config.json"),
        (["{policy}", "--to-hub", "name"], "user/name"),
        (["{empty}", "--to-folder", "{out}"], "config.json"),
        (["{policy}", "--to-folder", "{out}", "--result", "{empty}/none.json"], "none.json"),
    ],
)
def test_mistakes_are_one_line(checkpoint, tmp_path, monkeypatch, capsys, words, reason):
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    (tmp_path / "empty").mkdir()
    names = {"policy": checkpoint, "empty": tmp_path / "empty", "out": tmp_path / "out"}
    assert run(["ship", *(word.format(**names) for word in words)]) == 2
    complaint = capsys.readouterr().err
    assert reason in complaint
    assert len(complaint.splitlines()) == 1
    assert not (tmp_path / "out").exists()
