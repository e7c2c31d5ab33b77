"""Names from other people: refused where they could mislead, and shown safely.

A name is shown in a terminal, in Markdown and on a web page. There, a line break, an escape
sequence or a mark that turns the direction of writing changes what a reader sees, and with
invisible characters two different names look the same.
"""

import unicodedata
from collections.abc import Iterable

from hvs_suite.errors import HvsError

LONGEST = 100
# Printable for Python, and yet drawn as nothing: fillers, selectors, an empty Braille cell.
_INVISIBLE = (
    (0x034F, 0x034F),
    (0x115F, 0x1160),
    (0x17B4, 0x17B5),
    (0x180B, 0x180F),
    (0x2800, 0x2800),
    (0x3164, 0x3164),
    (0xFE00, 0xFE0F),
    (0xFFA0, 0xFFA0),
    (0xE0100, 0xE01EF),
)
# Small letters and digits that pass for Latin ones; what NFKC and casefold leave of look-alikes.
_LOOK_ALIKES = str.maketrans(
    "аɑαсϲԁеєεһհ1lіıιмηոп0оοօрρг5ѕтτиυսѵνхχᴢζ×ᴀᴅᴇꜰɪᴍɴᴏᴘʀꜱᴛᴜᴠ",
    "aaaccdeeehhiiiiimnnnoooopprssttuuuvvxxzzxadefimnoprstuv",
)


def check_name(name: str, what: str, *, error: type[HvsError]) -> str:
    """Check that a name can be shown as it is.

    Args:
        name: The name.
        what: What has this name, for the message.
        error: Raised where it cannot.

    Returns:
        The name.

    Raises:
        HvsError: As `error`: it is empty, longer than 100 characters, begins or ends with a blank,
            or holds a character that is not seen: a control or escape character, a line break, a
            mark of the direction of writing, one without width.
    """
    if not name or len(name) > LONGEST:
        raise error(f"{what} has {len(name)} characters; a name has 1 to {LONGEST}")
    for character in name:
        if not _is_seen(character):
            raise error(
                f"{what} {shown(name)!r} holds U+{ord(character):04X}, which is not seen; leave it "
                "out"
            )
    if name != name.strip():
        raise error(f"{what} {name!r} begins or ends with a blank; leave it out")
    return name


def shown(text: str) -> str:
    r"""Return text for a terminal, Markdown or HTML, with what is not seen as ``\xNN``, ``\uNNNN``.

    Args:
        text: Any text.
    """
    return "".join(c if _is_seen(c) else c.encode("unicode_escape").decode() for c in text)


def look_alike(name: str, names: Iterable[str]) -> str | None:
    """Find which of some names another one is, or passes for.

    Case, accents, punctuation, widths, and letters of other alphabets that look the same make no
    difference.

    Args:
        name: A name from other people.
        names: Those it may not pass for.

    Returns:
        The first that it looks like; None if it looks like none.
    """
    skeleton = _skeleton(name)
    return next((ours for ours in names if _skeleton(ours) == skeleton), None)


def _is_seen(character: str) -> bool:
    code = ord(character)
    return character.isprintable() and not any(low <= code <= high for low, high in _INVISIBLE)


def _skeleton(name: str) -> str:
    # First the compatibility form, then casefold, then decompose again what casefold has composed.
    folded = unicodedata.normalize("NFKD", unicodedata.normalize("NFKC", name).casefold())
    return "".join(c for c in folded.translate(_LOOK_ALIKES) if c.isalnum())
