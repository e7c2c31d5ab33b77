"""A dataset without its origin gets it back where every episode proves it, and nowhere else."""

import json
import shutil
from pathlib import Path

import pytest

from hvs_suite.cli.main import run

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
ORIGIN = "hvs.json"


def copy_of_sample(place, **changed):
    """The sample, with another origin; without one where nothing is changed."""
    shutil.copytree(SAMPLE, place)
    origin = json.loads((place / ORIGIN).read_text()) | changed
    (place / ORIGIN).write_text(json.dumps(origin))
    if not changed:
        (place / ORIGIN).unlink()
    return place


def test_an_edited_dataset_is_told_how_to_get_its_origin_back(tmp_path, capsys):
    edited = copy_of_sample(tmp_path / "edited")
    for words in (["check"], ["replay", "--episode", "0", "--out", str(tmp_path / "f.gif")]):
        assert run([words[0], str(edited), *words[1:]]) != 0
        said = capsys.readouterr()
        assert f"hvs attach {edited} --origin DIR" in said.out + said.err
    assert run(["attach", str(edited), "--origin", str(SAMPLE)]) == 0
    assert capsys.readouterr().out == f"{edited}: align-thesis, split train\n"
    assert run(["check", str(edited)]) == 0


def test_recordings_that_differ_in_noise_alone_make_one_with_the_larger(tmp_path):
    edited = copy_of_sample(tmp_path / "edited")
    noisy = copy_of_sample(tmp_path / "noisy", noise=0.05, command="hvs record --noise 0.05")
    assert run(["attach", str(edited), "--origin", str(SAMPLE), "--origin", str(noisy)]) == 0
    origin = json.loads((edited / ORIGIN).read_text())
    assert origin["noise"] == 0.05
    assert origin["command"].endswith("; hvs record --noise 0.05")


@pytest.mark.parametrize(
    ("changed", "also", "reason"),
    [
        ({"split": "other"}, [], "is not made of"),
        ({"task": "track-line", "task_digest": ""}, [], "is not made of"),
        ({"split": "other"}, [SAMPLE], "can be of one alone"),
    ],
)
def test_an_origin_that_the_episodes_do_not_prove_is_refused(
    changed, also, reason, tmp_path, capsys
):
    edited = copy_of_sample(tmp_path / "edited")
    origins = [copy_of_sample(tmp_path / "other", **changed), *also]
    words = [word for origin in origins for word in ("--origin", str(origin))]
    assert run(["attach", str(edited), *words]) == 2
    *progress, said = capsys.readouterr().err.splitlines()
    assert said.startswith("hvs: ")
    assert reason in said
    assert all(line.startswith("checking: ") for line in progress)
    assert not (edited / ORIGIN).exists()
