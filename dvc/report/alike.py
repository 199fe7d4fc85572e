"""Sentences that hold for several loads are told once; names are listed in a sentence."""

import re
from collections.abc import Iterable, Sequence

_SENTENCE = re.compile(r"(?P<of>[^:.(]+?)(?P<kind>, registration \([^)]*\))?: (?P<what>.+)", re.DOTALL)


def alike(sentences: Iterable[str]) -> tuple[str, ...]:
    """Equal sentences on several loads as one that names them all, in the place of the first.

    >>> alike(["Load1: no result.", "Fat folds.", "Load2: no result."])
    ('Load1, Load2: no result.', 'Fat folds.')

    What comes before the colon is a load only without a remark in brackets:

    >>> alike(["Best match (area): a.", "Best match under Load1 (area): a."])
    ('Best match (area): a.', 'Best match under Load1 (area): a.')
    """
    of: dict[tuple[str, str], list[str]] = {}
    for sentence in sentences:
        found = _SENTENCE.fullmatch(sentence)
        kind, what = (found["kind"] or "", found["what"]) if found else ("", sentence)
        of.setdefault((kind, what), []).extend([found["of"]] if found else [])
    return tuple(f"{', '.join(names)}{kind}: {what}" if names else what for (kind, what), names in of.items())


def listed(names: Sequence[str]) -> str:
    """Names in a sentence, at least one.

    >>> listed(["a"]), listed(["a", "b", "c"])
    ('a', 'a, b and c')
    """
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
