"""What an output may not hold, control characters and HTML that is not its own; and where it leads."""

from html.parser import HTMLParser


def clean(text: str) -> bool:
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


class Links(HTMLParser):
    """What a page fetches (`sources`), what it leads to (`targets`), and the anchors that it has."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.targets: list[str] = []
        self.ids: set[str] = set()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "src" or (name == "href" and tag == "link"):
                self.sources.append(str(value))
            elif name == "href":
                self.targets.append(str(value))
            elif name == "id":
                self.ids.add(str(value))
