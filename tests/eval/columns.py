"""Rows of a result file's content, and back to the columns that it holds."""

from typing import Any

from hvs_suite.eval import result_file

Content = dict[str, Any]


def rows_of(content: Content) -> list[dict[str, Any]]:
    """The rows of a file that was parsed."""
    rows = result_file._rows(content["episodes"], content["summary"]["n_episodes"])
    return [{"scenario": index, **row} for index, row in enumerate(rows)]


def put_rows(content: Content, rows: list[dict[str, Any]]) -> None:
    """Puts rows in their place; the summary stays as it was, but for how many there are."""
    content["episodes"] = result_file._columns(rows)
    content["summary"]["n_episodes"] = len(rows)
