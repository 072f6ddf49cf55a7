"""The sentences of the pages that people read: none is long, none is full of numbers, and none chains genitives.

`python docs/prose.py` prints every sentence that is not so, with its page, and what is wrong; with exit code 1.
Tables, code, formulas and what is generated are no prose. It also counts pages, words, entries of the menu, and
pictures: the site stays one that can be read.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[1]
# Made from docstrings, or included from elsewhere.
ELSEWHERE = {"api", "changelog", "contributing", "glossary"}
# Lists of names, and claims that are compared one by one.
OTHERS = ELSEWHERE | {"reproduction", "commands", "tables"}
NUMBER = re.compile(r"(?<![\w.])\d[\d.,]*(?:e-?\d+)?")
CHAINS = re.compile(r"\b(those of|that of the|of which)\b")


def pages() -> Iterator[tuple[Path, str]]:
    """README, the pages of the documentation, and of results what stands before their files."""
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        if path.stem not in OTHERS:
            yield path, path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "results").glob("*/README.md")):
        # What stands in place of a picture is made from its axes.
        yield path, re.sub(r"^!.*$", "", path.read_text(encoding="utf-8").partition("\n## ")[0], flags=re.MULTILINE)


def sentences(text: str) -> Iterator[str]:
    """The sentences of a page, a formula or code in a line as one word."""
    text = re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!-- generated: .*?<!-- end: .*? -->|<!--.*?-->|\$\$.*?\$\$", "", text, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", re.sub(r"`[^`\n]*`|\$[^$\n]*\$", "code", text))
    text = re.sub(r"^\|.*$|^#.*$|^<a id=.*$|^ {4,}\S.*$|^[!?]{3}.*$|^-+$", "\n", text, flags=re.MULTILINE)
    for part in re.split(r"\n\s*\n|^\s*(?:[-*+]|\d+\.)\s", text, flags=re.MULTILINE):
        plain = " ".join(re.sub(r"<[^>]*>|[*_]{1,2}(?=\S)|(?<=\S)[*_]{1,2}", "", part).split())
        yield from filter(None, re.split(r"(?<=[.!?:;])\s+(?=[A-ZÄÖÜ(]|code\b)", plain))


def faults(sentence: str) -> Iterator[str]:
    """What is wrong with a sentence."""
    if (count := len(sentence.split())) > 35:
        yield f"{count} words"
    if (count := len(NUMBER.findall(sentence))) > 3:
        yield f"{count} numbers"
    if chain := CHAINS.search(sentence):
        yield f"'{chain[0]}'"


def excesses() -> Iterator[str]:
    """What the site has too much of, or too few."""
    own = [path for path in (ROOT / "docs").rglob("*.md") if path.stem not in ELSEWHERE]
    menu = re.findall(r"^ +- [^:\n]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    counts = {"pages": len(own), "entries of the menu": len(menu)}
    counts["words"] = sum(len(re.findall(r"\S*\w\S*", path.read_text(encoding="utf-8"))) for path in own)
    for (name, count), most in zip(counts.items(), (21, 25, 60_000), strict=True):
        print(f"{count:,} {name} of at most {most:,}")
        if count > most:
            yield f"too many {name}"
    bare = [page for page in menu[:6] if "![" not in (ROOT / "docs" / page).read_text(encoding="utf-8")]
    yield from (f"{page} is one of the first six pages and has no picture" for page in bare)


def main() -> None:
    """Print what is wrong with all pages."""
    wrong = 0
    for excess in excesses():
        print(excess)
        wrong += 1
    for path, text in pages():
        found = list(sentences(text))
        for sentence in found:
            for fault in faults(sentence):
                print(f"{path.relative_to(ROOT)}: {fault}: {sentence}")
                wrong += 1
        middle = median(len(one.split()) for one in found) if found else 15
        if not 10 <= middle <= 20 and path.parent.parent.name != "results":
            print(f"{path.relative_to(ROOT)}: the median sentence has {middle} words, not 10 to 20")
            wrong += 1
    print(f"{wrong} faults")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
