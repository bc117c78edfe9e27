"""Text from captures and files, made fit for a terminal."""


def printable(text: str) -> str:
    """`text` with everything escaped that a terminal would act upon or that changes the order of what is read: control
    and formatting characters, bytes that aren't UTF-8. Line ends stay."""
    return "".join(c if c.isprintable() or c in "\n\u00a0\u202f" else c.encode("unicode_escape").decode() for c in text)
