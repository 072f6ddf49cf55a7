"""Whether every page of the built site fits narrow and wide screens: what is wider scrolls inside itself.

Usage: python tests/benchmarks/site_widths.py SITE

Prints every page that is wider than its window, or has an element that ends beyond it; then the exit code is 1.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.browsing import chromium, look, resize

WIDTHS = 1280, 390

BEYOND = """
const width = document.documentElement.clientWidth;
const scrolls = element => ["auto", "scroll", "hidden"].includes(getComputedStyle(element).overflowX);
const inside = element => {
    for (let up = element.parentElement; up !== document.body; up = up.parentElement)
        if (scrolls(up) && up.getBoundingClientRect().right <= width + 1) return true;
    return false;
};
const beyond = [...document.querySelectorAll(".md-content *")].filter(element => {
    const box = element.getBoundingClientRect();
    return box.width && box.right > width + 1 && !inside(element);
});
const wide = document.documentElement.scrollWidth > width;
const named = beyond.slice(0, 3).map(one => `${one.tagName} ${one.textContent.slice(0, 40)}`);
return [...(wide ? ["the page"] : []), ...named];
"""
"""Elements that end beyond the window and are in none that scrolls: the page itself first."""


def main(site: str) -> None:
    lines = list(faults(Path(site).resolve()))
    print("\n".join(lines) or f"{site}: every page fits {' and '.join(map(str, WIDTHS))} pixels")
    sys.exit(bool(lines))


def faults(site: Path) -> Iterator[str]:
    pages = sorted(page for page in site.rglob("*.html") if page.name != "404.html")
    if not pages:
        sys.exit(f"{site}: no pages")
    with tempfile.TemporaryDirectory() as downloads, chromium(Path(downloads)) as browser:
        for page in pages:
            look(browser, page)
            for width in WIDTHS:
                resize(browser, width)
                if found := browser.execute_script(BEYOND):
                    yield f"{page.relative_to(site)} at {width}: {'; '.join(found)}"


if __name__ == "__main__":
    main(*sys.argv[1:])
