import html
import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image
from running import DECIDED, Changed, Main, execute

from vibench import RequestError, read_study
from vibench.report import figures, save, styled
from vibench.report.figures import KINDS, answer_sheet, draw_all, effectivity, spaces
from vibench.report.figures import problem_tables as of_file
from vibench.report.figures.data import ProblemTables, _per_combination
from vibench.report.figures.style import set_ticks
from vibench.report.html import page as report_page
from vibench.results.read import read_table
from vibench.results.sqlite import FILE
from vibench.results.verdict import verdicts

Drawn = dict[str, Figure]


@pytest.fixture
def results(changed: Changed) -> Path:
    return changed()


Change = Callable[..., None]
Draw = Callable[..., Drawn]
Tables = dict[str, ProblemTables]


@pytest.fixture(scope="module")
def tables(quick_run: Path) -> Tables:
    return dict(of_file(quick_run / FILE))


@pytest.fixture
def change(results: Path) -> Change:
    return partial(execute, results.parent)


def drawn_from(results: Path, folder: Path, *kinds: str, rendered: bool = False) -> Drawn:
    """Figures of a results file by the names of their files, of some kinds or all; files stay empty if not rendered."""
    kept: Drawn = {}
    write = Figure.savefig

    def keep(figure: Figure, target: Path, **options: object) -> None:
        target.touch(exist_ok=False)
        kept[target.stem] = figure
        # A vector graphic takes longer, and shows the same.
        if rendered and target.suffix == ".png":
            write(figure, target, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", keep)
        patch.setattr(figures, "KINDS", {kind: draw for kind, draw in KINDS.items() if not kinds or kind in kinds})
        files, failures = draw_all(results, folder, ("png", "svg"))
    assert failures == []
    assert [path.stem for path in files] == [name for name in kept for _ in ("png", "svg")]
    captions = ["captions.json"] * bool(files)
    assert sorted([path.name for path in files] + captions) == sorted(path.name for path in folder.glob("*"))
    return kept


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drawn") / "figures"


@pytest.fixture(scope="module")
def drawn(quick_run: Path, folder: Path) -> Drawn:
    """All of them: the only ones of these tests that are rendered."""
    return drawn_from(quick_run / FILE, folder, rendered=True)


@pytest.fixture
def draw(results: Path, tmp_path: Path) -> Draw:
    """Function that draws the copy: some kinds of figures, or all; every time in another folder."""
    folders = (tmp_path / f"figures-{k}" for k in count())
    return lambda *kinds: drawn_from(results, next(folders), *kinds)


def data_of(axes: Axes) -> list[np.ndarray]:
    values = [np.asarray(line.get_ydata(), float) for line in axes.get_lines()]
    return [found[np.isfinite(found)] for found in values if np.isfinite(found).any()]


def stability(figure: Figure) -> Axes:
    """The panel of the inf-sup constants of an answer sheet."""
    return next(axes for axes in figure.axes if axes.get_ylabel() == "β over span")


def line_called(axes: Axes, label: str) -> Line2D:
    (line,) = [line for line in axes.get_lines() if line.get_label() == label]
    return line


ONE_CONE = "DELETE FROM queries WHERE dual = 'cpg'"
"""All kinds of figures are drawn of one dual strategy, too, with half as many panels."""

ONE_PROBLEM = "DELETE FROM queries WHERE problem = 'hertz'"
ONE_PAIR = f"{ONE_PROBLEM} OR dual = 'cpg'"


def problems() -> list[str]:
    return [entry.title for entry in read_study("quick").problem]


def panels(figure: Figure) -> list[Axes]:
    """The panels of a figure that are shown, its colour bars left out."""
    return [axes for axes in figure.axes if axes.axison and "colorbar" not in str(axes.get_label())]


def test_every_figure_can_be_read(drawn: Drawn, folder: Path) -> None:
    """It is no blank sheet, nothing is clipped, panels have data, labels and ticks, and its caption is stored.

    Lines that have to be told apart have names and looks of their own.
    """
    captions, names = figures.read_captions(folder), {path.stem for path in folder.glob("*.png")}
    for problem in problems():
        # No cell of this run has bounds.
        assert {f"{problem}-{kind}" for kind in KINDS} - names == {f"{problem}-bounds"}
    assert {path.stem for path in folder.glob("*.svg")} == names == {*drawn} == {*captions} != set()
    for name, figure in drawn.items():
        picture = Image.open(folder / f"{name}.png")
        assert min(picture.size) > 300, name
        assert len(picture.getcolors(picture.width * picture.height)) > 20, name
        box = figure.get_tightbbox(RendererAgg(10, 10, figure.dpi))
        assert np.all(np.array([-0.01, -0.01]) <= box.min), name
        assert np.all(box.max <= figure.get_size_inches() + 0.01), name
        for axes in panels(figure):
            assert axes.has_data(), name
            assert axes.get_ylabel(), name
            assert axes.get_xlabel(), name
            for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
                assert sum(low <= tick <= high for tick in axis.get_majorticklocs()) >= 2, name
            lines = [line for line in axes.get_lines() if not line.get_label().startswith("_")]
            looks = [
                (one.get_color(), str(one.get_linestyle()), one.get_marker(), one.get_markerfacecolor())
                for one in lines
            ]
            assert len({*looks}) == len({line.get_label() for line in lines}), name
        named = {label for axes in figure.axes for label in axes.get_legend_handles_labels()[1]}
        # In the legend, or beside the ends of their lines.
        written = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
        written |= {text.get_text().replace("\n", "") for axes in figure.axes for text in axes.texts}
        assert named <= written, name
        assert len([one for one in panels(figure) if name.endswith("answer")]) in (0, 4), name
        places = [tuple(np.round(axes.get_position().bounds[:2], 6)) for axes in panels(figure)]
        assert max(sum(place[1] == row for place in places) for row in {place[1] for place in places}) <= 3, name
        assert captions[name] == figures.caption_of(figure)
        assert len(captions[name]) > 60, name


def test_convergence_and_constants_are_those_of_histories_and_queries(drawn: Drawn, results: Path) -> None:
    histories = read_table(results, "histories")
    for problem in problems():
        pod, cones, sigma, beta = drawn[f"{problem}-convergence"].axes
        mine = histories[(histories["problem"] == problem) & (histories["quantity"] == "error")]
        (line,) = pod.get_lines()
        expected = mine[mine["stage"] == "pod"].set_index("step")["value"]
        np.testing.assert_array_equal(line.get_ydata(), expected.loc[np.asarray(line.get_xdata())])
        assert np.all(np.diff(line.get_ydata()) <= 0.0)
        assert line.get_ydata()[0] == pytest.approx(1.0)
        for dual in read_study("quick").dual:
            line = line_called(cones, dual.title)
            cone = mine[(mine["stage"] == "cone") & (mine["dual"] == dual.title)].sort_values("step")
            np.testing.assert_array_equal(line.get_ydata(), cone["value"])
            assert line.get_ydata()[-1] <= 1e-2
        assert {axes.get_yscale() for axes in (pod, cones, sigma, beta)} == {"log"}
        assert np.all(np.diff(data_of(sigma)[0]) <= 1e-12)
        assert data_of(sigma)[0][-1] <= 0.5
        assert data_of(beta)[0][-1] > 0.0
    queries = read_table(results, "queries")
    for problem in problems():
        panel = stability(drawn[f"{problem}-answer"])
        found = np.asarray(line_called(panel, "high-fidelity").get_ydata(), float)
        rows = queries[(queries["problem"] == problem) & (queries["solver"] == "piqp") & queries["primal_tol"].notna()]
        # Those of the cone of the best model, in the order of the only parameter or of the constants.
        by, shown = "mu_1" if problem == "hertz" else "beta_span", line_called(panel, "offline-pga").get_ydata()
        expected = next(
            ordered
            for _, mine in rows.groupby("dual")
            if np.allclose((ordered := mine.sort_values(by, kind="stable"))["beta_span"], shown, rtol=1e-9)
        )
        np.testing.assert_allclose(found, expected["beta_hf_span"])
        assert np.all(data_of(panel)[0] > 0.0)
    places = line_called(stability(drawn["obstacle-answer"]), "high-fidelity").get_xdata()
    np.testing.assert_array_equal(places, range(1, len(expected) + 1))
    hertz = stability(drawn["hertz-answer"])
    assert hertz.get_xlabel() == "radius µ [m]"
    radii = np.sort(queries[queries["problem"] == "hertz"]["mu_1"].unique())
    np.testing.assert_array_equal(line_called(hertz, "high-fidelity").get_xdata(), radii)
    # β over the span of the decorrelated basis is zero in this run, which a logarithmic axis cannot show
    texts = [text.get_text() for text in stability(drawn["obstacle-answer"]).texts]
    assert "β = 0: decorrelated" in texts


def test_a_logarithmic_panel_with_nothing_to_show_stays_empty(change: Change, draw: Draw) -> None:
    """A strategy that records no σ, and enrichments that leave β at zero."""
    change(ONE_PAIR, "DELETE FROM histories WHERE quantity = 'sigma'")
    change("UPDATE histories SET value = 0.0 WHERE quantity = 'beta_span_min'")
    _, _, sigma, beta = draw("convergence")["obstacle-convergence"].axes
    assert not sigma.get_lines()
    for axes in (sigma, beta):
        low, high = axes.get_ylim()
        assert 0.0 < low < high


@given(st.floats(-9.0, 8.0), st.floats(0.05, 6.0))
def test_labels_of_logarithmic_axes_say_where_they_stand(first: float, decades: float) -> None:
    axes = Figure().add_subplot()
    axes.set(xscale="log", xlim=(10.0**first, 10.0 ** (first + decades)))
    set_ticks(axes)
    axes.figure.draw_without_rendering()
    plain = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    for tick in axes.get_xticklabels():
        text = tick.get_text()
        power = re.fullmatch(r"(?:(.+)·)?10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", text)
        value = f"{power[1] or 1}e{power[2].translate(plain)}" if power else text.replace(",", "")
        assert float(value) == pytest.approx(tick.get_position()[0], rel=5e-3)


def test_cells_that_failed_stop_no_others(change: Change, draw: Draw, results: Path, tmp_path: Path) -> None:
    failed = "WHERE solver = 'osqp' OR primal = 'online-supremizers'"
    change(
        ONE_CONE,
        f"DELETE FROM queries {failed}",
        f"UPDATE cells SET status = 'error', N = NULL, R = NULL, enrichment_kind = NULL {failed}",
        *(f"UPDATE {table} SET primal_tol = NULL" for table in ("cells", "queries", "histories")),
    )
    drawn = draw()
    assert {"obstacle-answer", "obstacle-convergence"} <= set(drawn)
    for name, figure in drawn.items():
        for axes in figure.axes:
            assert not [label for label in axes.get_legend_handles_labels()[1] if "nan" in label], name
    change("DELETE FROM queries")
    assert draw_all(results, tmp_path / "nothing", ("png", "svg")) == ([], [])


def test_without_a_fixed_enrichment_its_panels_are_left_out(change: Change, draw: Draw, results: Path) -> None:
    """Nor does one need cones: where every snapshot has no contact there is no generator, so no e_orth."""
    change(ONE_PAIR, "DELETE FROM cells WHERE dual = 'cpg' OR primal = 'offline-pga'")
    change("DELETE FROM queries WHERE primal = 'offline-pga'", "DELETE FROM histories WHERE stage = 'cone'")
    drawn = draw("convergence", "answer")
    assert len(drawn["obstacle-convergence"].axes) == 2
    assert line_called(stability(drawn["obstacle-answer"]), "online-supremizers")
    change("UPDATE queries SET solver = '–'")
    with pytest.raises(RequestError, match="the run has no data for the figure 'solvers' of obstacle"):
        figures.draw(results, "solvers", "obstacle")


def test_prescribed_sizes_are_drawn_too(change: Change, draw: Draw) -> None:
    sizes = "pod_tol = NULL, pod_size = 13, dual_tol = NULL, dual_size = 20"
    enrichments = f"UPDATE histories SET {sizes} WHERE stage = 'enrichment'"
    change(ONE_PAIR, *(f"UPDATE {table} SET {sizes}" for table in ("queries", "cells")), enrichments)
    change("DELETE FROM cells WHERE dual = 'cpg'")
    drawn = draw("convergence", "answer")
    assert all(data_of(axes) for axes in drawn["obstacle-convergence"].axes)
    assert len(stability(drawn["obstacle-answer"]).get_lines()) >= 3


def test_entries_that_share_a_label_get_files_of_their_own(change: Change, draw: Draw) -> None:
    other = json.dumps({"resolution": 500})
    named = f"SET problem_options = '{other}' WHERE"
    change(ONE_PAIR, *(f"UPDATE {table} {named} solver = 'osqp'" for table in ("queries", "cells")))
    change("INSERT INTO histories SELECT * FROM histories", f"UPDATE histories {named} rowid % 2 = 0")
    assert {"obstacle-1-convergence", "obstacle-2-convergence"} <= set(draw("convergence"))


def test_any_label_makes_a_file_in_the_folder(change: Change, draw: Draw) -> None:
    """Labels that differ only in signs included: the other problem is called a:b."""
    tables, old = ("cells", "queries", "histories"), "obstacle"
    change(*(f"UPDATE {table} SET problem = 'a:b' WHERE problem = 'hertz'" for table in tables))
    for label in ("../up", "a\\b", "x" * 300):
        change(*(f"UPDATE {table} SET problem = '{label}' WHERE problem = '{old}'" for table in tables))
        drawn, old = draw("convergence"), label
        assert len(drawn) == 2, label


@pytest.mark.parametrize("count", [7, 12])
def test_a_panel_has_four_series_and_a_sentence_counts_the_others(count: int, tables: Tables) -> None:
    data = replace(tables["obstacle"], cells=tables["obstacle"].cells.assign(error_lambda_mean=0.5))

    def many(frame: pd.DataFrame, column: str, original: str) -> pd.DataFrame:
        one = frame[frame[column] == original]
        return pd.concat([one.assign(**{column: f"{original}-{k:02d}", "artefact": str(k)}) for k in range(count)])

    cones = replace(data, histories=pd.concat([data.histories[data.histories["stage"] == "pod"],
                                               many(data.histories, "dual", "mcpg")]))  # fmt: skip
    figure = spaces.convergence(cones)
    assert len(figure.axes[1].get_lines()) == 4
    assert f"The tables have the other {count - 4} cones." in figure.caption
    sheet = answer_sheet.answer(replace(data, cells=many(data.cells, "primal", "offline-pga").reset_index()))
    assert f"{count - 4} other strategies are in the tables." in sheet.caption


def test_the_tightest_enrichment_went_farthest_and_models_pay_where_lines_cross(results: Path, change: Change) -> None:
    """Whichever way its tolerance runs, and however many training parameters there are."""
    mine = dict(of_file(results))["obstacle"].histories
    steps = mine[(mine["quantity"] == "beta_span_min") & (mine["dual"] == "mcpg")]
    last = steps[steps["step"] == steps["step"].max()].assign(step=steps["step"].max() + 1)
    tighter = pd.concat([steps, last]).assign(primal_tol=0.9, artefact="tighter")
    for tolerance in (0.5, 0.95):
        both = pd.concat([steps.assign(primal_tol=tolerance), tighter])
        ((_, found),) = spaces.longest(both, "primal")
        assert set(found["primal_tol"]) == {0.9}
    change(*DECIDED)
    data = dict(of_file(results))["obstacle"]
    figure = answer_sheet.answer(data)
    cost = next(axes for axes in figure.axes if axes.get_xlabel() == "number of queries")
    (mark,) = [line for line in cost.get_lines() if line.get_marker() in "<>"]
    ((n, total),) = mark.get_xydata()
    lines = (np.asarray(line.get_xydata()).T for line in cost.get_lines())
    through = [np.interp(n, *xy) for xy in lines if xy.shape[1] > 1]
    assert sum(np.isclose(value, total, rtol=0.02) for value in through) >= 2
    row = data.thresholds[data.thresholds["benefit_threshold"] == n]
    (interval,) = cost.collections[0].get_paths()
    assert [tuple(interval.vertices[:, 0])] == [*zip(row["threshold_low"], row["threshold_high"], strict=True)]
    assert f"{n:.0f} queries" in [text.get_text() for text in cost.texts]


def test_a_model_with_a_query_not_ok_has_no_point_and_others_have(change: Change, draw: Draw, results: Path) -> None:
    """A strategy that solved the easy half of the queries has no smaller error for it."""
    cells = read_table(results, "cells")
    best = next(one.best for one in verdicts(cells, read_table(results, "thresholds")) if one.problem == "obstacle")
    mine = cells[(cells["problem"] == "obstacle") & (cells["solver"] == best["solver"])]
    lost = mine[(mine["dual"] == "mcpg") & (mine["primal"] == "decorrelated")]
    change(*(f"UPDATE cells SET status = 'inaccurate', queries_ok = 10 WHERE cell = '{key}'" for key in lost["cell"]))
    shown = np.concatenate([line.get_ydata() for line in errors_panel(draw("answer")["obstacle-answer"])])
    kept = mine.drop(lost.index)[["error_u_mean", "error_lambda_mean"]].max(axis=1)
    np.testing.assert_allclose(np.sort(shown), np.sort(kept), rtol=1e-12)
    calls: list[float] = []  # labels of millions of rows are made once for each combination, none included
    _per_combination(pd.DataFrame({"a": [1.0, None, 1.0, None]}), calls.append)
    assert len(calls) == 2


def test_bounds_are_drawn_against_the_errors_of_every_query_that_has_them(tables: Tables) -> None:
    data = tables["obstacle"]
    names = ("u_energy", "lambda_natural")
    twice = {f"bound_online_{name}": 2.0 * data.queries[f"error_{name}_absolute"] for name in names}
    figure = effectivity.bounds(replace(data, queries=data.queries.assign(**twice)))
    for axes, name in zip(figure.axes, names, strict=True):
        points = np.hstack([line.get_xydata().T for line in axes.get_lines() if line.get_linestyle() == "None"])
        np.testing.assert_allclose(points[1], 2.0 * points[0])
        np.testing.assert_array_equal(np.sort(points[0]), np.sort(data.queries[f"error_{name}"]))


def errors_panel(figure: Figure) -> list[Line2D]:
    panel = next(axes for axes in figure.axes if axes.get_xlabel() == "mean time of a query [ms]")
    points = [line for line in panel.get_lines() if line.get_linestyle() == "None"]
    return [line for line in points if not str(line.get_label()).startswith("_")]


def test_without_contact_errors_of_u_are_drawn_alone(change: Change, draw: Draw) -> None:
    without = ("UPDATE queries SET zero_lambda = 1, error_lambda = NULL", "UPDATE cells SET error_lambda_mean = NULL")
    change(ONE_PROBLEM, *without)
    assert any(len(line.get_ydata()) for line in errors_panel(draw("answer")["obstacle-answer"]))


def test_a_profile_ends_at_the_share_that_was_solved(change: Change, draw: Draw) -> None:
    change(ONE_PAIR, "UPDATE queries SET status = 'failed' WHERE solver = 'osqp' AND query < 2")
    profile = draw("solvers")["obstacle-solvers"].axes[1]
    assert line_called(profile, "osqp").get_ydata()[-1] == pytest.approx(0.75)
    assert line_called(profile, "piqp").get_ydata()[-1] == pytest.approx(1.0)
    for line in profile.get_lines():
        assert np.all(np.diff(line.get_ydata()) >= 0.0)
    nothing = "solve_s = NULL, status = 'error', primal_residual = NULL, dual_residual = NULL, gap = NULL"
    change(f"UPDATE queries SET {nothing} WHERE solver = 'osqp' AND problem = 'obstacle'")
    assert line_called(draw("solvers")["obstacle-solvers"].axes[1], "osqp").get_ydata()[-1] == 0.0
    change("DELETE FROM queries WHERE solver != 'piqp'")
    figure = draw("solvers")["obstacle-solvers"]
    assert len(figure.axes) == 1
    assert "The run has one solver, piqp: there is no performance profile to draw." in figure.caption


@pytest.mark.long
def test_a_figure_drawn_twice_is_the_same_file(tables: Tables, tmp_path: Path) -> None:
    assert tables["hertz"].parameter == "radius µ [m]"
    assert tables["obstacle"].parameter == ""
    assert replace(tables["hertz"], pictures=()).parameter == "µ"
    data = tables["hertz"]
    for name, drawing in ((name, KINDS[name]) for name in ("solutions", "answer")):
        files = []
        for folder in ("one", "two"):
            (tmp_path / folder).mkdir(exist_ok=True)
            with styled():
                files.append(save(drawing(data), tmp_path / folder, name))
        for first, second in zip(*files, strict=True):
            assert first.read_bytes() == second.read_bytes(), first.name


def test_a_figure_that_fails_costs_itself_and_progress_names_every_one(
    change: Change, results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, main: Main
) -> None:
    change("DELETE FROM cells WHERE problem = 'hertz' OR dual = 'cpg'", ONE_PAIR)
    failing = {"answer": lambda _: {}["nan"], "convergence": KINDS["convergence"]}
    monkeypatch.setattr(figures, "KINDS", failing)
    line = "the figure 'obstacle-answer' could not be drawn: KeyError: 'nan'"
    code, out, err = main("figures", str(results), "--out", str(tmp_path / "here"), "--format", "svg")
    assert (code, err) == (1, f"vibench: {line}\n")
    assert "\n1 figures: " in out
    assert line in html.unescape(report_page(results))
    shown: list[tuple[str, int, int]] = []
    draw_all(results, tmp_path, ("svg",), lambda *now: shown.append(now))
    assert shown == [("obstacle-answer", 0, 2), ("obstacle-convergence", 1, 2), ("", 2, 2)]


def test_of_several_tolerances_the_loosest_is_shown(tables: Tables) -> None:
    """Of two that are as loose up to round-off, the one with the larger δ."""
    data = tables["obstacle"]
    fixed = data.queries[data.queries["primal"] == "offline-pga"]
    again = fixed.assign(primal_tol=0.7, beta_span=fixed["beta_span"] * (1.0 + 1e-12))
    tighter = fixed.assign(primal_tol=0.2, beta_span=2.0 * fixed["beta_span"])
    found = spaces.loosest(pd.concat([data.queries, again, tighter]))
    assert set(found["primal_tol"].dropna()) == {0.7}
    assert {"decorrelated", "online-supremizers"} <= set(found["primal"])


def test_panels_share_axes_and_ranges(drawn: Drawn, results: Path) -> None:
    fields = panels(drawn["obstacle-solutions"])
    for row in (fields[:3], fields[3:]):
        ranges = {axes.collections[0].get_clim() for axes in row}
        assert len(ranges) == 1
        assert all(any(isinstance(one, ContourSet) for one in axes.collections) for axes in row)
        assert {(axes.get_xlim(), axes.get_ylim(), axes.get_xlabel(), axes.get_ylabel()) for axes in row} == {
            (row[0].get_xlim(), row[0].get_ylim(), "x [m]", "y [m]")
        }
    pressures = panels(drawn["hertz-solutions"])[3:]
    assert {axes.get_ylabel() for axes in pressures} == {"contact pressure [Pa]"}
    assert len({axes.get_ylim() for axes in pressures}) == 1
    for axes in pressures:
        pressure, end = axes.get_lines()
        x, values = np.asarray(pressure.get_xdata(), float), np.asarray(pressure.get_ydata(), float)
        assert x[values > 0.0].max() < end.get_xdata()[0] < x[values == 0.0].min()
