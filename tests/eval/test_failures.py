"""Why policies fail: each kind of failure is told from the others."""

import pytest

from hvs_suite.cli.main import run
from hvs_suite.eval import protocol
from hvs_suite.eval.failures import Cause, markdown, sort_failures

TASK = "align-easy"


def played(policy, tmp_path, episodes=3):
    path = tmp_path / "result.json"
    protocol.evaluate(policy, TASK, path, split="dev", episodes=episodes)
    return path


@pytest.mark.parametrize(
    ("policy", "cause"),
    [
        ("broken_policies:raises", Cause.BROKEN),
        ("broken_policies:dives", Cause.COLLIDED),
        ("broken_policies:starts_late", Cause.SLOW),
        ("zero", Cause.CONTROLLED),
    ],
)
def test_a_failure_has_its_cause(policy, cause, tmp_path):
    report = sort_failures(played(policy, tmp_path))
    assert len(report.failures) == report.n_episodes == 3
    # Standing upright, the arm may hide the target all the time; and who leans may lean away.
    assert {f.cause for f in report.failures} <= {cause, Cause.NOT_SEEN, Cause.CONTROLLED}
    assert report.of(cause)
    assert all(f.seen_steps == 0 for f in report.of(Cause.NOT_SEEN))
    text = markdown([report])
    assert f"| {cause} |" in text
    assert "3 of 3 lost" in text


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
