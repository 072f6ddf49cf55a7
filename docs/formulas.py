r"""Formulas of the documentation, LaTeX in the sources and MathML in the pages: nothing has to run where they are read.

`$…$` stands in a line. A block that begins and ends with `$$` stands alone; `\tag{7}` in it gives it the number (7) and
makes it the target of `[(7)](#eq-7)`.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.blockprocessors import BlockProcessor
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.util import AtomicString

NAMESPACE = "http://www.w3.org/1998/Math/MathML"
LIMITS = {"msub": "munder", "msup": "mover", "msubsup": "munderover"}
OPERATORS = {"min", "max", "inf", "sup", "∑"}
BARS = {"|", "∣", "‖"}
TAG = re.compile(r"\\tag\{(\w+)\}")


def mathml(latex: str, display: str) -> str:
    """MathML of a formula, "inline" or "block".

    Raises
    ------
    ValueError
        If the converter leaves a command of LaTeX as it is.
    """
    ET.register_namespace("", NAMESPACE)
    try:
        root = ET.fromstring(convert(latex.strip(), display=display))
    except ET.ParseError as error:
        raise ValueError(f"the formula '{latex}' has no MathML: {error}") from None
    left = re.findall(r"\\\w*|&", "".join(root.itertext()))
    if left:
        raise ValueError(f"the formula '{latex}' keeps {left[0]}: the converter does not know it")
    rows, expected = len(root.findall(f".//{{{NAMESPACE}}}mtr")), latex.count(r"\\") + latex.count(r"\begin")
    if rows != expected:
        raise ValueError(f"the formula '{latex}' has {rows} rows in MathML, expected {expected}")
    if display == "block":
        _set_limits(root)
    _for_browsers(root)
    return ET.tostring(root, encoding="unicode")


def _set_limits(parent: ET.Element) -> None:
    """What stands below and above large operators, which the converter puts beside them; not in fractions."""
    for element in parent:
        name = element.tag.removeprefix(f"{{{NAMESPACE}}}")
        if name in LIMITS and (element[0].text or "").strip() in OPERATORS:
            element.tag = f"{{{NAMESPACE}}}{LIMITS[name]}"
        if name != "mfrac":
            _set_limits(element)


def _for_browsers(root: ET.Element) -> None:
    """Bars as high as they are meant, and columns aligned in words that browsers know."""
    for bar in root.iter(f"{{{NAMESPACE}}}mo"):
        if bar.text in BARS and "stretchy" not in bar.attrib:
            bar.set("stretchy", "false")
    for cell in root.iter(f"{{{NAMESPACE}}}mtd"):
        if "columnalign" in cell.attrib:
            cell.set("style", f"text-align: {cell.attrib['columnalign']}")


class _InLine(InlineProcessor):
    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:  # type: ignore[override] # noqa: ARG002, N802
        return self.md.htmlStash.store(mathml(m[1], "inline")), m.start(0), m.end(0)


class _Alone(BlockProcessor):
    def test(self, parent: ET.Element, block: str) -> bool:  # noqa: ARG002
        return block.startswith("$$") and block.rstrip().endswith("$$")

    def run(self, parent: ET.Element, blocks: list[str]) -> None:
        latex = blocks.pop(0).strip().strip("$")
        number = TAG.search(latex)
        equation = ET.SubElement(parent, "div", {"class": "equation"})
        formula = ET.SubElement(equation, "div")
        formula.text = AtomicString(self.parser.md.htmlStash.store(mathml(TAG.sub("", latex), "block")))
        if number:
            equation.set("id", f"eq-{number[1]}")
            ET.SubElement(equation, "span").text = AtomicString(f"({number[1]})")


class Formulas(Extension):
    """The extension of Python-Markdown that does it."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        """Register both kinds, formulas in a line after code."""
        md.inlinePatterns.register(_InLine(r"(?<![\\\w$])\$(?=[^\s$])([^$]+?)(?<!\s)\$(?![\w$])", md), "formula", 185)
        md.parser.blockprocessors.register(_Alone(md.parser), "formula", 100)
