"""Text from captures and files, made fit for a terminal."""

import codecs
import re
from collections import Counter
from collections.abc import Iterable, Sequence

_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def encoding_of(start: bytes) -> str:
    """Of text that begins so: UTF-16 where its mark says so, as PowerShell and spreadsheets write it, or else UTF-8."""
    return "utf-16" if start[:2] in _UTF16_MARKS else "utf-8-sig"


def printable(text: str) -> str:
    """`text` with everything escaped that a terminal would act upon or that changes the order of what is read: control
    and formatting characters, bytes that aren't UTF-8. Line ends stay."""
    return "".join(c if c.isprintable() or c in "\n\u00a0\u202f" else c.encode("unicode_escape").decode() for c in text)


def grouped_reasons(reasons: Sequence[str]) -> list[str]:
    """Each reason, with … for its figures where others differ from it by these alone."""
    kinds = {reason: re.sub(r"\d[\d.]*", "…", reason) for reason in reasons}
    counts = Counter(kinds.values())
    return [kinds[reason] if counts[kinds[reason]] > 1 else reason for reason in reasons]


def natural_order(name: str) -> tuple[tuple[str, int, str], ...]:
    """A key that sorts names as people count: frame2 before frame10."""
    parts = re.findall(r"([^0-9]*)([0-9]*)", name)
    # Of numbers without leading zeros the longer one is larger; the name itself decides between 1 and 01.
    return (*((text, len(n), n) for text, digits in parts for n in [digits.lstrip("0")]), (name, 0, ""))


def name_list(names: Sequence[str], most: int) -> str:
    """`a, b, c and 4 more`: the first `most` names; `nothing` where there is none."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more if names else "nothing"


def in_words(names: Iterable[str]) -> str:
    """`train`, `train and test`, `train, val and test`."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
