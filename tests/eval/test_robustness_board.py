"""The board shows where policies break, and marks only what the scenes can tell."""

import json
from pathlib import Path

import pytest
from test_leaderboard import made_up

from hvs_suite.errors import ResultError
from hvs_suite.eval.board import robustness
from hvs_suite.eval.board.page import page
from hvs_suite.eval.scoring import robustness_file
from hvs_suite.eval.scoring.robustness_file import Cell, Played, Robustness

UNDISTURBED = 20 * "1"
STRENGTHS = {"mild": UNDISTURBED, "medium": 18 * "1" + 2 * "0", "strong": 4 * "1" + 16 * "0"}


def study(policy: str, *axes: str, task: str = "align-easy") -> Robustness:
    """A study whose strong disturbances lose most scenes."""
    cells = [
        Cell(
            axis=axis,
            title=f"the {axis}",
            strength=strength,
            level=f"{strength} {axis}",
            options={},
            **Played.figures(solved, 0),
            **Cell.paired(solved, UNDISTURBED),
        )
        for axis in axes
        for strength, solved in STRENGTHS.items()
    ]
    return Robustness(
        schema_version=1,
        policy=policy,
        policy_hash=None,
        task=task,
        task_digest="abc",
        suite_version="0.1.0",
        gl_renderer=None,
        split="test",
        episodes=20,
        undisturbed=Played(**Played.figures(UNDISTURBED, 0)),
        cells=cells,
        missing={"depth": "no picture shows it"},
    )


def test_each_axis_stands_against_each_policy_with_all_together_last() -> None:
    [found] = robustness.studies([study("a", "all", "light"), study("b", "light")])
    assert found.policies == ["a", "b"]
    assert found.axes[0].levels == "20 scenes"
    assert [axis.title for axis in found.axes] == ["undisturbed", "the light", "the all", "depth"]
    light = found.axes[1].tiles
    assert [[tile.text for tile in tiles] for tiles in light] == 2 * [["100", "90", "20"]]
    assert [tile.is_significant for tile in light[0]] == [False, False, True]
    assert light[0][2].told.startswith("strong, strong light; 16 scenes lost, 0 won: 20 % (")
    # What b did not play, and what no policy can play, is empty.
    assert [len(tiles) for tiles in found.axes[2].tiles] == [3, 0]
    assert [(policy, a.text, b.text) for policy, a, b in found.worst] == [("a", "100", "20")]


def test_the_page_has_the_section_where_there_are_studies() -> None:
    entries = [made_up("<b>")]
    text = page(entries, studies=[study("<b>", "light", "all")])
    assert 'id="robustness"' in text
    assert "the light<small>mild light · medium light · strong light</small>" in text
    assert "<b>" not in text.partition('id="robustness"')[2].partition("</section>")[0]
    assert 'id="robustness"' not in page(entries)


def test_a_study_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a" / "align-easy.json"
    path.parent.mkdir()
    content = study("a", "light").model_dump(mode="json")
    path.write_text(json.dumps(content))
    assert [found.policy for found in robustness_file.load_all(tmp_path)] == ["a"]
    content["undisturbed"]["n_success"] = 3
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError, match="is not what the scenes give"):
        robustness_file.load_all(tmp_path)
