"""What mkdocs does beside its own work: formulas, generated tables, figures from `results/`, a check of every page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from formulas import Formulas
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from reference import GENERATED

FIGURES = ("paper-obstacle", "paper-hertz", "field")
TWINS = "paper-figures"
ELSEWHERE = re.compile(
    r"""<(?:script|img|iframe|link\s[^>]*rel=["']?stylesheet)[^>]*(?:src|href)=["']?(?:https?:)?//"""
)


def on_config(config: Any) -> Any:
    """Let Markdown know formulas."""
    config.markdown_extensions.append(Formulas())
    return config


def on_files(files: Any, config: Any) -> Any:
    """Put the figures that were measured last beside the pages, under `figures/`."""
    results = Path(config.config_file_path).parent / "results"
    for study in FIGURES:
        for path in sorted((results / study).glob("*.png")):
            files.append(File.generated(config, f"figures/{path.name}", abs_src_path=str(path)))
    for path in sorted((results / TWINS).glob("*")):  # a page with its figures
        files.append(File.generated(config, f"{TWINS}/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Fill in what is generated."""

    def fill(found: re.Match[str]) -> str:
        if found[1] not in GENERATED:
            raise PluginError(f"{page.file.src_uri}: nothing generates '{found[1]}', only {', '.join(GENERATED)}")
        return GENERATED[found[1]]()

    return re.sub(r"<!-- generated: ([\w-]+) -->", fill, markdown)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Refuse a page that would load something from elsewhere.

    Raises
    ------
    PluginError
        Naming the page and the tag.
    """
    loaded = ELSEWHERE.search(output)
    if loaded:
        raise PluginError(f"{page.file.src_uri} loads something from elsewhere: {loaded[0]}")
    return output
