"""What an option of a task may be, as the type of its field says it, and the same from text.

The command line gives options as ``name=value``; JSON and Python give values. All are checked
against the types that the spec's fields declare, which is the only place where they are written
down.
"""

import contextlib
import math
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

_WORDS = {"true": True, "false": False, "none": None}


def fits(value: Any, hint: Any) -> bool:
    """Whether a value has a type, for the few kinds of types that specs use.

    Args:
        value: Any value.
        hint: Of a spec's field, as `typing.get_type_hints` gives it.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return value in arguments
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, choice) for choice in arguments)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if arguments[-1] is Ellipsis:
            return all(fits(item, arguments[0]) for item in value)
        return len(value) == len(arguments) and all(map(fits, value, arguments))
    if hint is float:
        return (
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        )
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, hint)


def in_words(hint: Any) -> str:
    """A type as a person would say it, such as ``disc, ring or fiducial``.

    Args:
        hint: As in `fits`.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return _joined(map(str, arguments))
    if origin in (typing.Union, types.UnionType):
        return _joined(in_words(choice) for choice in arguments)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"a list of {in_words(arguments[0])}"
        return f"({', '.join(map(in_words, arguments))})"
    return "None" if hint is types.NoneType else str(getattr(hint, "__name__", hint))


def from_text(text: str, hint: Any) -> Any:
    """The value that a text stands for: the first reading of it that has the type.

    A text is read as it stands, as a number, ``true``, ``false`` or ``none``, and as a list of
    those that commas separate, in parentheses or not.

    Args:
        text: Such as ``0.03``, ``fiducial``, ``0.4,0.7`` or ``true``.
        hint: As in `fits`.

    Returns:
        The value; where no reading has the type, the likeliest, which `fits` refuses.
    """
    readings = list(_readings(text.strip()))
    return next((reading for reading in readings if fits(reading, hint)), readings[1])


def to_text(value: Any) -> str:
    """A value as `from_text` reads it.

    Args:
        value: Of an option; lists, as JSON gives them, do for tuples.
    """
    if isinstance(value, list | tuple):
        return ",".join(map(to_text, value))
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)


def listed(options: Mapping[str, Any]) -> str:
    """Options as the command line takes them, such as ``marker=ring, ring_m=0.4,0.7``.

    Args:
        options: Values by name.
    """
    return ", ".join(f"{name}={to_text(value)}" for name, value in sorted(options.items()))


def _readings(text: str) -> Iterator[Any]:
    yield text
    yield _word(text)
    items = text.removeprefix("(").removesuffix(")").split(",")
    yield tuple(_word(item.strip()) for item in items if item.strip())


def _word(text: str) -> Any:
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text


def _joined(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} or {last}" if first else last
