"""The task gallery: a card for each named task, and on its page a film and the results."""

import json
import os
from itertools import groupby
from pathlib import Path

import hvs_suite
from hvs_suite.policies.catalogue import NAMES

HERE = Path(__file__).parent
RESULTS = HERE.parent / "eval" / "results"
FILMS = HERE.parent / "eval" / "clips" / "expert"
PAGES = "tasks/"


def write(path: Path) -> None:
    """Write the page with a card for each named task, family by family."""
    lines = [
        "# Task gallery",
        "",
        "Every named task is proven to be solvable on all its 1,000 test scenarios; its page has "
        "the certificate, observations and actions, and the results of our policies.",
        "",
    ]
    for family, specs in groupby(hvs_suite.TASKS.values(), lambda spec: spec.family):
        lines += [f"## {family}", "", "::::{grid} 1 2 3 3", ":gutter: 3", ""]
        for spec in specs:
            words = spec.describe()
            held = f", held {words.held}" if words.held else ""
            lines += [
                f":::{{grid-item-card}} {spec.name}",
                f":link: {PAGES}{spec.name}",
                ":link-type: doc",
                f":img-top: {_film(spec.name, path.parent)}",
                "",
                f"Target: {words.target}. Tolerance: {words.tolerance}{held}.",
                ":::",
                "",
            ]
        lines += ["::::", ""]
    lines += ["```{toctree}", ":hidden:", "", *pages(), "```", ""]
    path.write_text("\n".join(lines), encoding="utf-8")


def pages() -> list[str]:
    """The names of the tasks' pages."""
    return [f"{PAGES}{name}" for name in hvs_suite.TASKS]


def extended(name: str, text: str) -> str:
    """A task's page with its film on top and the results of our policies; others as they are."""
    if name not in pages():
        return text
    task = name.removeprefix(PAGES)
    head, _, rest = text.partition("\n\n")
    film = _film(task, HERE / PAGES)
    return "\n\n".join(
        [head, f"![The expert plays a scenario of {task}]({film})", rest, _results(task)]
    )


def _film(task: str, folder: Path) -> str:
    """The expert's clip as a link from a folder; the task's picture where there is none yet."""
    clips = sorted(FILMS.glob(f"{task}.success.*.avif"))
    file = clips[0] if clips else HERE / PAGES / f"{task}.webp"
    return Path(os.path.relpath(file, folder)).as_posix()


def _results(task: str) -> str:
    rows = []
    for policy in NAMES:
        path = RESULTS / policy / f"{task}.json"
        if path.exists():
            summary = json.loads(path.read_text(encoding="utf-8"))["summary"]
            low, high = summary["pc_success_ci95"]
            steps = summary["steps_to_goal_mean"]
            rows.append(
                f"| `{policy}` | {summary['pc_success']:.1f} % ({low:.1f} to {high:.1f}) "
                f"| {summary['n_collision']} | {'' if steps is None else f'{steps:.1f}'} |"
            )
    return "\n".join(
        [
            "## Results of our policies",
            "",
            "On all test scenarios:",
            "",
            "| policy | success, 95 % interval | collisions | steps to goal |",
            "| --- | --- | --- | --- |",
            *rows,
            "",
        ]
    )
