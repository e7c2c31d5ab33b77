"""Every named task goes the whole way of a dataset: recorded, checked, filmed, shared, fetched."""

import json
import shlex
from pathlib import Path

import imageio.v3 as iio
import pytest

from hvs_suite.cli.main import run

RECIPES = Path(__file__).parents[2] / "datasets" / "recipes"


@pytest.mark.each_task
def test_two_episodes_of_the_recipe_are_recorded_checked_filmed_and_shared(task, tmp_path, capsys):
    data, film, archive, copy = (
        str(tmp_path / name) for name in ("data", "a.mp4", "a.tar", "copy")
    )
    recipe = json.loads((RECIPES / f"{task}.json").read_text())
    hvs, *words = shlex.split(recipe["command"])
    assert hvs == "hvs"
    # Of options that are given twice the last one counts.
    assert run([*words, "--episodes", "2", "--workers", "1", "--out", data]) == 0
    said = capsys.readouterr().out
    assert "2 episodes, " in said
    # The recipe's noise may cost one of them, which is kept and marked.
    assert ", 0 of them solved" not in said
    assert run(["check", data]) == 0
    assert "no damage" in capsys.readouterr().out
    assert run(["replay", data, "--episode", "1", "--out", film]) == 0
    frames = iio.imread(film, plugin="pyav")
    assert len(frames) > 2
    assert frames.std() > 10.0
    assert run(["share", data, "--to-archive", archive]) == 0
    assert f"`{task}`" in Path(data, "README.md").read_text()
    assert run(["fetch", archive, "--out", copy]) == 0
    assert run(["check", copy]) == 0
