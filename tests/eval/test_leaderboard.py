"""The board shows every result it is given, always with the same bytes, and refuses bad ones."""

import html.parser
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from forgeries import with_errors
from test_result_file import make_result, of_rows, row

from hvs_suite.errors import OptionError, OutputError, ResultError
from hvs_suite.eval import leaderboard, protocol
from hvs_suite.eval.board import clips, entry_sheet, matrix, plots, replay_check, submission, tables
from hvs_suite.eval.board.markdown import markdown
from hvs_suite.eval.board.page import page
from hvs_suite.eval.board.tables import Entry
from hvs_suite.eval.scoring import result_file, verification

ROOT = Path(__file__).parents[2]
COMMITTED = ROOT / "eval"
BOARD = ("LEADERBOARD.md", "leaderboard.html")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Real results, with their action logs, and the board of them."""
    folder = tmp_path_factory.mktemp("made")
    for policy, task, n in (
        ("expert", "align-fixed", 3),
        ("zero", "align-fixed", 3),
        ("expert", "align-easy", 2),
    ):
        path = folder / "results" / policy / f"{task}.json"
        protocol.evaluate(policy, task, path, episodes=n)
    build(folder, replay=1)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """A copy of them: ``results`` and ``out``."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path


def build(folder: Path, **options: Any) -> tuple[Path, Path]:
    """A draft, since these results are too short for a score."""
    ledger = folder / "cache" / "replays.json"
    options = {"draft": True, "ledger": ledger} | options
    return leaderboard.build(folder / "results", folder / "out", **options)


def content_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def alter(path: Path, split: str = "test", **metadata: Any) -> None:
    """Changes a result and seals it anew."""
    result = result_file.load(path)
    changed = {
        "metadata": result.metadata.model_copy(update=metadata),
        "summary": result.summary.model_copy(update={"split": split}),
    }
    result_file.write(result.model_copy(update=changed), path)


def reel_of(text: str) -> list[str]:
    """The clips of a page."""
    found: list[str] = json.loads(text.partition('id="reel">')[2].partition("</script>")[0])
    return found


def made_up(policy: str, n: int = 5, task: str = "align-easy") -> Entry:
    return Entry(policy, make_result(n, policy=policy, task=task), 2)


def test_markdown_holds_a_row_for_each_result_best_first(made: Path) -> None:
    text = (made / "out" / "LEADERBOARD.md").read_text()
    fixed = text.partition("## align-fixed-v1")[2].partition("## ")[0]
    assert [line.split(" | ")[0] for line in fixed.splitlines() if line.startswith("| ")] == [
        "| policy",
        "| expert",
        "| zero",
    ]
    assert "| expert | 100 % (43.9–100.0 %) | 0 % |" in fixed
    assert fixed.count("| replayed 1 of 3 |") == 2
    # The mean's interval is narrower than either task's; a task left out is a dash, and said so.
    assert re.search(
        r"\| expert \| 100 % \(5\d\.\d–100.0 %\) \| 2 of 6 \| 100 % \(43\.9–100\.0 %\) \|", text
    )
    assert "| zero | 0 % (0.0–56.1 %) | 1 of 6 | 0 % (0.0–56.1 %) | – |" in text


def test_a_rebuild_changes_nothing_and_draws_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = content_of(folder)
    monkeypatch.setattr(clips, "_draw", None)
    monkeypatch.setattr(replay_check.verification, "verify", None)
    build(folder, replay=1)
    assert content_of(folder) == before


def test_clips_show_the_middle_success_and_the_middle_failure() -> None:
    rows = [row(k, success=k != 3 and k < 5, error=float(k)) for k in range(8)]
    result = of_rows(rows)
    assert [(kind, r.scenario) for kind, r in clips.choose(result)] == [
        ("success", 1),
        ("failure", 5),
    ]


def test_each_entry_has_the_clips_it_can_have(made: Path) -> None:
    from PIL import Image

    films = sorted((made / "out" / "clips").rglob("*.avif"))
    assert [path.name.rpartition(".")[0].rpartition(".")[0] for path in films] == [
        "align-easy.success",
        "align-fixed.success",
    ]  # and none of `zero`
    with Image.open(films[0]) as film:
        assert film.size == clips.SIZE
        assert film.n_frames == 21
        # The arm moves: first and last frame are not the same picture.
        first = film.convert("RGB").tobytes()
        film.seek(20)
        assert film.convert("RGB").tobytes() != first
    assert all(path.stat().st_size < 30_000 for path in films)


def test_a_clip_that_belongs_to_no_result_is_removed(folder: Path) -> None:
    (folder / "results" / "expert" / "align-easy.json").unlink()
    build(folder, replay=1)
    [film] = (folder / "out" / "clips").rglob("*.avif")
    assert film.name.startswith("align-fixed.success.")


def test_more_scenarios_are_played_when_more_are_asked_for(folder: Path) -> None:
    said: list[str] = []
    build(folder, replay=2, say=said.append)
    # Both scenarios of align-easy are played now, and two of three of the others.
    assert sum("playing 2 scenarios" in line for line in said) == 3
    text = (folder / "out" / "LEADERBOARD.md").read_text()
    assert "| replayed all 2 |" in text
    said.clear()
    build(folder, replay=1, say=said.append)
    assert said == []


def test_at_least_one_scenario_is_played(folder: Path) -> None:
    with pytest.raises(OptionError, match="at least 1"):
        build(folder, replay=0)


def test_the_page_is_well_formed_and_asks_the_network_for_nothing(made: Path) -> None:
    class Checker(html.parser.HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.open_tags: list[str] = []
            self.identities: list[str] = []

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            given = {name: value or "" for name, value in attrs}
            assert given.get("href", "#").startswith("#")
            assert "src" not in given
            if "id" in given:
                self.identities.append(given["id"])
            if tag not in ("meta", "br", "img", "input"):
                self.open_tags.append(tag)

        def handle_startendtag(self, tag: str, attrs: Any) -> None:
            assert tag in ("rect", "path", "circle")

        def handle_endtag(self, tag: str) -> None:
            assert self.open_tags.pop() == tag

    text = (made / "out" / "leaderboard.html").read_text()
    checker = Checker()
    checker.feed(text)
    assert checker.open_tags == []
    assert len(set(checker.identities)) == len(checker.identities)
    assert not re.search(r"https?:|@import|url\(", text)
    assert len(reel_of(text)) == 2


def test_the_page_says_how_to_submit(made: Path) -> None:
    text = (made / "out" / "leaderboard.html").read_text()
    assert "<h2>Submitting a result</h2>" in text
    assert "hvs verify --submission" in text


def test_the_interval_is_drawn_to_scale() -> None:
    low, high = make_result(4).summary.pc_success_ci95
    assert f'x="{low:.2f}" y="3" width="{high - low:.2f}"' in page([made_up("a", 4)])


def test_a_page_of_six_tasks_and_eight_policies_stays_small() -> None:
    rows = [
        row(
            k % 8,
            success=k % 2 == 0,
            error=1.0 + k % 7,
            settled={"x_mm": k * 0.01, "y_mm": -k * 0.017},
        ).model_copy(update={"scenario": k})
        for k in range(1000)
    ]
    # Clips add 12 kB each, 1.6 MB for two of every entry.
    entries = [
        Entry(
            f"policy-{k}", made_up("p", task=task).result.model_copy(update={"episodes": rows}), 9
        )
        for task in tables.TASKS
        if task.startswith("align-")
        for k in range(8)
    ]
    assert len(page(entries)) < 2_000_000


def test_the_curve_of_tolerance_is_the_rows_own() -> None:
    entry = made_up("a")
    [curve] = plots.tolerance_plot([entry]).curves
    # Four of five settle somewhere; the fifth collided, and no tolerance makes that a success.
    x, y = (float(part) for part in curve.line.split("L")[-1].split())
    assert (x, y) == (346.0, pytest.approx(192 - 0.8 * 182, abs=0.06))


def test_landings_stand_where_the_flange_stood() -> None:
    rows = [
        row(0, success=True, error=1.0, settled={"x_mm": 5.0, "y_mm": 2.5}),
        row(2, success=False, error=9.0, settled={"x_mm": -90.0, "y_mm": 0.0}),
        row(3, success=False, error=9.0, settled={"x_mm": 0.0, "y_mm": -10.0}),
    ]
    picture = plots.landings(rows, 10.0, 5.0)
    assert picture.spots == [("lost", "M100 200h0"), ("hit", "M150 75h0")]
    assert (picture.n_inside, picture.n, picture.goal) == (2, 3, 50.0)


def test_landings_outside_the_picture_are_counted_in_a_sentence_of_its_own() -> None:
    rows = [row(k, success=False, error=5.0, settled={"x_mm": 5.0}) for k in range(20)]
    rows.append(row(20, success=False, error=90.0, settled={"x_mm": 90.0}))
    found = entry_sheet.sheet(Entry("a", of_rows(rows), 1), ()).landings
    assert found is not None
    assert found[1].endswith(
        " The circle is the tolerance, 5 mm. 1 of 21 landings lie outside the picture."
    )
    assert found[1] in page([Entry("a", of_rows(rows), 1)])


@pytest.mark.parametrize(("error", "radius"), [(0.0, 0.001), (0.9, 1), (1.1, 2), (430.0, 500)])
def test_the_landing_picture_has_a_round_size(error: float, radius: float) -> None:
    rows = [row(k, success=False, error=error, settled={"x_mm": error}) for k in range(5)]
    assert plots.landing_radius(rows) == pytest.approx(radius)


def test_the_comparison_is_paired_and_corrected() -> None:
    def entry(policy: str, wins: int) -> Entry:
        rows = [
            row(
                k,
                success=k < wins,
                error=1.0,
                steps=9,
                steps_to_goal=9 if k < wins else None,
                settled={"steps": 9},
                n_clipped=0,
            )
            for k in range(20)
        ]
        return Entry(policy, make_result().model_copy(update={"episodes": rows}), 1)

    entries = [entry("a", 20), entry("b", 11), entry("c", 10)]
    rows = matrix.matrix(entries)
    cells = {(a, p.other): (p.points, p.p, p.decided) for a, row in rows.items() for p in row if p}
    # a against b: nine discordant pairs, p = 2/2^9, times 2 by Holm; b against c: one pair.
    assert cells["a", "b"] == ("+45.0", "p = 0.008", "better")
    assert cells["b", "a"] == ("\N{MINUS SIGN}45.0", "p = 0.008", "worse")
    assert cells["b", "c"] == ("+5.0", "p = 1.00", "even")
    assert [row[k] for k, row in enumerate(rows.values())] == [None, None, None]
    text = page(entries)
    assert 'title="a alone solves 9, b alone 0, both 11, neither 0 of 20"' in text
    assert "+45.0<small>p = 0.008</small>" in text


def test_steps_are_compared_with_the_experts_on_what_both_solve(made: Path) -> None:
    entries = tables.make_entries(submission.check(made / "results", draft=True))
    assert [(e.policy, e.steps_over_expert) for e in entries] == [
        ("expert", 1.0),
        ("expert", 1.0),
        ("zero", None),
    ]


def test_a_hostile_name_stays_text() -> None:
    name = "<b onclick=alert(1)>|\"</script><script>alert('2')</script>{{ 3 * 7 }}"
    entries = [made_up(name), made_up("other")]
    text = page(entries)
    assert "<b onclick" not in text
    assert text.count("<script") == text.count("</script>") == 2
    assert "{{ 3 * 7 }}" in text
    assert "<b" not in markdown(entries)
    assert "(1)&#62;&#124;" in markdown(entries)
    assert "<script" not in markdown(entries)


def test_what_is_not_seen_of_a_name_is_shown() -> None:
    name = "a\u202eb\x1b[31m\n\ud800"
    for text in (page([made_up(name)]), markdown([made_up(name)])):
        assert "\\u202eb\\x1b" in html.unescape(text)
        assert "\u202e" not in text
        assert "\x1b" not in text
        assert text.encode()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (0.0, "0.00"),
        (4e-5, "< 0.001"),
        (0.025, "0.025"),
        (0.25, "0.25"),
        (12.34, "12.3"),
        (390.4, "390"),
    ],
)
def test_figures_keep_the_digits_that_matter(value: float | None, text: str) -> None:
    assert tables.figure(value) == text


def test_no_results_say_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="hvs evaluate"):
        leaderboard.build(tmp_path / "none", tmp_path)


def flattered_summary(results: Path) -> str:
    path = results / "zero" / "align-fixed.json"
    content = json.loads(path.read_text())
    content["summary"]["n_success"] = 3
    path.write_text(json.dumps(content))
    return r"zero/align-fixed\.json: summary\.n_success"


def a_link(results: Path) -> str:
    path = results / "zero" / "align-fixed.json"
    path.rename(results.with_name("elsewhere.json"))
    path.symlink_to(results.with_name("elsewhere.json"))
    return r"zero/align-fixed\.json: is a symbolic link"


def a_linked_folder(results: Path) -> str:
    (results / "zero").rename(results.with_name("elsewhere"))
    (results / "zero").symlink_to(results.with_name("elsewhere"))
    return r"results/zero: is a symbolic link"


def a_pipe(results: Path) -> str:
    path = results / "zero" / "align-fixed.json"
    path.unlink()
    os.mkfifo(path)
    return "is no regular file"


def a_name_with_escapes(results: Path) -> str:
    (results / "zero").rename(results / "ze\x1b[31mro")
    return r"the folder's name .* holds U\+001B"


def a_policy_with_line_breaks(results: Path) -> str:
    path = results / "zero" / "align-fixed.json"
    result = result_file.load(path)
    summary = result.summary.model_copy(update={"policy": "zero\n| fake |"})
    result_file.write(result.model_copy(update={"summary": summary}), path)
    return r"summary\.policy .* holds U\+000A"


def not_json(results: Path) -> str:
    (results / "zero" / "align-fixed.json").write_text("{")
    return "is not JSON"


def another_version(results: Path) -> str:
    alter(results / "zero" / "align-fixed.json", task_version=2)
    return "task_version is 2, but 1 for align-fixed"


def another_digest(results: Path) -> str:
    alter(results / "zero" / "align-fixed.json", task_digest="other")
    return "task_digest is other"


def another_split(results: Path) -> str:
    alter(results / "zero" / "align-fixed.json", split="train")
    return "split is 'train'|split is 'test'"


def changed_task(results: Path) -> str:
    alter(results / "zero" / "align-fixed.json", options={"hold_steps": 2})
    return r"task was changed \(hold_steps=2\)"


def duplicate(results: Path) -> str:
    shutil.copytree(results / "expert", results / "mine")
    return r"duplicate of .*expert"


def stolen_actions(results: Path) -> str:
    shutil.copytree(results / "expert", results / "mine")
    for path in (results / "mine").glob("*.json"):
        alter(path, policy_hash="mine")
    return r"duplicate of .*expert"


def another_name(results: Path) -> str:
    path = results / "zero" / "align-fixed.json"
    path.rename(path.with_name("align-hard.json"))
    return "name it align-fixed.json"


def too_high(results: Path) -> str:
    shutil.copy(results / "zero" / "align-fixed.json", results / "align-fixed.json")
    return "results lie as"


def no_log(results: Path) -> str:
    (results / "zero" / "align-fixed.actions.npz").unlink()
    return "the action log belongs beside its result"


def another_log(results: Path) -> str:
    name = "align-fixed.actions.npz"
    shutil.copy(results / "expert" / name, results / "zero" / name)
    return "is not the action log"


def flattered_row(results: Path) -> str:
    """A row, summary and seal that agree with each other, and not with the actions."""
    path = results / "zero" / "align-fixed.json"
    result = result_file.load(path)
    rows = [with_errors(r, 1.0) for r in result.episodes]
    summary = result_file.Summary.of(
        "align-fixed",
        "zero",
        "test",
        rows,
        tolerances=result.metadata.tolerances,
        time_limit_steps=result.metadata.time_limit_steps,
    )
    result_file.write(result.model_copy(update={"episodes": rows, "summary": summary}), path)
    return r"position_error_mm is 1\.0, but the logged actions give"


@pytest.mark.parametrize(
    "spoil",
    [
        flattered_summary,
        a_link,
        a_linked_folder,
        a_pipe,
        a_name_with_escapes,
        a_policy_with_line_breaks,
        not_json,
        another_version,
        another_digest,
        another_split,
        changed_task,
        duplicate,
        stolen_actions,
        another_name,
        too_high,
        no_log,
        another_log,
        flattered_row,
    ],
)
def test_one_bad_result_stops_the_build_and_leaves_the_old_board(spoil: Any, folder: Path) -> None:
    before = content_of(folder / "out")
    reason = spoil(folder / "results")
    with pytest.raises(ResultError, match=reason) as caught:
        build(folder)
    assert "\n" not in str(caught.value)
    assert content_of(folder / "out") == before


def test_a_broken_ledger_says_so(folder: Path) -> None:
    (folder / "cache" / "replays.json").write_text('{"expert/align-easy": {"n_played": -1}}')
    with pytest.raises(ResultError, match="delete it"):
        build(folder)


def test_a_ledger_does_not_lie_among_what_is_submitted(folder: Path) -> None:
    with pytest.raises(OptionError, match="lies among the results"):
        build(folder, ledger=folder / "results" / "zero" / "replays.txt")


def test_what_was_played_is_remembered_by_content_not_by_name(folder: Path) -> None:
    said: list[str] = []
    path = folder / "results" / "zero" / "align-fixed.json"
    (folder / "results" / "zero").rename(folder / "results" / "nothing")
    alter(folder / "results" / "expert" / "align-fixed.json", cpu="another")
    build(folder, replay=1, say=said.append)
    assert [line for line in said if "playing" in line] == [said[0]]
    assert "expert/align-fixed" in said[0]
    assert not path.exists()


def test_three_scenarios_are_a_draft_and_no_score(folder: Path) -> None:
    texts = [(folder / "out" / name).read_text() for name in ("LEADERBOARD.md", "leaderboard.html")]
    assert all("This is a draft" in text for text in texts)
    with pytest.raises(ResultError, match="holds 2 scenarios; a score of align-easy takes 1000"):
        build(folder, draft=False)


@pytest.mark.parametrize("where", ["clips", "clips/x"])
def test_nothing_is_removed_through_a_link(where: str, folder: Path) -> None:
    elsewhere = folder / "elsewhere"
    (elsewhere / "y").mkdir(parents=True)
    kept = [elsewhere / "film.avif", elsewhere / "y" / "film.avif"]
    for path in kept:
        path.write_bytes(b"kept")
    shutil.rmtree(folder / "out" / "clips")
    (folder / "out" / where).parent.mkdir(exist_ok=True)
    (folder / "out" / where).symlink_to(elsewhere)
    with pytest.raises(OutputError, match="is a symbolic link"):
        build(folder, replay=1)
    assert all(path.read_bytes() == b"kept" for path in kept)


@pytest.mark.parametrize("spoil", [os.mkfifo, lambda path: path.write_bytes(bytes(2**18 + 1))])
def test_a_clip_that_is_no_clip_is_not_read(spoil: Any, folder: Path) -> None:
    path = min((folder / "out" / "clips").rglob("*.avif"))
    path.unlink()
    spoil(path)
    with pytest.raises(ResultError, match=r"no regular file|at most"):
        build(folder, replay=1)


# --- re-runs by the maintainers -------------------------------------------------------------------


def rerun(folder: Path, policy: str, **options: Any) -> Path:
    path = folder / "reruns" / policy / "align-fixed.json"
    options = {"split": "unseen", "episodes": 5} | options
    protocol.evaluate(options.pop("by", policy), "align-fixed", path, **options)
    return path


def test_a_rerun_on_an_unseen_split_is_another_badge(folder: Path) -> None:
    rerun(folder, "zero")
    build(folder, replay=1, reruns=folder / "reruns")
    markdown, page = ((folder / "out" / name).read_text() for name in sorted(BOARD))
    assert "| replayed 1 of 3, re-run: 0 of 5 solved |" in markdown
    assert markdown.count("re-run: ") == 1
    assert 'title="Re-run: the maintainers ran the policy itself' in page
    assert 'title="Replayed: the logged actions give these numbers."' in page


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"split": "test"}, "take an unseen split"),
        ({"by": "expert"}, "claims a success of 0.0 to 56.1 %, but the policy itself reached 56.6"),
    ],
)
def test_a_rerun_that_tells_otherwise_stops_the_build(
    options: dict[str, Any], reason: str, folder: Path
) -> None:
    rerun(folder, "zero", **options)
    with pytest.raises(ResultError, match=reason):
        build(folder, replay=1, reruns=folder / "reruns")


def test_a_rerun_of_other_weights_stops_the_build(folder: Path) -> None:
    alter(rerun(folder, "zero"), split="unseen", policy_hash="other")
    with pytest.raises(ResultError, match="policy_hash is other"):
        build(folder, replay=1, reruns=folder / "reruns")


def test_a_board_cannot_be_written_below_a_file(folder: Path) -> None:
    (folder / "file").write_text("")
    with pytest.raises(OutputError):
        leaderboard.build(folder / "results", folder / "file", draft=True)


def test_it_runs_as_a_script(folder: Path) -> None:
    before = content_of(folder)
    script = [sys.executable, "eval/leaderboard.py"]
    words = ["--results", folder / "results", "--out", folder / "out", "--replay", "1", "--draft"]
    words += ["--ledger", folder / "cache" / "replays.json"]
    done = subprocess.run([*script, *words], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        str(folder / "out" / "LEADERBOARD.md"),
        str(folder / "out" / "leaderboard.html"),
    ]
    assert content_of(folder) == before


def test_the_script_says_in_one_line_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert leaderboard.main(["--results", str(tmp_path / "none")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.skipif(not (COMMITTED / "LEADERBOARD.md").exists(), reason="no board is committed yet")
def test_the_committed_board_is_what_the_committed_results_give(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (*BOARD, "clips"):
        source = COMMITTED / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    before = content_of(tmp_path)
    said: list[str] = []
    ledger = tmp_path.with_name("replays.json")
    # They are played again one by one in test_submission; here it is what is drawn of them.
    monkeypatch.setattr(
        replay_check.verification, "verify", lambda path, *, sample, nonce: played_well(path)
    )
    leaderboard.build(COMMITTED / "results", tmp_path, ledger=ledger, say=said.append)
    # No clip was missing either: they are committed with the board.
    assert not any("drawing" in line for line in said)
    assert content_of(tmp_path) == before


def played_well(path: Path) -> verification.Verdict:
    n = result_file.load(path).summary.n_episodes
    return verification.Verdict(n, min(n, replay_check.SAMPLE), 0, 0, None, {})
