"""Tables and picture of a search: which settings were best, and which mattered."""

from typing import Any

from hvs_suite.eval.studies.search import Search, Tried
from hvs_suite.eval.studies.training import SPLIT
from hvs_suite.statistics import wilson_interval

SHOWN = 10
"""Trials in the table."""


def markdown(search: Search) -> str:
    """Tables and words of all trials so far."""
    best = _ranked(search)[0]
    low, high = wilson_interval(best.n_success, best.n)
    lines = [
        f"`{search.task}`, {search.learner}: {len(search.trials)} trials, {best.n} scenes of split "
        f"`{SPLIT}` each, the best {min(SHOWN, len(search.trials))} of them.",
        "",
        *trial_table(search),
        "",
        f"- The best is trial {best.number}: {_rate(best):.1f} % ({low:.1f} to {high:.1f} %). As "
        "the best of many it owes something to chance; score it on other scenes."
        if best.n_success
        else "- None is solved.",
    ]
    if search.importances:
        lines += [
            "",
            *importance_table(search),
            "",
            f"- What mattered most is {next(iter(search.importances))}.",
        ]
    lines += ["", "The commands that make each policy again are in study.json."]
    return "\n".join(lines) + "\n"


def trial_table(search: Search) -> list[str]:
    """The best trials in Markdown, line by line."""
    names = list(search.trials[0].settings)
    return [
        f"| trial | {' | '.join(names)} | solved | 95 % interval (Wilson) |",
        f"|---|{'---|' * len(names)}---|---|",
        *(_line(each, names) for each in _ranked(search)[:SHOWN]),
    ]


def importance_table(search: Search) -> list[str]:
    """What each setting had to do with success, in Markdown, line by line."""
    return [
        "| setting | importance |",
        "|---|---|",
        *(f"| {name} | {share:.2f} |" for name, share in search.importances.items()),
    ]


def _ranked(search: Search) -> list[Tried]:
    return sorted(search.trials, key=lambda each: -each.n_success)


def _line(trial: Tried, names: list[str]) -> str:
    low, high = wilson_interval(trial.n_success, trial.n)
    values = " | ".join(f"{trial.settings[name]:.3g}" for name in names)
    return f"| {trial.number} | {values} | {_rate(trial):.1f} % | {low:.1f} to {high:.1f} % |"


def _rate(trial: Tried) -> float:
    return 100.0 * trial.n_success / trial.n


def draw(search: Search) -> Any:
    """What each trial reached, and how much each setting mattered; a ``matplotlib`` figure."""
    from matplotlib.figure import Figure

    shares = search.importances
    figure = Figure(figsize=(9.0 if shares else 4.6, 3.4), dpi=130, layout="constrained")
    panels = figure.subplots(1, 2 if shares else 1, squeeze=False)[0]
    history = panels[0]
    rates = [_rate(each) for each in search.trials]
    numbers = [each.number for each in search.trials]
    history.plot(numbers, rates, "o", color="#2b6cb0", markersize=4, label="a trial")
    so_far = [max(rates[: i + 1]) for i in range(len(rates))]
    history.step(numbers, so_far, where="post", color="#e9620a", label="the best so far")
    history.set(xlabel="trial", ylabel="solved (%)", ylim=(-2.0, 102.0))
    history.legend(fontsize=8, frameon=False)
    if shares:
        panels[1].barh(list(shares)[::-1], list(shares.values())[::-1], color="#2b6cb0")
        panels[1].set_xlabel("importance (PED-ANOVA)")
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    figure.suptitle(f"{search.task}, {search.learner}", fontsize=10, x=0.01, ha="left")
    return figure
