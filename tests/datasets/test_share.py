"""``hvs share`` and ``hvs fetch``: the card, archives that can be trusted, and refusals."""

import io
import shutil
import tarfile
from pathlib import Path

import pytest

from hvs_suite.cli.main import run
from hvs_suite.datasets.archive import CHECKSUMS, pack, unpack
from hvs_suite.datasets.card import write_card
from hvs_suite.errors import DatasetError, OutputError
from hvs_suite.tasks.shared.lock import digest

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def copy(tmp_path):
    root = tmp_path / "copy"
    shutil.copytree(SAMPLE, root)
    return root


def refusal(capsys, *words):
    assert run(words) == 2
    err = capsys.readouterr().err
    # Progress may stand before the one line.
    assert err.splitlines()[-1].startswith("hvs: ")
    return err.splitlines()[-1]


def contents(root):
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file()
    }


def tar_of(path, members, listed=None):
    """Writes a tar of (name or TarInfo, bytes), under checksums of all or of ``listed``."""
    import hashlib

    names = [(m if isinstance(m, str) else m.name, content) for m, content in members]
    lines = [f"{hashlib.sha256(content).hexdigest()}  {name}" for name, content in names]
    text = "\n".join(lines if listed is None else listed).encode()
    with tarfile.open(path, "w") as tar:
        for member, content in [(CHECKSUMS, text), *members]:
            info = tarfile.TarInfo(member) if isinstance(member, str) else member
            if info.isreg():
                info.size = len(content)
            tar.addfile(info, io.BytesIO(content) if info.isreg() else None)
    return path


def test_card_says_what_a_stranger_needs(copy):
    text = write_card(copy)
    card = (copy / "README.md").read_text()
    assert card.startswith("---\nlicense: apache-2.0\n")
    assert card.endswith(text)
    for words in (
        "`align-thesis`, version 1",
        digest("align-thesis"),
        "5 of 5 (100.0 %)",
        "scripted expert",
        "none: `action` is what was executed",
        "PNG, lossless",
        "`train`, 0 to 4",
        "hvs record --task align-thesis --episodes 5",
        "](pictures.png)",
    ):
        assert words in text
    from PIL import Image

    with Image.open(copy / "pictures.png") as picture:
        assert min(picture.size) > 300


@pytest.mark.parametrize("suffix", [".tar", ".tar.gz"])
def test_what_is_packed_comes_back_the_same(suffix, copy, tmp_path):
    write_card(copy)
    checksum = pack(copy, tmp_path / f"one{suffix}")
    shutil.copytree(copy, tmp_path / "elsewhere")
    assert pack(tmp_path / "elsewhere", tmp_path / f"two{suffix}") == checksum
    assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"two{suffix}").read_bytes()
    unpack(tmp_path / f"one{suffix}", tmp_path / "back", checksum)
    assert contents(tmp_path / "back") == contents(copy)


def test_commands_share_and_fetch(copy, tmp_path, capsys):
    archive = tmp_path / "shared" / "sample.tar"
    assert run(["share", str(copy), "--to-archive", str(archive)]) == 0
    checksum = capsys.readouterr().out.split()[-1]
    words = ["fetch", str(archive), "--out", str(tmp_path / "back"), "--sha256", checksum]
    assert run(words) == 0
    assert "align-thesis, checksums match" in capsys.readouterr().out
    assert (tmp_path / "back" / "README.md").is_file()
    assert "not empty" in refusal(capsys, *words)
    words = ["fetch", str(archive), "--out", str(tmp_path / "new"), "--sha256", "0" * 64]
    assert "checksum" in refusal(capsys, *words)
    assert not (tmp_path / "new").exists()


def test_a_card_shows_what_a_stranger_wrote_and_does_not_obey_it(copy):
    import json

    origin = json.loads((copy / "hvs.json").read_text())
    origin |= {
        "split": "tr`|ain",
        "command": "hvs record\n```\n# <script>\x1b[31m\u202e",
        "options": {"standoff_m": 0.2},
    }
    (copy / "hvs.json").write_text(json.dumps(origin))
    text = write_card(copy)
    [fenced] = [line for line in text.splitlines() if "<script>" in line]
    assert all(character.isprintable() for character in fenced)
    assert "````sh" in text
    assert "| split and scenarios | `tr'\\|ain`, 0 to 4 |" in text
    assert "| options | `standoff_m=0.2` |" in text


@pytest.mark.parametrize("name", ["a\nb", "a\x1b[2J", "a\u202eb", "a/\u200b", "a//b", "./a"])
def test_an_archive_with_a_name_that_misleads_is_refused(name, tmp_path):
    archive = tar_of(tmp_path / "bad.tar", [(name, b"x")])
    with pytest.raises(DatasetError) as refused:
        unpack(archive, tmp_path / "out")
    assert str(refused.value).isprintable()
    assert [p.name for p in tmp_path.iterdir()] == ["bad.tar"]


def test_an_archive_of_no_dataset_is_refused_and_leaves_nothing(tmp_path):
    for number, content in enumerate([b"{", b"[1]", b'{"format": 1, "task": "a\\nb"}']):
        archive = tar_of(tmp_path / f"{number}.tar", [("hvs.json", content)])
        with pytest.raises(DatasetError, match=archive.name):
            unpack(archive, tmp_path / "out")
        assert not (tmp_path / "out").exists()
        archive.unlink()
    assert list(tmp_path.iterdir()) == []


def link(name, target, kind):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


def device(name):
    info = tarfile.TarInfo(name)
    info.type = tarfile.CHRTYPE
    return info


@pytest.mark.parametrize(
    ("members", "reason"),
    [
        ([("../escaped", b"x")], "leads out"),
        ([("a/../../escaped", b"x")], "leads out"),
        ([("/tmp/escaped", b"x")], "leads out"),
        ([("a\\..\\escaped", b"x")], "leads out"),
        ([("C:/escaped", b"x")], "leads out"),
        ([(link("hvs.json", "/etc/passwd", tarfile.SYMTYPE), b"")], "no plain file"),
        ([("a", b"x"), (link("b", "a", tarfile.LNKTYPE), b"")], "no plain file"),
        ([(device("null"), b"")], "no plain file"),
        ([("a", b"x"), ("a", b"x")], "twice"),
    ],
)
def test_an_archive_that_reaches_elsewhere_is_refused_and_leaves_nothing(members, reason, tmp_path):
    archive = tar_of(tmp_path / "bad.tar", members)
    with pytest.raises(DatasetError, match=reason):
        unpack(archive, tmp_path / "deep" / "out")
    assert {p.name for p in tmp_path.rglob("*")} <= {"bad.tar", "deep"}


@pytest.mark.parametrize(
    ("members", "listed", "reason"),
    [
        ([("a", b"x")], [f"{'0' * 64}  a"], "differs from its checksum"),
        ([("a", b"x")], [], "lists not"),
        ([], [f"{'0' * 64}  a"], "lacks a"),
        ([("a", b"x")], ["nonsense"], "malformed"),
    ],
)
def test_an_archive_that_differs_from_its_checksums_is_refused(members, listed, reason, tmp_path):
    archive = tar_of(tmp_path / "bad.tar", members, listed)
    with pytest.raises(DatasetError, match=reason):
        unpack(archive, tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["bad.tar"]


def test_a_cut_or_foreign_archive_is_refused(copy, tmp_path):
    pack(copy, tmp_path / "whole.tar")
    whole = (tmp_path / "whole.tar").read_bytes()
    (tmp_path / "cut.tar").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.tar").write_text("no archive")
    with tarfile.open(tmp_path / "foreign.tar", "w") as tar:
        tar.addfile(tarfile.TarInfo("hvs.json"))
    for name in ("cut", "text", "foreign", "none"):
        with pytest.raises(DatasetError):
            unpack(tmp_path / f"{name}.tar", tmp_path / "out")
        assert not (tmp_path / "out").exists()


def test_a_dataset_with_links_is_not_packed(copy, tmp_path):
    (copy / "link").symlink_to("/etc/passwd")
    with pytest.raises(DatasetError, match="no plain file"):
        pack(copy, tmp_path / "a.tar")
    (copy / "link").unlink()
    with pytest.raises(OutputError, match="inside the dataset"):
        pack(copy, copy / "a.tar")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["{copy}"], "--to-archive"),
        (["{copy}", "--to-archive", "{folder}/a.zip"], ".tar"),
        (["{copy}", "--to-hub", "name"], "user/name"),
        (["{copy}", "--to-archive", "{folder}/a.tar", "--crf", "99"], "crf"),
        (["{copy}", "--to-archive", "{folder}/a.tar", "--licence", "x\ny: z"], "no licence"),
        (["{copy}", "--to-hub", "us\u200fer/name"], "user/name"),
        (["{copy}", "--to-hub", "user/na\nme"], "user/name"),
        (["{folder}/none", "--to-archive", "{folder}/a.tar"], "no dataset"),
        (["{damaged}", "--to-archive", "{folder}/a.tar"], "cannot be read"),
    ],
)
def test_what_cannot_be_shared_is_refused_in_one_line(words, reason, copy, tmp_path, capsys):
    damaged = tmp_path / "damaged"
    shutil.copytree(SAMPLE, damaged)
    (damaged / DATA).write_bytes((damaged / DATA).read_bytes()[:1000])
    places = {"copy": copy, "folder": tmp_path, "damaged": damaged}
    assert reason in refusal(capsys, "share", *(word.format(**places) for word in words))
    assert not (tmp_path / "a.tar").exists()


def test_offline_is_offline(copy, capsys, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert "HF_HUB_OFFLINE" in refusal(capsys, "share", str(copy), "--to-hub", "user/name")
