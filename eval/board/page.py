"""Draws the board as one web page: offline, sortable, readable on a phone and in dark mode.

Everything is in the file: style, script, plots and clips. The style and the script lie beside this
module as ``page.css`` and ``page.js``. What the page says is in ``templates``, which escape every
value and show what is not seen of it: ``base.jinja`` is the frame, and includes one file a section.
"""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import jinja2
from markdown_it import MarkdownIt

from hvs_suite.eval.board import entry_sheet, families, matrix, means, plots, robustness, tables
from hvs_suite.eval.board.clips import SIZE, Clip
from hvs_suite.eval.board.entry_sheet import Film
from hvs_suite.eval.board.tables import SUCCESS, VERIFIED, Entry
from hvs_suite.eval.scoring.robustness_file import Robustness
from hvs_suite.names import shown

COLOURS: Final = 8
"""Distinct colours in the style; further policies take them again with broken lines."""
_HERE: Final = Path(__file__).parent


def page(
    entries: Sequence[Entry],
    clips: Mapping[tuple[str, str], Sequence[Clip]] | None = None,
    *,
    studies: Sequence[Robustness] = (),
    draft: bool = False,
) -> str:
    """Returns the whole page; the same entries and clips give the same text.

    Args:
        entries: One or more.
        clips: By (policy, task without version); none by default.
        studies: Of robustness; none by default.
        draft: Say that it is one.
    """
    by_task = tables.by_task(entries)
    reel: list[str] = []
    films: dict[tuple[str, str], list[Film]] = {}
    for entry in (entry for table in by_task.values() for entry in table):
        key = entry.policy, entry.result.summary.task
        for clip in (clips or {}).get(key, ()):
            films.setdefault(key, []).append(Film.of(len(reel), entry, clip))
            reel.append(base64.b64encode(clip.avif).decode("ascii"))
    standings = means.standings(entries)
    return (
        _environment()
        .get_template("base.jinja")
        .render(
            draft=tables.DRAFT if draft else "",
            style=_own("page.css"),
            script=_own("page.js"),
            submitting=_submitting(),
            notes=tables.NOTES,
            means_note=means.NOTE,
            pairs_note=matrix.CAPTION,
            parts=means.parted(standings),
            families=families.families(by_task, standings, films),
            sheets=[
                entry_sheet.sheet(entry, films.get((entry.policy, entry.result.summary.task), ()))
                for table in by_task.values()
                for entry in table
            ],
            reel=reel,
            studies=robustness.studies(studies),
            robustness_note=robustness.NOTE,
            # Those on the most tasks come first, and have a colour of their own.
            colours={row.policy: k for k, row in enumerate(standings)},
        )
    )


def _environment() -> jinja2.Environment:
    """Returns what draws the templates: it escapes every value, and refuses names there are not."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE / "templates"),
        autoescape=True,
        finalize=_seen,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "percent": tables.percent,
        "figure": tables.figure,
        "number": lambda value: "" if value is None else repr(float(value)),
    }
    environment.globals |= {
        "COLOURS": COLOURS,
        "DASH": tables.DASH,
        "ERRORS": entry_sheet.ERRORS,
        "SIZE": SIZE,
        "SUCCESS": SUCCESS,
        "VERIFIED": VERIFIED,
        "describe": tables.describe,
        "interval": tables.interval,
        "link": entry_sheet.link,
        "plots": plots,
    }
    return environment


def _seen(value: object) -> object:
    """Returns a value for the page, with what is not seen of a text made visible."""
    is_markup = hasattr(value, "__html__")
    return shown(value) if isinstance(value, str) and not is_markup else value


def _submitting() -> str:
    """Returns ``SUBMITTING.md`` as HTML, its headings one level lower."""
    parser = MarkdownIt("commonmark", {"html": False})
    tokens = parser.parse((_HERE.parent / "SUBMITTING.md").read_text(encoding="utf-8"))
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = f"h{int(token.tag[1]) + 1}"
    rendered: str = parser.renderer.render(tokens, parser.options, {})
    return rendered


def _own(name: str) -> str:
    """Returns a file of ours."""
    return (_HERE / name).read_text(encoding="utf-8")
