"""The files of a study: what it found as JSON, in words, and as a picture."""

from pathlib import Path
from typing import Any


def write_json(out: Path, study: Any) -> None:
    """Write all that a study found, a pydantic model."""
    from hvs_suite.files import replacing

    with replacing(out / "study.json") as temporary:
        temporary.write_text(study.model_dump_json(indent=2) + "\n", encoding="utf-8")


def write_report(out: Path, text: str, figure: Any) -> None:
    """Write a study's tables and picture."""
    from hvs_suite.files import replacing

    with replacing(out / "study.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    with replacing(out / "study.png") as temporary:
        figure.savefig(temporary)


def say(out: Path, text: str) -> None:
    """Print a study's tables, and where it is written."""
    print(text, end="")
    print(f"wrote {out / 'study.json'}, study.md and study.png")
