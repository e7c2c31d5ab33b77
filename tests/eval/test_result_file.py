"""A result file says what happened, and one that cannot be true is refused with the reason."""

import json
from pathlib import Path
from typing import Any

import pytest
from columns import put_rows, rows_of

from hvs_suite.errors import OutputError, ResultError
from hvs_suite.eval import result_file

TOLERANCES = {"position_error_mm": 5.0, "tilt_error_deg": 5.0}


METRICS = ("position_error_mm", "lateral_error_mm", "height_error_mm", "tilt_error_deg")


def row(scenario: int, *, success: bool, error: float, **changes: Any) -> result_file.EpisodeRow:
    """A row; ``settled_<name>`` changes what is settled."""
    steps = 10 + scenario
    settled = error / 10 if success else error
    settled_changes = {
        name.removeprefix("settled_"): changes.pop(name)
        for name in list(changes)
        if name.startswith("settled_")
    }
    values: dict[str, Any] = {
        "scenario": scenario,
        "success": success,
        "success_once": success,
        "collision": not success and scenario % 2 == 1,
        "truncated": not success and scenario % 2 == 0,
        "steps": steps,
        "steps_to_goal": steps if success else None,
        "n_clipped": scenario,
        "failure": None,
        "errors": errors(error),
        "settled": {
            "steps": 20 if success else steps,
            "collision": not success and scenario % 2 == 1,
            "failure": None,
            "errors": errors(settled),
            "x_mm": settled,
            "y_mm": 0.0,
        }
        | settled_changes,
    }
    return result_file.EpisodeRow.model_validate(values | changes)


def errors(error: float) -> dict[str, float]:
    return dict(zip(METRICS, (error, error, 0.0, 2 * error), strict=True))


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
            n_logged=n,
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
    assert summary.errors["position_error_mm"].p50 == pytest.approx(2 / 3)
    assert summary.errors["position_error_mm"].p95 == pytest.approx(3.8 / 3)
    assert summary.errors["position_error_mm"].iqm == pytest.approx(2 / 3)
    assert summary.errors["tilt_error_deg"].p50 == pytest.approx(4 / 3)


def test_the_settled_figures_are_those_past_the_goal() -> None:
    summary = make_result().summary
    assert summary.settled.errors["position_error_mm"].p50 == pytest.approx(0.2 / 3)
    assert summary.settled.errors["position_error_mm"].p99 > 1.0
    low, high = summary.settled.errors["position_error_mm"].iqm_ci95
    assert low <= summary.settled.errors["position_error_mm"].iqm <= high
    # The fourth episode collided: no tolerance makes that a success.
    assert summary.settled.n_lost == 1
    assert summary.settled.success_by_scale is not None
    assert summary.settled.success_by_scale.pc_success[-1] == 80.0
    assert summary.settled.sharpest_95.scale is None


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


def test_each_column_stands_on_its_own_line_and_repeats_nothing(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    result_file.write(make_result(), path)
    columns = json.loads(path.read_text())["episodes"]
    assert columns["success"] == [True, True, True, False, False]
    assert columns["failure"] is None
    assert columns["errors"]["height_error_mm"] == 0.0
    assert "scenario" not in columns
    assert "failure" not in columns["settled"]
    lines = [line.strip() for line in path.read_text().splitlines()]
    assert '"steps": [10,11,12,13,14],' in lines


def test_a_task_with_a_tolerance_of_zero_has_no_curve() -> None:
    rows = [row(0, success=True, error=0.0)]
    summary = result_file.Summary.of(
        "t", "p", "test", rows, tolerances={"tilt_error_deg": 0.0}, time_limit_steps=20
    )
    assert summary.settled.success_by_scale is None
    assert summary.settled.sharpest_95.scale is None


def test_a_result_cannot_be_written_below_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        result_file.write(make_result(), tmp_path / "file" / "result.json")


def in_row(index: int, **changes: Any) -> Any:
    """Changes a row of a file."""

    def tamper(content: Any) -> None:
        rows = rows_of(content)
        for name, value in changes.items():
            if isinstance(value, dict):
                rows[index][name] |= value
            else:
                rows[index][name] = value
        put_rows(content, rows)

    return tamper


BROKEN: dict[str, tuple[Any, str]] = {
    "missing block": (lambda c: c.pop("metadata"), "metadata: Field required"),
    "unknown key": (lambda c: c["summary"].update(extra=1), "summary.extra"),
    "other schema": (lambda c: c.update(schema_version=99), "schema_version is 99"),
    "no schema": (lambda c: c.pop("schema_version"), "schema_version is None"),
    "rows for columns": (lambda c: c.update(episodes=[]), "holds no columns of episodes"),
    "no rows": (lambda c: c["summary"].update(n_episodes=0), "holds no columns of episodes"),
    "a billion rows": (
        lambda c: c["summary"].update(n_episodes=10**9),
        "holds no columns of episodes",
    ),
    "a column that is too short": (
        lambda c: c["episodes"]["steps"].pop(),
        "steps holds 4 values for 5 episodes",
    ),
    "a column too many": (lambda c: c["episodes"].update(extra=1), "episodes.0.extra"),
    "text for a number": (in_row(0, steps="10"), "episodes.0.steps"),
    "a negative error": (
        in_row(0, errors={"tilt_error_deg": -1.0}),
        "episodes.0.errors.tilt_error_deg",
    ),
    "an infinite error": (
        in_row(0, errors={"tilt_error_deg": float("inf")}),
        "Infinity is no number",
    ),
    "a success without its steps": (in_row(0, steps_to_goal=None), "null otherwise"),
    "more steps to the goal than steps": (in_row(0, steps_to_goal=99), "between 1 and steps"),
    "two ends": (in_row(0, collision=True), "an episode has one end"),
    "a flattered summary": (
        lambda c: c["summary"].update(pc_success=100.0),
        "summary.pc_success is not what the episodes give",
    ),
    "a flattered error": (
        lambda c: c["summary"]["errors"]["tilt_error_deg"].update(p95=0.0),
        "summary.errors is not",
    ),
    "a settled figure that is not the episode's": (
        in_row(4, errors={"position_error_mm": 0.0}),
        "settled figures must be the episode's own",
    ),
    "another version of a package": (
        lambda c: c["metadata"]["packages"].update(numpy="9"),
        "was changed after it was written",
    ),
    "no seal": (lambda c: c.pop("sha256"), "was changed after it was written"),
    "a bound on nothing": (
        lambda c: c["metadata"].update(tolerances={"yaw": 1.0}),
        "bounds what is no metric",
    ),
    "a log that is too short for a policy of one's own": (
        lambda c: c["metadata"].update(n_logged=2, policy_kind="module"),
        "n_logged must be the number of rows",
    ),
    "a flattered row": (in_row(2, errors={"position_error_mm": 0.0}), "summary.errors is not"),
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
