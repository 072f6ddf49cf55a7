"use strict";
const TABLES = JSON.parse(document.getElementById("table-data").textContent);
const PLOTS = JSON.parse(document.getElementById("plot-data").textContent);
const PAGE = 50;  // rows in the page at a time: thousands would take seconds to lay out

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value != null) made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

// ---------------------------------------------------------------- values

/** A number as the other tables of a run print it: whole, or with three significant digits. */
function numberText(value) {
  if (value === null) return "";
  if (!Number.isFinite(value)) return value > 0 ? "inf" : "-inf";
  if (Number.isInteger(value) && Math.abs(value) < 1e6) return String(value);
  const [digits, power] = value.toExponential(2).split("e"), exponent = Number(power);
  if (exponent >= -4 && exponent < 3) return String(Number(value.toPrecision(3)));
  const sign = exponent < 0 ? "-" : "+";
  return `${Number(digits)}e${sign}${String(Math.abs(exponent)).padStart(2, "0")}`;
}

const infinite = value => typeof value === "string" ? (value.startsWith("-") ? -Infinity : Infinity) : value;

/** A column with one way to its values, however they are embedded: a value that all rows have stands there once. */
function opened({ name, meaning, numbers, texts, levels, codes }) {
  if (numbers) {
    const values = numbers.map(infinite), value = values.length === 1 ? () => values[0] : row => values[row];
    return { name, meaning, number: true, value, text: row => numberText(value(row)) };
  }
  const text = codes ? row => levels[codes[row]] : levels ? () => levels[0] : row => texts[row];
  return { name, meaning, number: false, value: text, text };
}

function compared(a, b) {
  if (typeof a === "number") return a - b;
  return a.localeCompare(b, "en", { numeric: true });
}

const isEmpty = value => value === null || value === "";

// A text that a spreadsheet would take for a formula has an apostrophe before it, as in the files of `tables`.
const FORMULA = /^[=+\-@＝＋－＠\n]/, PLAIN = /^[+-]([0-9]+(\.[0-9]+)?(e[+-]?[0-9]+)?|inf)$/;
const noFormula = text => FORMULA.test(text) && !PLAIN.test(text) ? `'${text}` : text;
const quoted = text => /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
const csvLine = texts => texts.map(text => quoted(noFormula(text))).join(",");

// ---------------------------------------------------------------- tables

class Grid {
  constructor(place, name, table) {
    Object.assign(this, { place, name, rows: table.rows, axes: table.axes, hiddenFirst: new Set(table.hidden) });
    this.columns = table.columns.map(opened);
    this.disturbed = new Set(table.disturbed);
    this.haystack = null;
    this.forget();
    this.build();
    this.update();
  }

  column(name) { return this.columns.find(column => column.name === name); }

  forget() {
    Object.assign(this, { query: "", filters: new Map(), sort: null, falling: false, page: 0, hidden: new Set(this.hiddenFirst) });
  }

  build() {
    const change = update => event => { update(event.target); this.page = 0; this.changed(); };
    this.search = element("input", { type: "search", oninput: change(field => { this.query = field.value; }) });
    this.selects = new Map(this.axes.map(name => {
      const column = this.column(name), values = new Map();
      for (let row = 0; row < this.rows; row++) values.set(column.text(row), column.value(row));
      const known = [...values].sort(([, a], [, b]) => isEmpty(a) - isEmpty(b) || compared(a, b)).map(([text]) => text);
      const choose = change(field => field.selectedIndex ? this.filters.set(name, field.value) : this.filters.delete(name));
      const select = element("select", { onchange: choose }, element("option", {}, "all"));
      select.append(...known.map(text => element("option", { value: text }, text || "(none)")));
      return [name, select];
    }));
    this.boxes = new Map(this.columns.slice(1).map(({ name }) => {
      const toggle = change(box => box.checked ? this.hidden.delete(name) : this.hidden.add(name));
      return [name, element("input", { type: "checkbox", onchange: toggle })];
    }));
    const picker = element("details", { class: "picker" }, element("summary", {}, "Columns"),
      element("div", {}, ...[...this.boxes].map(([name, box]) => element("label", {}, box, name))));
    this.count = element("span", { class: "count", role: "status" });
    this.before = element("button", { type: "button", "aria-label": "previous rows", onclick: () => this.turn(-1) }, "◀");
    this.after = element("button", { type: "button", "aria-label": "next rows", onclick: () => this.turn(1) }, "▶");
    this.place.append(
      element("div", { class: "tools" },
        element("label", {}, "Search", this.search),
        ...[...this.selects].map(([name, select]) => element("label", {}, name, select)),
        picker,
        element("button", { type: "button", class: "download", onclick: () => this.download() }, "Download CSV"),
        element("button", { type: "button", class: "reset", onclick: () => { this.forget(); this.changed(); } }, "Reset")),
      element("div", { class: "tools" }, this.count, this.before, this.after),
      this.frame = element("div", { class: "wide", tabindex: 0, role: "region", "aria-label": `table ${this.name}` }));
  }

  turn(pages) { this.page += pages; this.changed(); this.frame.scrollTop = 0; }

  /** Numbers of the rows that are searched and filtered for, sorted. */
  chosen() {
    const words = this.query.toLowerCase().split(/\s+/).filter(Boolean);
    if (words.length && !this.haystack) {
      this.haystack = Array.from({ length: this.rows }, (_, row) => this.columns.map(column => column.text(row)).join("\n").toLowerCase());
    }
    const filters = [...this.filters].map(([name, text]) => [this.column(name), text]);
    const found = [];
    for (let row = 0; row < this.rows; row++) {
      if (words.every(word => this.haystack[row].includes(word)) && filters.every(([column, text]) => column.text(row) === text)) found.push(row);
    }
    const by = this.sort && this.column(this.sort);
    if (by) {
      const sign = this.falling ? -1 : 1;
      found.sort((a, b) => {
        const [one, other] = [by.value(a), by.value(b)];
        return isEmpty(one) - isEmpty(other) || (isEmpty(one) ? 0 : sign * compared(one, other)) || a - b;
      });
    }
    return found;
  }

  shown() { return this.columns.filter(({ name }) => !this.hidden.has(name)); }

  changed() { this.update(); writeAddress(this); }

  update() {
    this.found = this.chosen();
    const pages = Math.max(1, Math.ceil(this.found.length / PAGE));
    this.page = Math.min(Math.max(this.page, 0), pages - 1);
    const first = this.page * PAGE, rows = this.found.slice(first, first + PAGE);
    this.search.value = this.query;
    for (const [name, select] of this.selects) select.value = this.filters.has(name) ? this.filters.get(name) : "all";
    for (const [name, box] of this.boxes) box.checked = !this.hidden.has(name);
    const range = this.found.length ? `rows ${first + 1}–${first + rows.length} of ${this.found.length}` : "no rows";
    this.count.textContent = this.found.length < this.rows ? `${range}, ${this.rows} in all` : range;
    this.before.disabled = this.page === 0;
    this.after.disabled = this.page === pages - 1;
    const shown = this.shown();
    const head = element("tr", {}, ...shown.map(({ name, meaning, number }) => {
      const sorted = this.sort === name && (this.falling ? "descending" : "ascending");
      return element("th", { scope: "col", class: number && "number", "aria-sort": sorted, title: meaning || null }, element("button", { type: "button", onclick: () => this.order(name) }, name));
    }));
    const body = rows.map(row => element("tr", { "data-row": row }, ...shown.map((column, k) => {
      const text = column.text(row), kind = column.number ? "number" : text.length > 48 ? "long" : text.length > 16 ? "text" : "";
      const cell = element("td", { class: kind }, text);
      if (k === 0 && this.disturbed.has(row)) cell.append(" ", element("abbr", { class: "flag", title: "timed on a disturbed machine" }, "⚑"));
      return cell;
    })));
    this.frame.replaceChildren(element("table", {}, element("thead", {}, head), element("tbody", {}, ...body)));
  }

  order(name) {
    this.falling = this.sort === name && !this.falling;
    this.sort = name;
    this.page = 0;
    this.changed();
  }

  /** All rows that are searched and filtered for, in their order, with the columns that are shown. */
  csv() {
    const shown = this.shown(), flagged = this.disturbed.size > 0;
    const lines = this.found.map(row => {
      const texts = shown.map(({ number, value, text }) => number && value(row) !== null && Number.isFinite(value(row)) ? String(value(row)) : text(row));
      return csvLine(flagged ? [...texts, this.disturbed.has(row) ? "1" : "0"] : texts);
    });
    return [csvLine([...shown.map(({ name }) => name), ...(flagged ? ["disturbed"] : [])]), ...lines, ""].join("\n");
  }

  download() {
    const address = URL.createObjectURL(new Blob([this.csv()], { type: "text/csv;charset=utf-8" }));
    element("a", { href: address, download: `${this.name}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  }

  /** What differs from the table as it was at first, for the address. */
  address() {
    const known = new URLSearchParams();
    if (this.query) known.set("q", this.query);
    for (const [name, text] of this.filters) known.set(`is ${name}`, text);
    if (this.sort) known.set("sort", (this.falling ? "-" : "") + this.sort);
    const changed = [...this.boxes.keys()].filter(name => this.hidden.has(name) !== this.hiddenFirst.has(name));
    for (const name of changed) known.append(this.hidden.has(name) ? "hide" : "show", name);
    if (this.page) known.set("page", this.page + 1);
    return known.toString();
  }

  restore(known) {
    this.forget();
    this.query = known.get("q") || "";
    for (const [key, text] of known) if (key.startsWith("is ") && this.selects.has(key.slice(3))) this.filters.set(key.slice(3), text);
    const sort = known.get("sort") || "";
    this.falling = sort.startsWith("-") && !this.column(sort);
    this.sort = this.column(this.falling ? sort.slice(1) : sort) ? (this.falling ? sort.slice(1) : sort) : null;
    for (const name of known.getAll("hide")) if (this.boxes.has(name)) this.hidden.add(name);
    for (const name of known.getAll("show")) this.hidden.delete(name);
    this.page = (Number.parseInt(known.get("page"), 10) || 1) - 1;
    this.update();
  }
}

// ---------------------------------------------------------------- addresses

const grids = new Map();

function writeAddress(grid) {
  const state = grid.address();
  history.replaceState(null, "", `#${grid.name}${state && `?${state}`}`);
}

function readAddress() {
  const [name, state] = location.hash.slice(1).split(/\?(.*)/s);
  const grid = grids.get(decodeURIComponent(name));
  if (!grid || state === undefined) return;
  grid.restore(new URLSearchParams(state));
  grid.place.parentElement.scrollIntoView();
}

// ---------------------------------------------------------------- plots

/** The resolved colours of the page: a canvas knows no variables. */
function pageColours() {
  const probe = element("span");
  document.body.append(probe);
  const resolved = name => { probe.style.color = `var(${name})`; return getComputedStyle(probe).color; };
  const found = { ink: resolved("--ink"), soft: resolved("--soft"), line: resolved("--line") };
  probe.remove();
  return found;
}

if (typeof Bokeh !== "undefined") Bokeh.set_log_level("error");

const drawn = [];  // every panel that Bokeh has drawn, to be painted anew where the colours of the page change

function paint(panel) {
  const { ink, soft, line } = pageColours();
  for (const axis of [...panel.below, ...panel.left]) {
    // Bokeh rounds the exponents of ticks between powers of ten: 0.30 would be called 10⁻¹, and 0.35 one.
    axis.formatter = new Bokeh.CustomJSTickFormatter({ code: "return String(Number(tick.toPrecision(3)))" });
    Object.assign(axis, { axis_label_text_color: ink, major_label_text_color: soft, axis_line_color: soft, major_tick_line_color: soft, minor_tick_line_color: null });
  }
  for (const grid of panel.center) grid.grid_line_color = line;
  panel.outline_line_color = line;
}

/** The black of the palette is the ink of the page. */
const visible = colour => colour.toLowerCase() === "#000000" ? pageColours().ink : colour;

function points(plot, panel, series) {
  const grid = grids.get("summary"), texts = names => row => names.map(name => {
    const column = grid.column(name), text = column ? column.text(row) : "";
    return text && `${column.number ? `${name} = ` : ""}${text}`;
  }).filter(Boolean).join(", ");
  const model = texts(["problem", "dual", "primal", "δ", "solver", "assembly", "N", "R"]);
  const data = { x: [], y: [], fill: [], cell: [], model: [], x_text: [], y_text: [] };
  plot.of.forEach((which, k) => {
    if (which !== series || panel.x[k] === null) return;
    const row = plot.rows[k];
    data.x.push(panel.x[k]); data.y.push(panel.y[k]); data.fill.push(plot.fills[k]);
    data.cell.push(grid.columns[0].text(row)); data.model.push(model(row));
    data.x_text.push(numberText(panel.x[k])); data.y_text.push(numberText(panel.y[k]));
  });
  return data;
}

/** Lead to the row of a cell in the table of all cells. */
function openRow(source, row) {
  source.selected.properties.indices.change.connect(() => {
    const [k] = source.selected.indices;
    if (k !== undefined && row(k)) location.hash = `#summary?q=${encodeURIComponent(row(k))}`;
  });
}

/** A vertical line at the seconds of the high-fidelity model, over the range of the points. */
function drawModelLine(made, panel) {
  const there = panel.y.filter(value => value !== null);
  if (panel.line === null || !there.length) return;
  const soft = pageColours().soft;
  made.line([panel.line, panel.line], [Math.min(...there), Math.max(...there)], { line_dash: "dashed", line_color: soft, line_width: 1.5 });
}

/** Total costs over the number of queries, a curve with its band per model. */
function drawCosts(costs, place) {
  const made = Bokeh.Plotting.figure({
    x_axis_type: "log", y_axis_type: "log", height: 340, sizing_mode: "stretch_width", min_border_right: 12,
    tools: "pan,box_zoom,wheel_zoom,tap,reset,save", x_axis_label: "queries", y_axis_label: "total [s]",
    background_fill_color: null, border_fill_color: null,
  });
  made.toolbar.logo = null;
  made.toolbar.active_scroll = null;
  made.toolbar.active_drag = made.toolbar.tools.find(tool => tool.type === "BoxZoomTool");
  const summary = grids.get("summary"), renderers = costs.curves.map(curve => {
    const cell = curve.row === null ? "" : summary.columns[0].text(curve.row), colour = visible(curve.colour), all = value => costs.x.map(() => value);
    const source = new Bokeh.ColumnDataSource({ data: { x: costs.x, y: curve.y, low: curve.low, high: curve.high, cell: all(cell), name: all(curve.name) } });
    made.varea({ field: "x" }, { field: "low" }, { field: "high" }, { source, fill_color: colour, fill_alpha: 0.15 });
    openRow(source, () => cell);
    made.line({ field: "x" }, { field: "y" }, { source, line_color: colour, line_width: 2, line_dash: curve.dashed ? "dashed" : "solid" });
    return made.scatter({ field: "x" }, { field: "y" }, { source, size: 6, line_color: null, fill_color: colour, fill_alpha: 0.01 });
  });
  made.add_tools(new Bokeh.HoverTool({ tooltips: [["model", "@name"], ["cell", "@cell"], ["queries", "@x{0}"], ["total [s]", "@y"], ["interval", "@low – @high"]], renderers }));
  paint(made);
  drawn.push(made);
  Bokeh.Plotting.show(made, place);
}

function drawPanel(plot, panel, place) {
  const made = Bokeh.Plotting.figure({
    x_axis_type: "log", y_axis_type: "log", height: 340, sizing_mode: "stretch_width", min_border_right: 12,
    tools: "pan,box_zoom,wheel_zoom,tap,reset,save", x_axis_label: panel.x_label, y_axis_label: panel.y_label,
    background_fill_color: null, border_fill_color: null,
  });
  made.toolbar.logo = null;
  made.toolbar.active_scroll = null;  // the wheel scrolls the page until zoom by wheel is chosen
  made.toolbar.active_drag = made.toolbar.tools.find(tool => tool.type === "BoxZoomTool");
  const renderers = plot.series.map((series, k) => {
    const data = points(plot, panel, k);
    if (!data.x.length) return null;
    const source = new Bokeh.ColumnDataSource({ data }), colour = visible(series.colour);
    openRow(source, k => data.cell[k]);
    return made.scatter({ field: "x" }, { field: "y" }, {
      source, marker: series.marker, size: 8, line_color: colour, line_width: series.edge, fill_color: colour, fill_alpha: { field: "fill" },
    });
  });
  drawModelLine(made, panel);
  const tooltips = [["cell", "@cell"], ["model", "@model"], [panel.x_label, "@x_text"], [panel.y_label, "@y_text"]];
  made.add_tools(new Bokeh.HoverTool({ tooltips, renderers: renderers.filter(Boolean) }));
  paint(made);
  drawn.push(made);
  Bokeh.Plotting.show(made, place);
  return renderers;
}

function drawPlot(figure) {
  if (figure.classList.contains("live")) return;
  const plot = PLOTS[figure.dataset.plot];
  const places = plot.panels.map(() => element("div"));
  const legend = element("div", { class: "legend", role: "group", "aria-label": "series" });
  const panels = element("div", { class: "panels", role: "img", "aria-label": figure.querySelector("figcaption").textContent }, ...places);
  figure.prepend(legend, panels);
  figure.classList.add("live");
  const renderers = plot.panels.map((panel, k) => drawPanel(plot, panel, places[k]));
  if (plot.costs) {
    const place = element("div");
    panels.append(place);
    drawCosts(plot.costs, place);
  }
  const counts = plot.series.map((_, k) => plot.of.filter(which => which === k).length);
  legend.append(...plot.series.map(({ name, colour }, k) => {
    const toggle = event => {
      const shown = event.currentTarget.getAttribute("aria-pressed") === "false";
      event.currentTarget.setAttribute("aria-pressed", shown);
      for (const found of renderers) if (found[k]) found[k].visible = shown;
    };
    const dot = element("i");
    dot.style.background = visible(colour);
    return element("button", { type: "button", "aria-pressed": "true", title: `${counts[k]} cells`, onclick: toggle }, dot, name);
  }));
}

// ---------------------------------------------------------------- theme

const dark = matchMedia("(prefers-color-scheme: dark)"), root = document.documentElement, switcher = document.getElementById("theme");
const isDark = () => root.dataset.theme ? root.dataset.theme === "dark" : dark.matches;

function themed() {
  switcher.textContent = isDark() ? "light" : "dark";
  drawn.forEach(paint);
}

function remembered(theme) {
  try {
    if (theme) localStorage.setItem("vibench-theme", theme);
    return localStorage.getItem("vibench-theme");
  } catch { return null; }  // a page may have no storage
}

switcher.hidden = false;
switcher.title = "dark or light page";
switcher.addEventListener("click", () => { root.dataset.theme = remembered(isDark() ? "light" : "dark") || (isDark() ? "light" : "dark"); themed(); });
dark.addEventListener("change", themed);
if (remembered()) root.dataset.theme = remembered();

// ---------------------------------------------------------------- start

for (const place of document.querySelectorAll("[data-table]")) grids.set(place.dataset.table, new Grid(place, place.dataset.table, TABLES[place.dataset.table]));
themed();
const waiting = new IntersectionObserver(entries => {
  for (const { target, isIntersecting } of entries) {
    if (!isIntersecting) continue;
    waiting.unobserve(target);
    drawPlot(target);
  }
}, { rootMargin: "400px" });
for (const figure of document.querySelectorAll("[data-plot]")) if (figure.dataset.plot in PLOTS) waiting.observe(figure);
addEventListener("hashchange", readAddress);
readAddress();
