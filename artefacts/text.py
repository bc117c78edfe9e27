"""Text from captures and files, made fit for a terminal."""

from collections import Counter
from collections.abc import Iterable


def printable(text: str) -> str:
    """`text` with everything escaped that a terminal would act upon or that changes the order of what is read: control
    and formatting characters, bytes that aren't UTF-8. Line ends stay."""
    return "".join(c if c.isprintable() or c in "\n\u00a0\u202f" else c.encode("unicode_escape").decode() for c in text)


def reason_counts(reasons: Iterable[str]) -> Counter[str]:
    """How often each reason occurs. Reasons that differ behind their first colon, by their figures, count as one."""
    counts = Counter(reasons)
    kinds = Counter(reason.partition(":")[0] for reason in counts)
    together: Counter[str] = Counter()
    for reason, count in counts.items():
        kind = reason.partition(":")[0]
        together[kind if kinds[kind] > 1 else reason] += count
    return together
