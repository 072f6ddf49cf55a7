"""The sources of the core, and where a name stands in them."""

import re
from pathlib import Path

import vibench

SOURCES = sorted(Path(str(vibench.__file__)).parent.rglob("*.py"))


def mentions(name: str, text: str) -> list[str]:
    """Lines with a name as a word of its own, in capitals or not, with '-' or '_'."""
    word = re.compile(rf"(?<![\w-]){'[-_]'.join(map(re.escape, name.split('-')))}(?![\w-])", re.IGNORECASE)
    return [line.strip() for line in text.splitlines() if word.search(line)]
