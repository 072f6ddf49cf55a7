"""What an output may not hold, whoever says it: control characters, and elements of HTML that are not its own."""

from __future__ import annotations

from html.parser import HTMLParser


def clean(text: str) -> bool:
    """Whether a text has no control characters but the ends of its lines."""
    return all(line.isprintable() for line in text.split("\n"))


class _Elements(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found |= {tag, *(f"{tag}.{name}" for name, _ in attrs)}


def elements(page: str) -> set[str]:
    """The names of the elements of a page, and of their attributes as "img.src"."""
    parser = _Elements()
    parser.feed(page)
    return parser.found
