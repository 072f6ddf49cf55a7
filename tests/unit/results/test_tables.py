import csv
import dataclasses
import io
import json
import math
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import QUICK_ROUNDS, cell_row, query_rows

from vibench import RequestError
from vibench.results import read, show, sqlite
from vibench.results.break_even import break_even_rows
from vibench.results.database import ResultsDatabase
from vibench.results.formats import break_even_table, cell_text, summary, to_csv, to_json, to_latex, to_markdown
from vibench.results.read import in_order, read_table, results_file
from vibench.results.schema import KEYS, STORED, TABLES, VERSION
from vibench.results.show import Table, export, look_up
from vibench.results.sqlite import FILE, parameters_of
from vibench.study.matrix import expand, read_study
from vibench.text import printable_lines

STUDY = {"name": "sample", "seed": 1, "validation": 4, "accuracy": 1e-7}

CELL = cell_row(
    problem="box", dual="greedy", primal="plain", pod_tol=1e-3, pod_size=None, dual_tol=1e-2, dual_size=None,
    primal_tol=None, solver="piqp", queries=4, queries_ok=4, N=12, R=7, enrichment=3, offline_s=1.5, online_s=0.0025,
)  # fmt: skip


def cells(*changes: dict[str, Any]) -> pd.DataFrame:
    rows = [CELL | {"cell": str(k)} | change for k, change in enumerate(changes)]
    return pd.DataFrame(rows, columns=list(STORED["cells"]))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder with two cells, one of which never got an answer."""
    journal = ResultsDatabase(tmp_path / "runs" / "sample", STUDY)
    failed = {"cell": "c2", "status": "error", "reason": "broke", "queries": 4, "queries_ok": 0}
    missing = dict.fromkeys(STORED["cells"]) | failed
    output = {"cell": "c1", "output": "force", "unit": "N", "scale": 2.0, "queries_ok": 4, "error_mean": 0.1}
    journal.write_cell(CELL | {"cell": "c1"}, query_rows("c1", 4, gap=1.0 / 3.0), outputs=[output])
    journal.write_cell(missing | {name: CELL[name] for name in KEYS} | {"solver": "osqp"}, [])
    journal.write_histories([[{"artefact": "pod-1", "quantity": "error", "step": 0, "value": 1.0}]])
    timed = [{"cell": "c1", "round": 0, "total_s": 1.0}]
    journal.write_seconds("c1", {"timing_rounds": 1}, {0: {"solve_s": 0.5}}, timed)
    journal.replace("thresholds", break_even_rows(journal.rows("cells"), []))
    journal.replace("disagreements", [{"solver_a": "osqp", "solver_b": "piqp", "queries": 4, "flagged": 0}])
    journal.close()
    return tmp_path / "runs" / "sample"


def test_runs_are_found_or_refused(run: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert (results_file(str(run)), results_file(str(run / FILE))) == (run / FILE, run / FILE)
    monkeypatch.chdir(run.parent.parent)
    assert results_file("sample").resolve() == run / FILE
    with pytest.raises(RequestError, match=r"no results in '.*nothing'.*results\.sqlite"):
        results_file(str(tmp_path / "nothing"))
    (tmp_path / FILE).write_text("hello")
    with pytest.raises(RequestError, match="not a results file"):
        results_file(str(tmp_path))
    monkeypatch.setattr(read, "VERSION", VERSION + 1)
    with pytest.raises(RequestError, match=f"schema {VERSION}.*reads {VERSION + 1}"):
        results_file(str(run))


def test_tables_are_read_whole_and_exported_in_order_with_every_digit(run: Path, tmp_path: Path) -> None:
    before, names = (run / FILE).read_bytes(), sorted(path.name for path in run.iterdir())
    for table in TABLES:
        frame = read_table(run / FILE, table)
        assert [name for name in frame.columns if not name.startswith("mu_")] == list(STORED[table])
        assert len(frame) == {"cells": 2, "queries": 4, "calibrations": 0}.get(table, 1)
    with pytest.raises(RequestError, match="cannot be read: no such table"):
        read_table(run / FILE, "cells; DELETE FROM cells")
    assert ((run / FILE).read_bytes(), sorted(path.name for path in run.iterdir())) == (before, names)
    files = export(run / FILE, tmp_path / "out" / "tables")
    names = [*(f"{table}.csv" for table in TABLES), "summary.md"]
    assert [path.name for path in files] == names
    assert sorted(path.name for path in (tmp_path / "out" / "tables").iterdir()) == sorted(names)
    for path in files:
        path.write_text("old")
    assert export(run / FILE, tmp_path / "out" / "tables") == files
    assert all(path.read_text(encoding="utf-8").strip() not in ("", "old") for path in files)
    for table in TABLES:
        with (tmp_path / "out" / "tables" / f"{table}.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        expected = in_order(read_table(run / FILE, table))
        assert len(rows) == len(expected)
        for name in expected:
            if pd.api.types.is_numeric_dtype(expected[name]):
                values = [float(row[name] or "nan") for row in rows]
                np.testing.assert_array_equal(values, expected[name].to_numpy(float))


@pytest.mark.parametrize("rows", [1, 3, 4096])
def test_large_tables_are_read_and_written_in_parts(run: Path, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = sqlite.Digests._opened

    def smaller(self: sqlite.Digests, *asked: Any) -> Any:
        names, cursor = opened(self, *asked)
        cursor.arraysize = rows
        return names, cursor

    monkeypatch.setattr(sqlite.Digests, "_opened", smaller)
    path = results_file(str(run))
    assert [len(part) for part in read.read_in_parts(path, "queries")] == {1: [1] * 4, 3: [3, 1], 4096: [4]}[rows]
    export(path, run / "tables")
    for table in TABLES:
        whole = to_csv(read.whole_numbers(in_order(read_table(path, table))))
        assert (run / "tables" / f"{table}.csv").read_text() == whole


def test_rows_are_in_the_order_of_their_keys_loose_tolerances_and_small_sizes_first() -> None:
    frame = cells({"solver": "b"}, {"dual": "a"}, {"problem": "a"}, {"solver": "a"}, {"primal": "z"})
    assert list(in_order(frame)["cell"]) == ["2", "1", "3", "0", "4"]
    frame = cells({"pod_tol": 1e-4}, {"pod_tol": 1e-2}, {"pod_tol": 1e-3}, {"primal_tol": 0.5}, {"primal_tol": 0.9})
    assert list(in_order(frame)["pod_tol"]) == sorted(frame["pod_tol"], reverse=True)
    assert list(in_order(frame[3:])["primal_tol"]) == [0.9, 0.5]
    frame = cells(*({"pod_tol": None, "pod_size": size} for size in (9, 3, 12)))
    assert list(in_order(frame)["pod_size"]) == [3, 9, 12]


@given(st.permutations(range(8)))
def test_the_order_does_not_depend_on_who_was_first(order: list[int]) -> None:
    frame = cells(*({"solver": s, "dual": d, "pod_tol": t} for s in "ab" for d in "xy" for t in (0.1, 0.01)))
    shuffled = frame.iloc[order]
    assert list(in_order(shuffled)["cell"]) == list(in_order(frame)["cell"])


def test_the_summary_has_a_line_for_every_cell_and_counts_zero_solutions_where_there_are_any(run: Path) -> None:
    frame = summary(read_table(run / FILE, "cells"))
    first, second = frame.to_dict("records")
    assert (first["solver"], first["ok"]) == ("osqp", "0/4")
    assert (second["solver"], second["ok"]) == ("piqp", "4/4")
    assert (second["N"], second["R"], second["added"]) == (12, 7, 3)
    assert (second["δ_POD"], second["δ_dual"]) == ("0.001", "0.01")
    assert (second["offline [s]"], second["online [ms]"]) == (1.5, 2.5)
    assert pd.isna(first["N"])
    frame = summary(cells({"pod_tol": None, "pod_size": 9, "dual_tol": None, "dual_size": 4}))
    assert (frame["δ_POD"][0], frame["δ_dual"][0]) == ("N=9", "R=4")
    none = {"queries_zero_u": 0, "error_u_zero_max": None, "queries_zero_lambda": 0, "error_lambda_zero_max": None}
    some = none | {"queries_zero_lambda": 3, "error_lambda_zero_max": 1e-10}
    columns = {"u = 0", "error, u = 0", "λ = 0", "error, λ = 0"}
    assert not columns & set(summary(cells(none)).columns)
    shown = summary(cells(none, some | {"solver": "z"}))
    assert columns & set(shown.columns) == {"λ = 0", "error, λ = 0"}
    assert (list(shown["λ = 0"]), shown["error, λ = 0"][1]) == ([0, 3], 1e-10)


def rounds(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        {"cell": c["cell"], "round": k, "block": str(k // 3), "total_s": c["online_s"], "hf_s": c["hf_s"], "pace": 1.0}
        for c in cells
        for k in range(6)
    ]


def test_values_are_printed_with_three_digits_and_the_benefits_say_from_when_on_a_strategy_pays() -> None:
    a = CELL | {"cell": "a", "enrichment_kind": "per-parameter", "primal": "varying", "online_s": 0.004, "hf_s": 0.1}
    b = CELL | {"cell": "b", "enrichment_kind": "fixed", "primal": "fixed", "offline_s": 2.5, "hf_s": 0.1}
    frame = break_even_table(pd.DataFrame(break_even_rows([a, b], rounds([a, b])), columns=list(STORED["thresholds"])))
    paired = frame[(frame["against"] == "varying") & (frame["model"] == "fixed")].iloc[0]
    assert paired["break-even"] == f"from {(2.5 - 1.5) / (0.004 - 0.0025):.0f}"
    assert list(paired[["offline against [s]", "online against [ms]", "online [ms]"]]) == pytest.approx([1.5, 4.0, 2.5])
    low, high = map(int, paired["interval"].split("–"))
    assert low < 1 / 0.0015 < high
    assert len(frame) == 3
    slow = CELL | {"hf_s": 0.001, "enrichment_kind": "none"}
    frame = pd.DataFrame(break_even_rows([slow], rounds([slow])), columns=list(STORED["thresholds"]))
    assert list(break_even_table(frame)["break-even"]) == ["never"]
    assert summary(cells()).empty
    assert break_even_table(pd.DataFrame(columns=list(STORED["thresholds"]))).empty
    for columns in (STORED["cells"], STORED["queries"], STORED["histories"]):
        assert in_order(pd.DataFrame(columns=list(columns))).empty
    for value, text in (
        (3, "3"), (3.0, "3"), (0.0, "0"), (0.123456, "0.123"), (1234567.0, "1.23e+06"), (1e-7, "1e-07"), (None, ""),
        (float("nan"), ""), (pd.NA, ""), (np.float64(2.5), "2.5"), (np.int64(4), "4"), ("word", "word"), ("", ""),
        (float("inf"), "inf"), (-2.0, "-2"), (999999.0, "999999"),
    ):  # fmt: skip
        assert cell_text(value) == text


def test_csv_quotes_what_it_must_leaves_numbers_alone_and_has_no_formulas() -> None:
    frame = pd.DataFrame({"name": ["a,b", 'c"d', "e\nf"], "value": [1.0 / 3.0, None, 1e-300]})
    header, *rows = csv.reader(io.StringIO(to_csv(frame)))
    assert header == ["name", "value"]
    assert [(name, float(value or "inf")) for name, value in rows] == [
        ("a,b", 1.0 / 3.0), ('c"d', float("inf")), ("e\nf", 1e-300),
    ]  # fmt: skip
    values = {"number": [-1.5, float("inf"), -float("inf"), None], "text": ["-1.5", "+2", "-1e-7", "-inf"]}
    _, *rows = csv.reader(io.StringIO(to_csv(pd.DataFrame(values))))
    assert [row for row, _ in rows] == ["-1.5", "inf", "-inf", ""]
    assert [row for _, row in rows] == ["-1.5", "+2", "-1e-7", "-inf"]
    # As OWASP advises: spreadsheets take what begins with these characters for a formula, an apostrophe for text.
    for text in ("=1+1", "+1+1", "-1+1", "@SUM(1)", "\n=1", "＝1+1", "=HYPERLINK(1)", "-2+cmd|a!A0"):
        frame = pd.read_csv(io.StringIO(to_csv(pd.DataFrame({"name": [text], text: [f"a {text}"]}))))
        assert list(frame.columns) == ["name", f"'{text}"]
        assert frame.iloc[0].tolist() == [f"'{text}", f"a {text}"]


def test_markdown_has_a_line_per_row_and_shows_text_as_it_is() -> None:
    lines = to_markdown(pd.DataFrame({"name": ["a", "007"], "value": [0.123456, None]})).splitlines()
    assert [[word.strip() for word in line.strip("|").split("|")] for line in lines if "--" not in line] == [
        ["name", "value"], ["a", "0.123"], ["007", ""],
    ]  # fmt: skip
    for text in ("a|b", "a\nb", "a\\|b", "|", "\\"):
        lines = to_markdown(pd.DataFrame({"name": [text, "c"], "value": [1, 2]})).splitlines()
        assert len(lines) == 4
        assert {len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) for line in lines} == {3}
    for text, escaped in (
        ("<img src=x onerror=alert(1)>", "&lt;img src=x onerror=alert(1)&gt;"), ("`rm`", r"\`rm\`"),
        ("[a](javascript:b) [c][d] ![e](f)", r"[a\](javascript:b) [c\][d] ![e\](f)"),
        ("*a* _b_ __c__", r"\*a\* \_b\_ \_\_c\_\_"),
        ("&lt;", "&amp;lt;"), ("$x$ ~~y~~", "&#36;x&#36; &#126;&#126;y&#126;&#126;"), (r"\*", r"\\\*"),
        ("dual_residual of offline-pga, δ = 0.1 [ms] (95 %)", "dual_residual of offline-pga, δ = 0.1 [ms] (95 %)"),
    ):  # fmt: skip
        lines = to_markdown(pd.DataFrame({"name": [text], text: ["a"]})).splitlines()
        assert lines[2].strip("| ").split("|")[0].strip() == escaped
        assert lines[0].strip("| ").rpartition("|")[2].strip() == escaped


@given(st.text(st.characters()))
def test_markdown_has_no_markup_of_others(text: str) -> None:
    page = to_markdown(pd.DataFrame({"name": [text, "c"]}))
    assert len(page.splitlines()) == 4
    assert not re.search(r"[<>~$]", page)
    assert not re.search(r"(?<!\\)(?:\\\\)*([`*]|\][(\[])", page)


@given(st.lists(st.text(st.characters()), max_size=5))
def test_csv_read_again_has_the_same_texts(texts: list[str]) -> None:
    _, *rows = csv.reader(io.StringIO(to_csv(pd.DataFrame({"name": texts, "k": 1})), newline=""))
    shown = list(map(printable_lines, texts))
    assert [name if name in shown else name.removeprefix("'") for name, _ in rows] == shown
    assert not any(name.startswith(("=", "@", "\t", "\r", "\n")) for name, _ in rows)


@given(st.text(st.characters()))
def test_json_is_printable_and_has_the_same_texts(text: str) -> None:
    page = to_json(pd.DataFrame({"name": [text]}))
    assert all(line.isprintable() for line in page.split("\n"))
    whole = text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")  # JSON joins two halves
    assert json.loads(page) == [{"name": whole}]


def test_latex_shows_text_as_it_is_and_json_no_text_for_infinite_numbers() -> None:
    r"""A row that begins with [ or * would be an argument of \\ or \midrule before it."""
    page = to_latex(pd.DataFrame({"name": ["[2cm] a", "*b", r"\input{x}% <c> | 5 $ #_~^&"]}))
    assert page.splitlines()[5:8] == [
        r"{[}2cm] a \\", r"{*}b \\",
        r"\textbackslash{}input\{x\}\% \textless{}c\textgreater{} \textbar{} 5 \$ \#\_\textasciitilde{}"
        r"\textasciicircum{}\& \\",
    ]  # fmt: skip
    values = [1.0 / 3.0, math.inf, -math.inf, None]
    page = to_json(pd.DataFrame({"bound": values, "text": ["inf", "Infinity", "NaN", ""]}))
    assert "Infinity," not in page.replace('"Infinity",', "")
    assert [row["bound"] for row in json.loads(page)] == values
    assert [row["text"] for row in json.loads(page)] == ["inf", "Infinity", "NaN", ""]


COMMAND = re.compile(r"\\(?:[a-zA-Z]+|[&%$#_{}\\,|])")


def test_seconds_that_are_missing_have_a_word(quick_run: Path) -> None:
    table = look_up(quick_run / FILE, "summary")
    some = table.rows.assign(online_s=table.rows["online_s"].where(table.rows["solver"] == "piqp"))
    shown = dataclasses.replace(table, rows=some).readable
    assert {value == "not timed" for value in shown["online [ms]"][some["solver"] != "piqp"]} == {True}
    assert {isinstance(value, float) for value in shown["online [ms]"][some["solver"] == "piqp"]} == {True}


@pytest.mark.parametrize("view", ["summary", "benefits", "disagreements"])
def test_latex_of_a_run_compiles(view: str, quick_run: Path, tmp_path: Path) -> None:
    """Every row has as many cells, braces match, and all signs are those that any engine knows."""
    page = to_latex(look_up(quick_run / FILE, view).readable)
    assert page.isascii()
    comment, *lines = page.splitlines()
    assert comment == r"% needs \usepackage{booktabs}"
    columns = len(re.fullmatch(r"\\begin\{tabular\}\{([lr]+)\}", lines[0])[1])
    rows = [line for line in lines[1:-1] if not line.endswith("rule")]
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {columns - 1}
    assert all(row.endswith(r" \\") for row in rows)
    for row in rows:
        bare = re.sub(r"\$[^$]*\$", "", COMMAND.sub("", row.removesuffix(r" \\")).replace("&", ""))
        assert bare.count("{") == bare.count("}")
        assert not set(bare) & set("\\$%#_^~")
    if engine := shutil.which("pdflatex"):
        head, end = r"\documentclass{article}\usepackage{booktabs}\begin{document}", r"\end{document}"
        (tmp_path / "page.tex").write_text(f"{head}{page}{end}")
        subprocess.run([engine, "-halt-on-error", "page.tex"], cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)


def test_a_real_run_exports_its_whole_matrix_and_times_what_its_cells_are_made_of(quick_run: Path) -> None:
    expected = expand(read_study(str(quick_run.with_suffix(".toml"))))
    frame = pd.read_csv(quick_run / "tables" / "cells.csv")
    assert set(frame["cell"]) == {cell.key for cell in expected}
    assert len(pd.read_csv(quick_run / "tables" / "queries.csv")) == frame["queries"].sum()
    written = (quick_run / "tables" / "summary.md").read_text(encoding="utf-8")
    assert len(written.splitlines()) == len(expected) + 2
    frame = read_table(quick_run / FILE, "cells")
    parts = [f"offline_{part}_s" for part in ("snapshots", "pod", "cone", "enrichment", "assembly")]
    np.testing.assert_allclose(frame[parts].sum(axis=1), frame["offline_s"])
    queries = read_table(quick_run / FILE, "queries")
    fine = queries[queries["status"] == "ok"].groupby("cell")
    by_cell = read_table(quick_run / FILE, "timings").set_index("cell")
    np.testing.assert_allclose(by_cell["assemble_s"] + by_cell["solve_s"], by_cell["total_s"])
    quartiles = by_cell.groupby("cell")["total_s"].quantile([0.25, 0.5, 0.75]).unstack().loc[frame["cell"]]
    np.testing.assert_allclose(quartiles[[0.25, 0.75]], frame[["online_q1_s", "online_q3_s"]])
    for column, seconds in (("online_s", "total_s"), ("hf_s", "hf_s")):
        paced = np.log(by_cell[seconds] / by_cell["pace"]).groupby([by_cell.index, by_cell["block"]]).median()
        np.testing.assert_allclose(np.exp(paced.groupby("cell").mean()).loc[frame["cell"]], frame[column])
    assert set(by_cell.groupby("cell").size()) == {QUICK_ROUNDS}
    assert (frame["timing_rounds"] == QUICK_ROUNDS).all()
    np.testing.assert_array_equal(fine.size().loc[frame["cell"]], frame["queries_ok"])
    assert (frame[["offline_snapshots_s", "online_s", "hf_s"]] > 0.0).all(axis=None)


@pytest.mark.parametrize(
    ("table", "where", "sort"),
    [
        ("queries", "", ()), ("queries", "total_s > 0.001 and solver != 'osqp'", ("-primal_tol", "cell")),
        ("timings", "", ("-total_s",)), ("timings", "total_s > 0.001 and solver != 'osqp'", ("accuracy", "solver")),
    ],
)  # fmt: skip
def test_the_first_rows_are_those_of_the_whole_table_and_others_are_not_read(
    table: str, where: str, sort: tuple[str, ...], quick_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read_all = quick_run / FILE, read.read_table
    whole = look_up(path, table, where=where, sort=sort)
    sizes = []

    def noted(path: Path, name: str, cells: Sequence[str] = ()) -> pd.DataFrame:
        found = read_all(path, name, cells)
        sizes.extend([len(found)] * (name == table))
        return found

    monkeypatch.setattr(show, "read_table", noted)
    first = look_up(path, table, where=where, sort=sort, limit=3)
    pd.testing.assert_frame_equal(first.rows, whole.rows.head(3))
    assert (first.columns, first.varying) == (whole.columns, whole.varying)
    cell = str(whole.rows["cell"].iloc[-1])
    of_cell = look_up(path, table, cell=cell, where=where, sort=sort)
    mine = whole.rows[whole.rows["cell"] == cell].reset_index(drop=True)
    pd.testing.assert_frame_equal(of_cell.rows, mine, check_dtype=False)
    assert len(sizes) == 2
    assert max(sizes) < len(read_all(path, table)) / 4


NAMES = (("radius", "m"), ("friction", "1"))


def write(journal: ResultsDatabase, problem: str, *names: tuple[str, str]) -> None:
    rows = [row | {"problem": problem} for row in query_rows(problem)]
    journal.write_cell(cell_row(problem, problem=problem), rows, parameters=names)


def queries(tmp_path: Path, **asked: object) -> Table:
    return look_up(tmp_path / "run" / FILE, "queries", **asked)


def test_names_are_shown_to_readers_and_asked_for_by_either_name(journal: ResultsDatabase, tmp_path: Path) -> None:
    write(journal, "disc", *NAMES)
    table = queries(tmp_path)
    assert {"radius [m]", "friction"} <= set(table.readable.columns)
    assert not {"mu_1", "mu_2"} & {*table.readable.columns, *table.priority}
    assert {"mu_1", "mu_2"} <= set(table.exact.columns)
    asked = queries(tmp_path, columns=["query", "radius"], sort=["-radius"])
    assert list(asked.readable.columns) == ["query", "radius [m]"]
    pd.testing.assert_frame_equal(asked.rows, queries(tmp_path, columns=["query", "mu_1"], sort=["-mu_1"]).rows)
    assert list(asked.rows["query"]) == [1, 0]


def test_names_of_several_problems_stand_side_by_side(journal: ResultsDatabase, tmp_path: Path) -> None:
    write(journal, "disc", *NAMES)
    write(journal, "rope", ("load", "N"))
    assert {"radius [m] / load [N]", "friction"} <= set(queries(tmp_path).readable.columns)
    assert "load [N]" in queries(tmp_path, where="problem = 'rope'").readable.columns


@pytest.mark.parametrize("name", ["status", "mu_2"])
def test_a_parameter_called_like_a_column_takes_no_place(journal: ResultsDatabase, tmp_path: Path, name: str) -> None:
    write(journal, "disc", (name, "1"))
    table = queries(tmp_path, columns=[name, "mu_1"])
    assert (list(table.exact.columns), list(table.readable.columns)) == ([name, "mu_1"], [name, "mu_1"])


def test_results_without_names_have_columns_all_the_same(journal: ResultsDatabase, tmp_path: Path) -> None:
    write(journal, "disc")
    assert "mu_1" in queries(tmp_path).readable.columns


def test_names_are_written_where_they_changed_or_refused_in_a_line(journal: ResultsDatabase, tmp_path: Path) -> None:
    for names in (NAMES, NAMES, NAMES[::-1]):
        write(journal, "disc", *names)
        assert parameters_of(tmp_path / "run" / FILE) == {"disc": list(names)}
    path = tmp_path / "run" / FILE
    journal._db.execute("UPDATE meta SET value = '[1, 2]' WHERE key LIKE 'parameters of %'")
    journal._digests.forget(name="meta")
    journal._digests.count("meta")
    journal._db.commit()
    with pytest.raises(RequestError, match=r"has '\[1, 2\]' as the parameters of disc, expected pairs of texts"):
        parameters_of(path)
