"""What mkdocs does beside its own work: formulas, sentences, the pages of `results/`, a check of every page."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from formulas import Formulas
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File
from reference import filled
from sentences import rendered

RESULTS = "results"
"""Folder of the repository, and of the site, with the pages of results."""

SHOWN = {".md", ".png", ".csv", ".npz"}
ELSEWHERE = re.compile(
    r"""<(?:script|img|iframe|link\s[^>]*rel=["']?stylesheet)[^>]*(?:src|href)=["']?(?:https?:)?//"""
)


def on_config(config: Any) -> Any:
    """Let Markdown know formulas."""
    config.markdown_extensions.append(Formulas())
    return config


def on_files(files: Any, config: Any) -> Any:
    """Put the pages of results with their files on the site, and the notebook as a page."""
    root = Path(config.config_file_path).parent
    for path in sorted((root / RESULTS).rglob("*")):
        if path.suffix in SHOWN:
            name = path.relative_to(root).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(path)))
    notebook = json.loads((root / "examples" / "decision.ipynb").read_text(encoding="utf-8"))
    cells = [(cell["cell_type"] == "code", "".join(cell["source"])) for cell in notebook["cells"]]
    texts = [f"```python\n{source}\n```" if is_code else source for is_code, source in cells]
    files.append(File.generated(config, "decision.md", content="\n\n".join(texts)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Render sentences and reference tables, and correct links to `results/`, which is nested on the site."""
    markdown = filled(rendered(markdown))
    up = "../" * page.file.src_uri.count("/")
    if page.file.src_uri.startswith(f"{RESULTS}/"):
        return markdown.replace(f"]({up}docs/", f"]({up}")
    return markdown.replace(f"](../{up}{RESULTS}/", f"]({up}{RESULTS}/")


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
