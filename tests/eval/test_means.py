"""Results of every family are scored, verified and shown alike, each with its own figures."""

import dataclasses
import re
from pathlib import Path

import pytest
from forgeries import with_errors
from test_result_file import make_result

from hvs_suite.errors import ResultError
from hvs_suite.eval import leaderboard, protocol
from hvs_suite.eval.board import means
from hvs_suite.eval.board.markdown import markdown
from hvs_suite.eval.board.page import page
from hvs_suite.eval.board.tables import Entry
from hvs_suite.eval.scoring import comparison, result_file, verification
from hvs_suite.eval.studies import failures
from hvs_suite.registry import find

HEADLINES = {
    "track-line": ["RMS position error (mm)", "p95 (mm)", "time inside (%)", "p95 (%)"],
    "sequence-thesis": ["targets missed", "p95"],
}


@pytest.fixture(scope="module", params=HEADLINES)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made") / "results" / "expert" / f"{request.param}.json"
    protocol.evaluate("expert", request.param, path, episodes=3)
    return path


def test_a_result_of_a_family_is_verified_and_compared(made: Path) -> None:
    result = result_file.load(made)
    task = find(result.summary.task)
    assert list(result.summary.errors) == [metric.name for metric in task.metrics]
    assert result.metadata.tolerances == task.tolerances
    # Without a goal to go on past, where an episode ends is where it is scored.
    assert all(row.settled.errors == row.errors for row in result.episodes)
    verdict = verification.verify(made)
    assert (verdict.n_played, verdict.n_near) == (3, 0)
    assert set(verdict.largest.values()) == {0.0}
    same = comparison.compare(made, made)
    assert list(same.settled) == list(task.headline)
    assert {difference.estimate for difference in same.settled.values()} == {0.0}
    lost = sum(not row.success for row in result.episodes)
    assert len(failures.sort_failures(made).failures) == lost


def test_a_forged_figure_of_a_family_is_found(made: Path, tmp_path: Path) -> None:
    result = result_file.load(made)
    rows = [with_errors(row, 1.5) for row in result.episodes]
    summary = result_file.Summary.of(
        result.summary.task,
        "expert",
        "test",
        rows,
        tolerances=result.metadata.tolerances,
        time_limit_steps=result.metadata.time_limit_steps,
    )
    path = tmp_path / made.name
    result_file.actions_path(path).write_bytes(result_file.actions_path(made).read_bytes())
    result_file.write(result.model_copy(update={"episodes": rows, "summary": summary}), path)
    with pytest.raises(ResultError, match=r"_error_mm is 1\.5, but the logged actions give"):
        verification.verify(path)


def test_a_board_shows_a_family_s_own_columns(made: Path, tmp_path: Path) -> None:
    leaderboard.build(
        made.parents[1], tmp_path, draft=True, replay=1, ledger=tmp_path / "replays.json"
    )
    text = (tmp_path / "LEADERBOARD.md").read_text()
    heads = [line for line in text.splitlines() if line.startswith("| policy | success")]
    titles = [cell.strip() for cell in heads[0].strip("| ").split("|")]
    start = titles.index(HEADLINES[made.stem][0])
    assert titles[start : start + len(HEADLINES[made.stem])] == HEADLINES[made.stem]
    assert not [title for title in titles if title.startswith("settled")]
    html = (tmp_path / "leaderboard.html").read_text()
    # A bound of 0 has no multiples, so there is no curve of them.
    has_curve = all(bound > 0 for bound in find(made.stem).tolerances.values())
    assert ("Success against tolerance" in html) is has_curve
    assert "Where they land" not in html


# --- means over families --------------------------------------------------------------------------


def entry(policy: str, task: str, pc_success: float) -> Entry:
    """A result of ten scenarios with so much success, given the metrics of its task."""
    spec, result = find(task), make_result(10, policy=policy, task=task)
    rows = [
        row.model_copy(
            update={
                "success": won,
                "success_once": won,
                "collision": False,
                "truncated": not won,
                "steps_to_goal": row.steps if won else None,
                "errors": (errors := {metric.name: 1.0 for metric in spec.metrics}),
                "settled": row.settled.model_copy(update={"errors": errors, "collision": False}),
            }
        )
        for row, won in ((row, 10 * row.scenario < pc_success) for row in result.episodes)
    ]
    summary = result_file.Summary.of(
        task,
        policy,
        "test",
        rows,
        tolerances=spec.tolerances,
        time_limit_steps=spec.time_limit_steps,
    )
    bounds = {"tolerances": spec.tolerances, "time_limit_steps": spec.time_limit_steps}
    metadata = result.metadata.model_copy(update=bounds)
    changed = {"episodes": rows, "summary": summary, "metadata": metadata}
    return Entry(policy, result.model_copy(update=changed), 1)


BOARD = [
    ("all-round", "align-easy", 100),
    ("all-round", "align-hard", 60),
    ("all-round", "track-line", 40),
    ("all-round", "sequence-thesis", 0),
    ("aligns", "align-easy", 90),
    ("aligns", "align-hard", 70),
    ("picks", "align-easy", 100),
]


def test_a_mean_is_of_what_there_is_and_says_of_how_much() -> None:
    table = means.standings([entry(*row) for row in BOARD])
    # Of six tasks of align, three of track and two of sequence.
    assert [(row.policy, row.mean.coverage) for row in table] == [
        ("all-round", "4 of 11"),
        ("aligns", "2 of 11"),
        ("picks", "1 of 11"),
    ]
    # (100 + 60) / 2, 40 and 0 over three families; one family; one task.
    assert [row.mean.value for row in table] == pytest.approx([40.0, 80.0, 100.0])
    assert all(row.mean.low <= row.mean.value <= row.mean.high for row in table)
    assert {family: mean.coverage for family, mean in table[0].families.items()} == {
        "align": "2 of 6",
        "sequence": "1 of 2",
        "track": "1 of 3",
    }
    assert list(table[1].families) == ["align"]


def test_a_missing_result_is_shown_as_missing() -> None:
    entries = [entry(*row) for row in BOARD]
    row = next(line for line in markdown(entries).splitlines() if line.startswith("| aligns |"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[2] == "2 of 11"
    assert cells[4].endswith(", 2 of 6 tasks")
    assert cells[5:] == ["–", "–"]
    text = page(entries)
    assert text.count(" no result</span>") >= 2
    assert "2 of 6 tasks" in text


def test_who_was_scored_on_all_tasks_stands_above_who_was_not() -> None:
    whole = [entry("whole", task, 0) for task in ("sequence-thesis", "sequence-hard")]
    entries = [entry("part", "sequence-thesis", 100), *whole]
    parts = means.parted(means.standings(entries))
    assert [[row.policy for row in part] for part in parts] == [["whole"], ["part"]]
    text = page(entries)
    assert re.findall(r"Scored on .* tasks", text) == 2 * [
        "Scored on all 2 tasks",
        "Scored on some of the 2 tasks",
    ]


def test_steps_are_compared_over_families_by_their_geometric_mean() -> None:
    ratios = {"align-easy": 2.0, "align-hard": 8.0, "track-line": 1.0, "sequence-thesis": None}
    entries = [
        dataclasses.replace(entry("a", task, 50), steps_over_expert=ratio)
        for task, ratio in ratios.items()
    ]
    [row] = means.standings(entries)
    # The root of 2 * 8 is 4, the root of 4 * 1 is 2; who solves nothing has nothing to compare.
    assert row.steps_over_expert == pytest.approx(2.0)


def test_each_task_counts_alike_in_its_family_whatever_the_order_of_entries() -> None:
    entries = [entry(*row) for row in BOARD]
    assert [(row.policy, row.mean) for row in means.standings(entries[::-1])] == [
        (row.policy, row.mean) for row in means.standings(entries)
    ]


def test_a_family_shows_its_figures_beside_success() -> None:
    text = page([entry("a", "track-line", 50), entry("a", "align-easy", 50)])
    track = text.partition('id="family-track"')[2].partition("</select>")[0]
    shown = [title.partition("<")[0] for title in re.findall(r"<option[^>]*>(.*)", track)]
    assert shown[:2] == ["success", "collisions"]
    assert {"steps to goal", "RMS position error (mm)", "time inside (%)"} <= set(shown)
    assert not [title for title in shown if "p95" in title]
