"""The board shows every result it is given, always with the same bytes, and refuses bad ones."""

import html.parser
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from test_result_file import make_result

from hvs_suite.errors import OutputError, ResultError
from hvs_suite.eval import board_tables, leaderboard, result_file

ROOT = Path(__file__).parents[2]


def add(folder: Path, policy: str, task: str, n: int = 5, **metadata: Any) -> Path:
    result = make_result(n, policy=metadata.pop("spec", policy), task=task)
    split = metadata.pop("split", "test")
    result = result.model_copy(
        update={
            "metadata": result.metadata.model_copy(update=metadata),
            "summary": result.summary.model_copy(update={"split": split}),
        }
    )
    path = folder / policy / f"{task}.json"
    result_file.write(result, path)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "results"
    add(folder, "zero", "align-easy", n=9)
    add(folder, "expert", "align-easy", n=3)
    add(folder, "expert", "align-thesis", n=4)
    return folder


def test_markdown_holds_a_row_for_each_result_best_first(folder: Path, tmp_path: Path) -> None:
    board, _ = leaderboard.build(folder, tmp_path / "out")
    text = board.read_text()
    easy = text.partition("## align-easy-v1")[2].partition("## ")[0]
    assert [line.split(" | ")[0] for line in easy.splitlines() if line.startswith("| ")] == [
        "| policy",
        "| expert",
        "| zero",
    ]
    assert "| expert | 100 % | 43.9–100.0 % | 0 % |" in easy
    assert "| expert | 100 % (43.9–100.0 %) | 75 % (30.1–95.4 %) |" in text
    assert "| zero | 33.3 % (12.1–64.6 %) | – |" in text


def test_equal_results_give_equal_bytes(folder: Path, tmp_path: Path) -> None:
    first = [path.read_bytes() for path in leaderboard.build(folder, tmp_path / "one")]
    second = [path.read_bytes() for path in leaderboard.build(folder, tmp_path / "two")]
    assert first == second


def test_the_page_is_well_formed_and_asks_the_network_for_nothing(
    folder: Path, tmp_path: Path
) -> None:
    class Checker(html.parser.HTMLParser):
        open_tags: list[str] = []  # noqa: RUF012

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            assert not {"src", "href"} & {name for name, _ in attrs}
            if tag not in ("meta", "br"):
                self.open_tags.append(tag)

        def handle_startendtag(self, tag: str, attrs: Any) -> None:
            assert tag == "rect"

        def handle_endtag(self, tag: str) -> None:
            assert self.open_tags.pop() == tag

    _, page = leaderboard.build(folder, tmp_path)
    checker = Checker()
    checker.feed(page.read_text())
    assert checker.open_tags == []
    assert not re.search(r"https?:|@import|url\(", page.read_text())


def test_the_interval_is_drawn_to_scale(folder: Path, tmp_path: Path) -> None:
    _, page = leaderboard.build(folder, tmp_path)
    low, high = make_result(4).summary.pc_success_ci95
    assert f'x="{low:.2f}" y="3" width="{high - low:.2f}"' in page.read_text()


def test_a_hostile_name_stays_text(tmp_path: Path) -> None:
    name = "<img onerror=alert(1)>|"
    add(tmp_path / "results", name, "align-easy")
    board, page = leaderboard.build(tmp_path / "results", tmp_path)
    assert "<img" not in page.read_text()
    assert "<img" not in board.read_text()
    assert "(1)&#62;&#124; |" in board.read_text()


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0.00"), (4e-5, "< 0.01"), (0.25, "0.25"), (12.34, "12.3"), (390.4, "390")],
)
def test_figures_keep_the_digits_that_matter(value: float | None, text: str) -> None:
    assert board_tables.figure(value) == text


def test_no_results_say_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="hvs evaluate"):
        leaderboard.build(tmp_path / "none", tmp_path)


def test_one_bad_result_stops_the_build_and_leaves_the_old_board(
    folder: Path, tmp_path: Path
) -> None:
    board, page = leaderboard.build(folder, tmp_path / "out")
    before = board.read_bytes(), page.read_bytes()
    path = add(folder, "servo", "align-easy")
    content = json.loads(path.read_text())
    content["summary"]["n_success"] = 5
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError, match=r"servo/align-easy\.json: summary\.n_success"):
        leaderboard.build(folder, tmp_path / "out")
    assert (board.read_bytes(), page.read_bytes()) == before


@pytest.mark.parametrize(
    ("metadata", "reason"),
    [
        ({"task_version": 2}, "align-easy-v2, but this hvs_suite has v1"),
        ({"task_digest": "other"}, "task_digest is"),
        ({"split": "train"}, "split is"),
        ({"options": {"hold_steps": 1}}, r"task was changed \(hold_steps\)"),
        ({"spec": "zero"}, "duplicate of .*align-easy.json"),
    ],
)
def test_results_that_do_not_compare_are_refused(
    metadata: dict[str, Any], reason: str, folder: Path, tmp_path: Path
) -> None:
    add(folder, "other", "align-easy", **metadata)
    with pytest.raises(ResultError, match=reason):
        leaderboard.build(folder, tmp_path / "out")


def test_two_checkpoints_from_folders_of_one_name_are_no_duplicates(
    folder: Path, tmp_path: Path
) -> None:
    add(folder, "first", "align-easy", spec="policy", policy_hash="a")
    add(folder, "second", "align-easy", spec="policy", policy_hash="b")
    leaderboard.build(folder, tmp_path / "out")


def test_a_result_in_the_wrong_place_is_refused(folder: Path, tmp_path: Path) -> None:
    path = folder / "zero" / "align-easy.json"
    path.rename(path.with_name("align-hard.json"))
    with pytest.raises(ResultError, match="named after one task"):
        leaderboard.build(folder, tmp_path)
    path.with_name("align-hard.json").rename(folder / "align-easy.json")
    with pytest.raises(ResultError, match="results lie as"):
        leaderboard.build(folder, tmp_path)


def test_a_board_cannot_be_written_below_a_file(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        leaderboard.build(folder, tmp_path / "file")


def test_it_runs_as_a_script(folder: Path, tmp_path: Path) -> None:
    script = [sys.executable, "eval/leaderboard.py"]
    done = subprocess.run(
        [*script, "--results", folder, "--out", tmp_path / "out"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines() == [
        str(tmp_path / "out" / "LEADERBOARD.md"),
        str(tmp_path / "out" / "leaderboard.html"),
    ]
    failed = subprocess.run(
        [*script, "--results", tmp_path / "none"], cwd=ROOT, capture_output=True, text=True
    )
    assert failed.returncode == 2
    assert len(failed.stderr.splitlines()) == 1
