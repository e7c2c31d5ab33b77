"""What docs/lerobot-benchmark.md says of the tasks is true, and what it shows works."""

import json
import re
import shlex
from pathlib import Path

import pytest

from hvs_suite.cli.main import run
from hvs_suite.registry import TASKS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "lerobot-benchmark.md").read_text("utf-8")


def table(first):
    """Rows of the table whose head begins with a word."""
    return PAGE[PAGE.index(f"| {first} |") :].split("\n\n")[0].splitlines()[2:]


def test_the_table_of_suites_is_that_of_the_registry():
    families = {}
    for spec in TASKS.values():
        families.setdefault(spec.family, []).append(spec)
    assert table("suite") == [
        f"| `{family}` | {len(specs)} | {specs[0].instruction()} |"
        for family, specs in families.items()
    ]


def test_the_table_of_tasks_is_that_of_the_registry():
    rows = []
    for name, spec in TASKS.items():
        words = spec.describe()
        also = ", ".join(f"`{other}`" for other in spec.further_observations)
        sides = f"{spec.eih_resolution}, {spec.eth_resolution}"
        held = words.held or "1 step"
        cells = (f"`{name}`", words.tolerance, held, spec.time_limit_steps, sides, also or "-")
        rows.append(f"| {' | '.join(map(str, cells))} |")
    assert table("task") == rows


def test_the_published_results_are_the_board_s():
    rows = [[cell.strip() for cell in row[1:-1].split("|")] for row in table("weights and task")]
    assert {TASKS[row[0].split("/")[1].strip("`")].family for row in rows} == {
        spec.family for spec in TASKS.values()
    }
    for name, _, solved in rows:
        path = ROOT / "eval" / "results" / f"{name.strip('`')}.json"
        summary = json.loads(path.read_text("utf-8"))["summary"]
        assert summary["n_episodes"] == 1000
        assert solved == f"{summary['n_success']:,}"


@pytest.mark.timeout(300)
def test_one_dataset_of_many_tasks_is_made_with_the_tools_of_lerobot(tmp_path, monkeypatch):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    section = PAGE[PAGE.index("### One dataset of many tasks") :].split("\n## ")[0]
    [recording], [merging] = (
        re.findall(rf"```{language}\n(.*?)```", section, re.DOTALL) for language in ("sh", "python")
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    lines = recording.strip().splitlines()
    for line in lines:
        assert run(shlex.split(line.replace("--episodes 200", "--episodes 1"))[1:]) == 0, line
    exec(merging, {})
    merged = LeRobotDataset("local/hvs", root=tmp_path / "runs/hvs")
    assert merged.num_episodes == len(lines)
    tasks = {shlex.split(line)[3] for line in lines}
    assert {TASKS[task].family for task in tasks} == {spec.family for spec in TASKS.values()}
    sentences = {merged[int(row["dataset_from_index"])]["task"] for row in merged.meta.episodes}
    assert len(sentences) == len({TASKS[task].instruction() for task in tasks})
    assert merged[0]["observation.images.eth"].shape == (3, 168, 168)
