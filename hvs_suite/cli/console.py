"""What every command says the same way: tables, progress and JSON.

Rich draws where a person looks on; a pipe or a log file gets plain lines.
"""

import contextlib
import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hvs_suite.names import shown

if TYPE_CHECKING:
    from rich.console import Console

PLAIN_WIDTH = 160
FIGURE = re.compile(r"[-+]?[0-9.]+( ?%)?|-")
PLAIN_PROGRESS_PERIOD_S = 10.0


def console() -> "Console":
    """The console on stdout; 160 columns wide where stdout is no terminal."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else PLAIN_WIDTH)


def print_json(content: Mapping[str, Any] | Sequence[Any]) -> None:
    """Print one JSON document, indented, to stdout."""
    print(json.dumps(content, indent=2))


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
    """Print a table; columns of figures are right-aligned.

    Args:
        columns: Headings.
        rows: Cells as text, one sequence a row.
        title: Line above the table.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    # As text, not as markup, because cells and titles hold names from other people.
    table = Table(
        title=Text(shown(title)) if title else None,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for index, column in enumerate(columns):
        figures = all(FIGURE.fullmatch(row[index]) for row in rows)
        table.add_column(column, justify="right" if figures else "left")
    for row in rows:
        table.add_row(*(Text(shown(cell)) for cell in row))
    console().print(table)


@contextlib.contextmanager
def progress(what: str, total: int) -> Iterator[Callable[..., None]]:
    """Show how far long work has come, with its rate and the time left.

    Args:
        what: The work, in a few words.
        total: Units of work.

    Yields:
        A function to call after each unit, if need be with a few words on how it goes.
    """
    what = shown(what)
    if sys.stderr.isatty():
        from rich import progress as rich_progress
        from rich.console import Console

        bar = rich_progress.Progress(
            rich_progress.TextColumn("{task.description}", markup=False),
            rich_progress.BarColumn(),
            rich_progress.MofNCompleteColumn(),
            rich_progress.TimeRemainingColumn(),
            rich_progress.TextColumn("{task.fields[note]}"),
            console=Console(stderr=True),
        )
        with bar:
            task = bar.add_task(what, total=total, note="")
            yield lambda note="": bar.update(task, advance=1, note=note)
        return
    yield _plain_progress(what, total)


def _plain_progress(what: str, total: int) -> Callable[..., None]:
    """A function that counts, and prints a line every ten seconds and at the end."""
    started = last = time.monotonic()
    done = 0

    def advance(note: str = "") -> None:
        nonlocal done, last
        done += 1
        now = time.monotonic()
        if done == total or now - last >= PLAIN_PROGRESS_PERIOD_S:
            last = now
            left = (now - started) / done * (total - done)
            words = f"{note}, " if note else ""
            print(f"{what}: {done}/{total}, {words}{left:.0f} s left", file=sys.stderr, flush=True)

    return advance


@contextlib.contextmanager
def meter() -> Iterator[Callable[[str, float, str], None]]:
    """Show how far work has come whose own code knows the share done and the time left.

    Yields:
        A function to call often, with the stage, the share of it that is done (0 to 1), and a few
        words such as rate and time left.
    """
    if not sys.stderr.isatty():
        yield _plain_meter()
        return
    from rich import progress as rich_progress
    from rich.console import Console

    bar = rich_progress.Progress(
        rich_progress.TextColumn("{task.description}"),
        rich_progress.BarColumn(),
        rich_progress.TaskProgressColumn(),
        rich_progress.TextColumn("{task.fields[words]}"),
        console=Console(stderr=True),
    )
    with bar:
        stages: dict[str, rich_progress.TaskID] = {}

        def update(stage: str, share: float, words: str) -> None:
            if stage not in stages:
                stages[stage] = bar.add_task(stage, total=1.0, words="")
            bar.update(stages[stage], completed=share, words=words)

        yield update


def _plain_meter() -> Callable[[str, float, str], None]:
    """A function that prints how far work has come every ten seconds and at a stage's end."""
    last = -math.inf
    ended: set[str] = set()

    def update(stage: str, share: float, words: str) -> None:
        nonlocal last
        # The last step of a timed stage ends a little after its time.
        share = min(share, 1.0)
        now = time.monotonic()
        ends = share >= 1.0 and stage not in ended
        if ends or now - last >= PLAIN_PROGRESS_PERIOD_S:
            last = now
            ended.update([stage] if ends else [])
            print(f"{stage}: {100.0 * share:.0f} %, {words}", file=sys.stderr, flush=True)

    return update


@contextlib.contextmanager
def stage(title: str, times_s: dict[str, float]) -> Iterator[None]:
    """Announce a stage of long work and note how long it took.

    Args:
        title: The stage, in a few words.
        times_s: Gets the time of the stage under its title (s).
    """
    print(f"== {title}", flush=True)
    started = time.monotonic()
    yield
    times_s[title] = time.monotonic() - started
    print(f"   {times_s[title]:.0f} s", flush=True)


def print_times(times_s: Mapping[str, float]) -> None:
    """Print a table of stages and their sum.

    Args:
        times_s: As `stage` fills it (s).
    """
    times = {**times_s, "all": sum(times_s.values())}
    print_table(
        ("stage", "minutes", "hours"),
        [(name, f"{taken / 60:.1f}", f"{taken / 3600:.2f}") for name, taken in times.items()],
    )
