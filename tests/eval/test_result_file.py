"""A result file says what happened, and one that cannot be true is refused with the reason."""

import json
from pathlib import Path
from typing import Any

import pytest

from hvs_suite.errors import OutputError, ResultError
from hvs_suite.eval.scoring import result_file

TOLERANCES = {"position_error_mm": 5.0, "tilt_error_deg": 5.0}


def errors_of(error: float) -> dict[str, float]:
    return {
        "position_error_mm": error,
        "lateral_error_mm": error,
        "height_error_mm": 0.0,
        "tilt_error_deg": 2 * error,
    }


def row(
    scenario: int, *, success: bool, error: float, settled: Any = None, **changes: Any
) -> result_file.EpisodeRow:
    """A row; `settled` changes where it ended, which without success is what it was scored on."""
    steps = 10 + scenario
    collision = not success and scenario % 2 == 1
    values: dict[str, Any] = {
        "scenario": scenario,
        "success": success,
        "success_once": success,
        "collision": collision,
        "truncated": not success and not collision,
        "steps": steps,
        "steps_to_goal": steps if success else None,
        "n_clipped": scenario,
        "failure": None,
        "errors": errors_of(error),
    } | changes
    rest = error / 10 if success else error
    end = {
        "steps": 20 if success else values["steps"],
        "collision": values["collision"],
        "failure": values["failure"],
        "errors": errors_of(rest),
        "x_mm": rest,
        "y_mm": 0.0,
    }
    return result_file.EpisodeRow(**values, settled=end | (settled or {}))


def make_result(n: int = 5, **summary: Any) -> result_file.Result:
    return of_rows([row(i, success=i < 3, error=float(i) / 3) for i in range(n)], **summary)


def of_rows(rows: list[result_file.EpisodeRow], **summary: Any) -> result_file.Result:
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
            n_logged=len(rows),
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
    lost = {"truncated": False, "failure": "not finite"}
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


def test_a_bound_of_0_has_no_multiples() -> None:
    rows = [row(i, success=i < 3, error=float(i)) for i in range(5)]
    settled = result_file.SettledSummary.of(rows, {"position_error_mm": 0.0})
    assert settled.success_by_scale is None
    assert settled.sharpest_95.scale is None
    assert settled.errors["position_error_mm"].p50 == pytest.approx(0.2)


def test_a_goal_may_come_before_the_last_scored_step() -> None:
    rows = [row(0, success=True, error=1.0, steps=20, steps_to_goal=12)]
    summary = result_file.Summary.of(
        "t", "p", "test", rows, tolerances=TOLERANCES, time_limit_steps=20
    )
    assert summary.steps_to_goal_mean == 12.0
    assert summary.success_by_step[10:12] == [0.0, 100.0]


def test_each_column_stands_on_its_own_line_and_what_never_differs_is_said_once(
    tmp_path: Path,
) -> None:
    path = tmp_path / "result.json"
    result_file.write(make_result(), path)
    columns = json.loads(path.read_text())["episodes"]
    assert columns["steps"] == [10, 11, 12, 13, 14]
    assert columns["errors"]["height_error_mm"] == 0.0
    assert columns["failure"] is None
    assert "scenario" not in columns
    # Three of five played on past the goal; none of them collided there.
    assert columns["settled"]["steps"] == [20, 20, 20, 13, 14]
    assert "collision" not in columns["settled"]
    lines = [line.strip().removesuffix(",") for line in path.read_text().splitlines()]
    assert '"steps": [10,11,12,13,14]' in lines
    assert '"height_error_mm": 0.0' in lines


@pytest.mark.parametrize(
    "rows",
    [
        [row(0, success=True, error=1.0)],
        [row(i, success=False, error=1.0 + i) for i in range(4)],
        [row(i, success=True, error=0.5, settled={"steps": 30 + i}) for i in range(3)],
        [
            row(0, success=True, error=1.0, settled={"collision": True}),
            row(1, success=True, error=1.0, settled={"failure": "too slow"}),
        ],
    ],
    ids=["one", "none played on", "equal but for the end", "lost after the goal"],
)
def test_columns_read_back_as_the_rows_that_were_written(
    rows: list[result_file.EpisodeRow], tmp_path: Path
) -> None:
    path = tmp_path / "result.json"
    result_file.write(of_rows(rows), path)
    assert result_file.load(path).episodes == rows


def test_a_result_cannot_be_written_below_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        result_file.write(make_result(), tmp_path / "file" / "result.json")


BROKEN: dict[str, tuple[Any, str]] = {
    "missing block": (lambda c: c.pop("metadata"), "metadata: Field required"),
    "unknown key": (lambda c: c["summary"].update(extra=1), "summary.extra"),
    "other schema": (lambda c: c.update(schema_version=99), "schema_version is 99"),
    "no schema": (lambda c: c.pop("schema_version"), "it has no schema_version"),
    "no rows": (lambda c: c.update(episodes=[]), "holds no columns of episodes"),
    "text for a number": (lambda c: c["episodes"].update(steps=5 * ["10"]), "episodes.0.steps"),
    "a negative error": (
        lambda c: c["episodes"]["errors"].update(tilt_error_deg=-1.0),
        "episodes.0.errors.tilt_error_deg",
    ),
    "an infinite error": (
        lambda c: c["episodes"]["errors"].update(tilt_error_deg=float("inf")),
        "Infinity is no number",
    ),
    "a column that is too short": (
        lambda c: c["episodes"]["steps"].pop(),
        "episodes: steps holds 4 values for 5 episodes",
    ),
    "a column of a metric that is too long": (
        lambda c: c["episodes"]["errors"]["tilt_error_deg"].append(1.0),
        "episodes: tilt_error_deg holds 6 values for 5 episodes",
    ),
    "a column left out": (lambda c: c["episodes"].pop("steps"), "episodes.0.steps"),
    "a column too many": (lambda c: c["episodes"].update(extra=1), "episodes.0.extra"),
    "scenarios of its own": (
        lambda c: c["episodes"].update(scenario=[0, 0, 1, 2, 3]),
        "are scenarios 0..N-1",
    ),
    "more columns than any task has": (
        lambda c: c["episodes"]["errors"].update({f"error_{k}_mm": 0.0 for k in range(110_000)}),
        "values of episodes",
    ),
    "more episodes than rows": (
        lambda c: c["summary"].update(n_episodes=6),
        "values for 6 episodes",
    ),
    "episodes without number": (
        lambda c: c["summary"].update(n_episodes=10**9),
        "values of episodes",
    ),
    "a metric without its settled figure": (
        lambda c: c["episodes"]["settled"]["errors"].pop("tilt_error_deg"),
        "must have the metrics of errors",
    ),
    "a log of fewer scenarios, of somebody's code": (
        lambda c: c["metadata"].update(n_logged=3, policy_kind="module"),
        "n_logged must be the number of rows",
    ),
    "a log of more scenarios": (
        lambda c: c["metadata"].update(n_logged=6),
        "n_logged must be the number of rows",
    ),
    "a success without its steps": (
        lambda c: c["episodes"].update(steps_to_goal=[None, 11, 12, None, None]),
        "steps_to_goal is a number for a success",
    ),
    "a goal after the last step": (
        lambda c: c["episodes"].update(steps_to_goal=[11, 11, 12, None, None]),
        "steps_to_goal must lie between 1 and steps",
    ),
    "two ends": (
        lambda c: c["episodes"]["collision"].__setitem__(0, True),
        "an episode has one end",
    ),
    "a flattered summary": (
        lambda c: c["summary"].update(pc_success=100.0),
        "summary.pc_success is not what the episodes give",
    ),
    "a flattered error": (
        lambda c: c["summary"]["errors"]["tilt_error_deg"].update(p95=0.0),
        "summary.errors is not",
    ),
    "a settled figure that is not the episode's": (
        lambda c: c["episodes"]["errors"]["position_error_mm"].__setitem__(4, 0.0),
        "settled figures must be the episode's own",
    ),
    "another version of a package": (
        lambda c: c["metadata"]["packages"].update(numpy="9"),
        "was changed after it was written",
    ),
    "no seal": (lambda c: c.pop("sha256"), "was changed after it was written"),
    "a bound on nothing": (
        lambda c: c["metadata"].update(tolerances={"yaw": 1.0}),
        "tolerances bounds what is no metric",
    ),
    "a flattered row": (
        lambda c: c["episodes"]["errors"]["position_error_mm"].__setitem__(2, 0.0),
        "summary.errors is not",
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
