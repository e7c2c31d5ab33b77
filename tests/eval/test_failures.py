"""Why policies fail: each kind of failure is told from the others."""

import dataclasses

import pytest
from test_result_file import row

import hvs_suite
from hvs_suite.cli.main import run
from hvs_suite.eval import protocol
from hvs_suite.eval.studies.failures import Cause, Estimate, cause_of, markdown, sort_failures
from hvs_suite.policies.catalogue import checkpoint_folder
from hvs_suite.tasks.shared.panels import MAX_TILT_DEG

TASK = "align-easy"


def played(policy, tmp_path, episodes=8):
    path = tmp_path / "result.json"
    protocol.evaluate(policy, TASK, path, split="dev", episodes=episodes)
    return path


@pytest.mark.parametrize(
    ("policy", "cause"),
    [
        ("broken_policies:raises", Cause.BROKEN),
        ("broken_policies:dives", Cause.COLLIDED),
        ("zero", Cause.CONTROLLED),
    ],
)
def test_a_failure_has_its_cause(policy, cause, tmp_path):
    report = sort_failures(played(policy, tmp_path))
    assert len(report.failures) == report.n_episodes == 8
    # Standing upright, the arm may hide the target all the time.
    assert {f.cause for f in report.failures} <= {cause, Cause.NOT_SEEN}
    assert report.of(cause)
    assert all(f.seen_steps == 0 for f in report.of(Cause.NOT_SEEN))
    text = markdown([report])
    assert f"| {cause} |" in text
    assert "8 of 8 lost" in text


@pytest.mark.parametrize(
    ("off", "distances_mm", "cause"),
    [
        (Estimate(7.0, 0.1), [900.0, 30.0, 8.0, 7.0, 7.0], Cause.MISPLACED),
        (Estimate(0.5, 9.0), [900.0, 30.0, 8.0, 7.0, 7.0], Cause.MISJUDGED),
        (Estimate(0.5, 0.1), [900.0, 90.0, 60.0, 30.0, 9.0], Cause.SLOW),
        (Estimate(0.5, 0.1), [900.0, 9.0, 9.0, 9.0, 9.0], Cause.CONTROLLED),
        (None, [900.0, 90.0], Cause.SLOW),
    ],
)
def test_an_estimate_and_the_last_steps_tell_eye_from_hand(off, distances_mm, cause):
    lost = row(0, success=False, error=distances_mm[-1])
    distances_m = [distance / 1000 for distance in distances_mm]
    assert cause_of(lost, hvs_suite.TASKS[TASK], 3, off, distances_m) is cause


def test_a_network_is_asked_for_place_and_slope(tmp_path):
    path, task = tmp_path / "result.json", "surface-tilted"
    protocol.evaluate("zero", task, path, split="dev", episodes=3)
    report = sort_failures(path, checkpoint_folder("pretrained", task))
    seen = [failure for failure in report.failures if failure.seen_steps]
    assert seen
    for failure in seen:
        # From above the cell one eye tells the place, and hardly the slope.
        assert failure.off.place_mm < 20.0
        assert 1.0 < failure.off.slope_deg < 2 * MAX_TILT_DEG
        assert failure.cause in (Cause.MISPLACED, Cause.MISJUDGED)
    assert f"{seen[0].off.slope_deg:.2f}" in markdown(
        [dataclasses.replace(report, failures=seen[:1])]
    )


def test_what_was_solved_is_no_failure(tmp_path):
    report = sort_failures(played("expert", tmp_path, episodes=1))
    assert report.failures == ()
    assert "0 of 1 lost" in markdown([report])


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "at least one"),
        (["{result}", "--pictures", "-1"], "--pictures"),
        (["{result}", "--policy", "servo"], "no network"),
        (["{result}.none"], "none"),
    ],
)
def test_mistakes_are_one_line(words, reason, tmp_path, capsys):
    result = played("zero", tmp_path, episodes=1)
    assert run(["failures", *(word.format(result=result) for word in words)]) == 2
    complaint = capsys.readouterr().err
    assert reason in complaint
    assert len(complaint.splitlines()) == 1


@pytest.mark.parametrize(("force_n", "cause"), [(39.0, Cause.COLLIDED), (41.0, Cause.OVERLOADED)])
def test_too_much_force_is_told_from_a_collision(force_n, cause):
    spec = hvs_suite.TASKS["insert-feel"]
    errors = {metric.name: 1.0 for metric in spec.metrics} | {"peak_force_n": force_n}
    ended = {"collision": True, "truncated": False, "errors": errors}
    lost = row(0, success=False, error=1.0).model_copy(update=ended)
    assert cause_of(lost, spec, 3, None, [0.1, 0.1]) is cause
