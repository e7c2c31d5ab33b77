"""A result file says what happened, and one that cannot be true is refused with the reason."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from hvs_suite.errors import OutputError, ResultError
from hvs_suite.eval import result_file

TOLERANCES = {"position_error_mm": 5.0, "tilt_error_deg": 5.0}


def row(scenario: int, *, success: bool, error: float, **changes: Any) -> result_file.EpisodeRow:
    steps = 10 + scenario
    settled = error / 10 if success else error
    values: dict[str, Any] = {
        "scenario": scenario,
        "success": success,
        "success_once": success,
        "collision": not success and scenario % 2 == 1,
        "truncated": not success and scenario % 2 == 0,
        "steps": steps,
        "steps_to_goal": steps if success else None,
        "n_clipped": scenario,
        "position_error_mm": error,
        "lateral_error_mm": error,
        "height_error_mm": 0.0,
        "tilt_error_deg": 2 * error,
        "failure": None,
        "settled_steps": 20 if success else steps,
        "settled_collision": not success and scenario % 2 == 1,
        "settled_failure": None,
        "settled_position_error_mm": settled,
        "settled_lateral_error_mm": settled,
        "settled_height_error_mm": 0.0,
        "settled_tilt_error_deg": 2 * settled,
        "settled_x_mm": settled,
        "settled_y_mm": 0.0,
    }
    return result_file.EpisodeRow(**(values | changes))


def make_result(n: int = 5, **summary: Any) -> result_file.Result:
    rows = [row(i, success=i < 3, error=float(i) / 3) for i in range(n)]
    names = {"task": "align-easy", "policy": "zero", "split": "test"} | summary
    return result_file.Result(
        schema_version=result_file.SCHEMA_VERSION,
        summary=result_file.Summary.of(
            **names, rows=rows, tolerances=TOLERANCES, time_limit_steps=20
        ),
        metadata=result_file.Metadata(
            created="2026-01-01T00:00:00+00:00",
            suite_version="0.1.0",
            task_version=1,
            task_digest="abc",
            tolerances=TOLERANCES,
            time_limit_steps=20,
            options={},
            policy_kind="builtin",
            policy_hash=None,
            policy_parameters=None,
            training_steps=None,
            training_hours=None,
            decision_limit_s=10.0,
            actions_sha256=64 * "0",
            packages={"numpy": "2.2.6"},
            gl_renderer="llvmpipe",
            cpu="a processor",
            platform="Linux-x86_64",
        ),
        timings=result_file.Timings(
            workers=1, wall_s=1.0, steps_per_s=50.0, decision_ms=0.1, decision_ms_max=0.2
        ),
        episodes=rows,
    )


def test_the_summary_counts_what_the_rows_say() -> None:
    summary = make_result().summary
    assert (summary.n_episodes, summary.n_success, summary.pc_success) == (5, 3, 60.0)
    assert summary.pc_success_ci95 == pytest.approx([23.07, 88.24], abs=0.01)
    assert (summary.n_collision, summary.n_clipped) == (1, 10)
    assert summary.steps_to_goal_mean == 11.0
    assert summary.position_error_mm.p50 == pytest.approx(2 / 3)
    assert summary.position_error_mm.p95 == pytest.approx(3.8 / 3)
    assert summary.position_error_mm.iqm == pytest.approx(2 / 3)
    assert summary.tilt_error_deg.p50 == pytest.approx(4 / 3)


def test_the_settled_figures_are_those_past_the_goal() -> None:
    summary = make_result().summary
    assert summary.settled_position_error_mm.p50 == pytest.approx(0.2 / 3)
    assert summary.settled_position_error_mm.p99 > 1.0
    low, high = summary.settled_position_error_mm.iqm_ci95
    assert low <= summary.settled_position_error_mm.iqm <= high
    # The fourth episode collided: no tolerance makes that a success.
    assert summary.settled_n_lost == 1
    assert summary.settled_success_by_scale.pc_success[-1] == 80.0
    assert summary.settled_sharpest_95.scale is None


def test_success_against_steps_ends_at_the_success_rate() -> None:
    curve = make_result().summary.success_by_step
    assert curve[8:13] == [0.0, 20.0, 40.0, 60.0, 60.0]
    assert len(curve) == 20


def test_the_reasons_of_lost_episodes_are_counted() -> None:
    lost = {"truncated": False, "failure": "not finite", "settled_failure": "not finite"}
    rows = [row(0, success=False, error=1.0, **lost), row(2, success=False, error=1.0)]
    summary = result_file.Summary.of(
        "t", "p", "test", rows, tolerances=TOLERANCES, time_limit_steps=20
    )
    assert (summary.n_failure, summary.failures) == (1, {"not finite": 1})
    assert summary.steps_to_goal_mean is None


def test_a_written_result_reads_back_the_same(tmp_path: Path) -> None:
    path = tmp_path / "zero" / "align-easy.json"
    result_file.write(make_result(), path)
    assert result_file.load(path) == make_result()
    assert [file.name for file in path.parent.iterdir()] == ["align-easy.json"]


def test_each_row_stands_on_its_own_line_with_the_fixed_keys(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    result_file.write(make_result(), path)
    content = json.loads(path.read_text())
    keys = "scenario success success_once collision truncated steps steps_to_goal n_clipped"
    fixed = [*keys.split(), *result_file.ERRORS]
    assert list(content["episodes"][0])[: len(fixed)] == fixed
    lines = path.read_text().splitlines()
    assert json.dumps(content["episodes"][1]) + "," in [line.strip() for line in lines]


def test_a_result_cannot_be_written_below_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        result_file.write(make_result(), tmp_path / "file" / "result.json")


BROKEN: dict[str, tuple[Any, str]] = {
    "missing block": (lambda c: c.pop("metadata"), "metadata: Field required"),
    "unknown key": (lambda c: c["summary"].update(extra=1), "summary.extra"),
    "other schema": (lambda c: c.update(schema_version=99), "schema_version is 99"),
    "no schema": (lambda c: c.pop("schema_version"), "schema_version is None"),
    "no rows": (lambda c: c.update(episodes=[]), "episodes"),
    "text for a number": (lambda c: c["episodes"][0].update(steps="10"), "episodes.0.steps"),
    "a negative error": (
        lambda c: c["episodes"][0].update(tilt_error_deg=-1.0),
        "episodes.0.tilt_error_deg",
    ),
    "an infinite error": (
        lambda c: c["episodes"][0].update(tilt_error_deg=float("inf")),
        "Infinity is no number",
    ),
    "a scenario twice": (
        lambda c: c["episodes"].insert(1, copy.deepcopy(c["episodes"][0])),
        "scenario 0 appears more than once",
    ),
    "a scenario left out": (lambda c: c["episodes"].pop(3), "scenarios 0..N-1"),
    "another order": (lambda c: c["episodes"].reverse(), "in this order"),
    "a success without its steps": (
        lambda c: c["episodes"][0].update(steps_to_goal=None),
        "steps_to_goal must equal",
    ),
    "two ends": (
        lambda c: c["episodes"][0].update(collision=True),
        "an episode has one end",
    ),
    "a flattered summary": (
        lambda c: c["summary"].update(pc_success=100.0),
        "summary.pc_success is not what the episodes give",
    ),
    "a flattered error": (
        lambda c: c["summary"]["tilt_error_deg"].update(p95=0.0),
        "summary.tilt_error_deg is not",
    ),
    "a settled figure that is not the episode's": (
        lambda c: c["episodes"][4].update(position_error_mm=0.0),
        "settled figures must be the episode's own",
    ),
    "another version of a package": (
        lambda c: c["metadata"]["packages"].update(numpy="9"),
        "was changed after it was written",
    ),
    "no seal": (lambda c: c.pop("sha256"), "was changed after it was written"),
    "a bound on nothing": (
        lambda c: c["metadata"].update(tolerances={"yaw": 1.0}),
        "tolerances.yaw",
    ),
    "a flattered row": (
        lambda c: c["episodes"][2].update(position_error_mm=0.0),
        "summary.position_error_mm is not",
    ),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_file_that_cannot_be_true_is_refused(how: str, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    result_file.write(make_result(), path)
    content = json.loads(path.read_text())
    tamper, reason = BROKEN[how]
    tamper(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError) as caught:
        result_file.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", ["", "[1, 2", "[]", "null", "\xff"])
def test_what_is_no_result_is_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(content, encoding="latin-1")
    with pytest.raises(ResultError, match=r"result\.json"):
        result_file.load(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="cannot be read"):
        result_file.load(tmp_path / "none.json")
