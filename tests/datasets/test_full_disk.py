"""A disk that fills up: one line, nothing half, nothing lost that was finished, and a way on."""

import contextlib
import resource
import shutil
from pathlib import Path

import pytest

from hvs_suite.cli.main import run
from hvs_suite.datasets.archive import pack
from hvs_suite.datasets.recorder import record
from hvs_suite.errors import OutputError

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
TASK, N, BLOCK = "align-fixed", 5, 2
# Bytes a file may have: metadata fit, a block does not; the card's picture fits, all data do not.
BLOCK_LIMIT, DATA_LIMIT = 20_000, 300_000


@contextlib.contextmanager
def room(limit):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def contents(root):
    return {p.relative_to(root): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def refusal(capsys, *words):
    assert run(words) == 2
    # Progress may stand before the one line.
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("hvs: cannot ")
    return line


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    root = tmp_path_factory.mktemp("recorded") / "whole"
    record(TASK, N, "train", root, block=BLOCK)
    return contents(root)


@pytest.mark.parametrize("interrupted", [False, True], ids=["full", "interrupted when full"])
def test_a_recording_keeps_what_is_finished_and_goes_on_to_the_same_bytes(
    interrupted, undisturbed, tmp_path
):
    root = tmp_path / "dataset"
    with contextlib.ExitStack() as stack:

        def fill(state):
            if state.episodes == BLOCK + 1:
                stack.enter_context(room(BLOCK_LIMIT))
                if interrupted:
                    raise KeyboardInterrupt

        with pytest.raises(OutputError, match=f"{BLOCK} of {N} episodes are saved.*--resume"):
            record(TASK, N, "train", root, block=BLOCK, progress=fill)
    assert not any(path.name.startswith(".") for path in root.iterdir())
    record(TASK, N, "train", root, block=BLOCK, resume=True)
    assert contents(root) == undisturbed


def test_a_recording_without_any_room_leaves_nothing_in_the_way_of_the_next(tmp_path, capsys):
    root = tmp_path / "new" / "dataset"
    words = ["record", "--task", TASK, "--episodes", "2", "--out", str(root)]
    for limit in (0, BLOCK_LIMIT):
        with room(limit):
            assert str(root) in refusal(capsys, *words)
        assert list(tmp_path.rglob("*")) == []
    assert run(words) == 0


def test_an_archive_is_whole_or_not_there(tmp_path, capsys):
    root = tmp_path / "dataset"
    shutil.copytree(SAMPLE, root)
    archive = tmp_path / "shared" / "sample.tar"
    words = ["share", str(root), "--to-archive", str(archive)]
    with room(DATA_LIMIT):
        assert str(archive) in refusal(capsys, *words)
    assert list(archive.parent.iterdir()) == []
    assert run(words) == 0


def test_what_is_fetched_is_whole_or_not_there(tmp_path, capsys):
    archive, out = tmp_path / "sample.tar.gz", tmp_path / "out"
    pack(SAMPLE, archive)
    words = ["fetch", str(archive), "--out", str(out)]
    with room(DATA_LIMIT):
        assert str(archive) in refusal(capsys, *words)
    assert [path.name for path in tmp_path.iterdir()] == [archive.name]
    assert run(words) == 0
    assert contents(out) == contents(SAMPLE)
