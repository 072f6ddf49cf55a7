import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibench.benchmarks.comparison import read_benchmarks
from vibench.errors import RequestError, in_a_line
from vibench.results.sqlite import study_of
from vibench.text import LONGEST, above, brief, one_line, parsed_json, printable, printable_lines, unbroken

ANYTHING = st.text(st.characters())
"""All of Unicode: `st.text()` alone draws no surrogates."""


@given(ANYTHING)
def test_what_comes_out_is_printable_and_stays_as_it_is(text: str) -> None:
    for clean in (printable, unbroken, brief, one_line):
        shown = clean(text)
        assert shown.isprintable()
        assert clean(shown) == shown
        assert shown.encode("utf-8").decode("utf-8") == shown


@given(st.text(st.characters(exclude_categories=("C", "Z")), max_size=LONGEST))
def test_what_is_printable_is_not_touched(text: str) -> None:
    assert printable(text) == unbroken(text) == brief(text) == one_line(text) == text


def test_what_is_not_printable_is_shown_as_an_escape() -> None:
    for text, shown in (
        ("\x1b[31mred", r"\u001b[31mred"), ("\ud800", r"\ud800"), ("a\r\nb", r"a\r\nb"), ("\u202eabc", r"\u202eabc"),
        ("\x00\x7f\x9b", r"\u0000\u007f\u009b"), ("\U000e0001", r"\udb40\udc01"), ("a\u00a0b", r"a\u00a0b"),
        (r"\u001b", r"\u001b"), ("a b", "a b"),
    ):  # fmt: skip
        assert printable(text) == shown
    assert printable_lines("a\n\x1bb\r\n") == "a\n\\u001bb\\r\n"
    assert one_line("  the wire\n\tsnapped\u2028 twice ") == "the wire snapped twice"


@given(st.recursive(st.text() | st.integers() | st.none(), lambda part: st.dictionaries(st.text(), part, max_size=3)))
def test_json_has_the_same_content_afterwards(content: object) -> None:
    assert json.loads(printable(json.dumps(content, ensure_ascii=False))) == content


class UnreadableError(Exception):
    def __str__(self) -> str:
        raise ValueError("not to be read")


def test_long_texts_and_messages_of_exceptions_are_cut_to_one_line() -> None:
    for clean in (brief, one_line):
        for unit in ("x", "x ", "\x1b", "µ", "\n"):
            text = unit * 50_000
            shown = clean(text)
            assert shown.endswith(f"… ({len(text)} characters)")
            assert len(shown) <= LONGEST
            assert clean(shown) == shown
    assert in_a_line(UnreadableError()) == "UnreadableError: its message cannot be read"
    line = in_a_line(RuntimeError("the wire\nsnapped \x1b[2J\ud800" + 50_000_000 * "x"))
    assert line.startswith(r"RuntimeError: the wire snapped \u001b[2J\ud800xxx")
    assert line.endswith("… (50000036 characters)")
    assert len(line) <= LONGEST


@given(st.floats(1e-15, 1.0), st.floats(1.0 + 1e-12, 100.0))
def test_a_number_above_a_limit_is_said_with_digits_that_differ(limit: float, factor: float) -> None:
    value, _ = above(limit * factor, limit).split(" above ")
    assert float(value) > limit


def test_a_residual_just_above_the_accuracy_is_told_from_it() -> None:
    assert above(1.0234e-7, 1e-7) == "1.02e-07 above 1e-07"
    assert above(3.14e-7, 1e-7) == "3.1e-07 above 1e-07"
    assert above(1.0000001e-7, 1e-7) == "1.0000001e-07 above 1e-07"


@pytest.mark.parametrize("opening", ["[", '{"a": '])
def test_json_nested_beyond_the_stack_is_refused_in_a_line(opening: str, tmp_path: Path) -> None:
    assert parsed_json(b'{"a": [1.5]}') == {"a": [1.5]}
    with pytest.raises(ValueError, match="nested too deeply"):
        parsed_json(opening * 100_000)
    deep = tmp_path / "deep.json"
    deep.write_text("[" * 100_000)
    with pytest.raises(RequestError, match="cannot be read as a file of pytest-benchmark"):
        read_benchmarks(deep)
    with pytest.raises(RequestError, match="does not say which study"):
        study_of(deep, {"study": "[" * 100_000})
