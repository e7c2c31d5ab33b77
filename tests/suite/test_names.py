"""A name that misleads is refused; whatever is shown cannot act on what shows it."""

import pytest

from hvs_suite.errors import ResultError
from hvs_suite.names import check_name, look_alike, shown
from hvs_suite.policies.catalogue import NAMES


@pytest.mark.parametrize("name", ["my-policy", "runs/act", "Größe 2", "方策", "a" * 100, "p|*<b>"])
def test_a_name_that_can_be_seen_is_taken(name: str) -> None:
    assert check_name(name, "the policy", error=ResultError) == name
    assert shown(name) == name


UNSEEN = {
    "a line break": "a\nb",
    "a carriage return": "a\rb",
    "an escape sequence": "\x1b[31mred",
    "a null": "a\0b",
    "a mark from right to left": "a\u202eb",
    "an isolate": "a\u2066b",
    "no width": "ex\u200bpert",
    "a joiner": "ex\u200dpert",
    "a filler": "ex\u3164pert",
    "a selector": "expert\ufe0f",
    "a line separator": "a\u2028b",
    "a blank without break": "a\u00a0b",
    "half a character": "a\ud800b",
    "a tag": "a\U000e0041b",
}


@pytest.mark.parametrize("what", UNSEEN)
def test_what_is_not_seen_is_refused_and_shown_escaped(what: str) -> None:
    name = UNSEEN[what]
    with pytest.raises(ResultError, match=r"the policy .* holds U\+") as caught:
        check_name(name, "the policy", error=ResultError)
    for text in (shown(name), str(caught.value)):
        assert text.isprintable()
        assert text.encode()
    assert "\\" in shown(name)


@pytest.mark.parametrize("name", ["", "a" * 101, " a", "a "])
def test_a_name_of_no_shape_is_refused(name: str) -> None:
    with pytest.raises(ResultError, match="the policy"):
        check_name(name, "the policy", error=ResultError)


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("expert", "expert"),
        ("Expert", "expert"),
        ("ехреrt", "expert"),  # Cyrillic
        ("ΕΧΡΕRΤ", "expert"),  # Greek
        ("ｅｘｐｅｒｔ", "expert"),
        ("𝐞𝐱𝐩𝐞𝐫𝐭", "expert"),
        ("éxpert.", "expert"),
        ("ex-pert", "expert"),
        ("zer0", "zero"),
        ("f1netuned", "finetuned"),
        ("pretra\u0131ned", "pretrained"),
        ("my-expert", None),
        ("act", None),
        ("sac-seed-0", None),
    ],
)
def test_a_look_alike_is_known(name: str, ours: str | None) -> None:
    assert look_alike(name, NAMES) == ours
