// SPDX-License-Identifier: Apache-2.0
// Draws the data of a page: maps, what a point holds, figures. A live page then listens to the server it came from.
// Texts of runs are put into the page as text, never as HTML; plotly, which reads a few tags, gets them escaped.
"use strict";
(() => {
  const page = JSON.parse(document.getElementById("data").textContent);
  const root = document.getElementById("interactive");
  const CONFIG = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "toImage"] };
  const COLOURS = ["#1f77b4", "#d95f02", "#1b9e77", "#7b3fa0", "#b8860b", "#c2185b"];
  const SYMBOLS = ["circle", "square", "diamond", "triangle-up", "star", "pentagon", "hexagon", "cross"];
  const SAME_PLACE_MM = 0.1;
  const CHI = Math.sqrt(-2 * Math.log(0.05)); // radius of the 95 % ellipse in standard deviations
  const MOST_OTHERS = 1000; // poles of other points behind those of the chosen one
  const PAPER_WIDTH = 690; // pixels across A4 within its margins

  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const number = (value, digits) => (value === null || value === undefined ? "-" : value.toFixed(digits));
  const withStd = (value, std, digits) =>
    number(value, digits) + (value === null || std === null ? "" : ` ± ${Number(std.toPrecision(2))}`);

  function make(parent, tag, css = "", text = "") {
    const element = document.createElement(tag);
    if (css) element.className = css;
    element.textContent = text;
    parent.append(element);
    return element;
  }

  function draw(place, traces, layout) {
    const base = {
      margin: { l: 62, r: 14, t: 62, b: 44 }, font: { size: 12 }, hovermode: "closest", separators: ".", uirevision: "kept",
      hoverlabel: { bgcolor: "white", font: { color: "#222" }, align: "left" },
      legend: { orientation: "h", x: 0, y: 1.01, yanchor: "bottom", font: { size: 11 } },
    };
    const title = { text: layout.title, font: { size: 14 }, x: 0.01, xanchor: "left", y: 0.98, yanchor: "top" };
    return Plotly.react(place, traces, { ...base, ...layout, title }, CONFIG);
  }

  const axis = (title, more = {}) => ({ title: { text: title }, gridcolor: "#e8e8e8", zeroline: false, linecolor: "#999", automargin: true, exponentformat: "power", separatethousands: false, ...more });

  // ---- points

  const nameOf = (run, point) => (point.outcome === "under way" ? point.outcome :
    (page.runs.length > 1 ? `${run.name}, ` : "") + `point ${point.index + 1}` + (point.attempt ? `, attempt ${point.attempt + 1}` : ""));

  function tissueOf(point) {
    if (!point.tissue) return "-";
    return point.tissue + (point.probability === null ? "" : ` (${(100 * point.probability).toFixed(1)} %)`);
  }

  function rows(point, truth) {
    const all = [
      ["place", `${number(point.x_mm, 2)}, ${number(point.y_mm, 2)} mm`],
      ["outcome", point.outcome + (point.reason ? `; ${point.reason}` : "")],
      ["tissue", tissueOf(point)],
      ["f0", `${withStd(point.f0_hz, point.f0_std_hz, 3)} Hz`],
      ["damping ratio", withStd(point.damping, point.damping_std, 5)],
      ["at the nominal contact", `${withStd(point.nominal_f0_hz, point.nominal_f0_std_hz, 3)} Hz, ` +
        withStd(point.nominal_damping, point.nominal_damping_std, 5)],
      ["force", `${withStd(point.force_mn, point.force_std_mn, 2)} mN, age of contact ${number(point.age_s, 2)} s`],
      ["poles", `${point.status || "-"}, ${point.blocks} blocks, ${point.repeats} repeats`],
    ];
    if (truth) all.push(["truth of the simulation", `${number(truth.f0_hz, 3)} Hz, ${number(truth.damping, 5)}, ${truth.tissue}`]);
    return all;
  }

  const hoverText = (run, point) =>
    [`${nameOf(run, point)}: ${point.outcome}`, ...rows(point).filter((row) => ["tissue", "f0", "damping ratio", "force"].includes(row[0]))
      .map((row) => row.join(": "))].map(plain).join("<br>");

  function rangeOf(values) {
    const known = values.filter((value) => value !== null);
    const low = Math.min(...known), high = Math.max(...known);
    return known.length ? [low, high > low ? high : low + 1] : [0, 1];
  }

  // ---- maps

  const maps = []; // {run, band, place}
  let selected = null; // {run, index}
  let pinned = false;

  function drawMap({ run, band, place }) {
    const shown = run.bands[band];
    const [low, high] = rangeOf(page.runs.flatMap((each) => (each.bands[band] || { points: [] }).points.map((p) => p.f0_hz)));
    const scale = [[0, page.colours[0]], [1, page.colours[1]]];
    const found = shown.points.filter((p) => p.f0_hz !== null && p.x_mm !== null);
    const failed = shown.points.filter((p) => p.f0_hz === null && p.x_mm !== null && p.outcome !== "skipped");
    const classes = [...new Set(found.map((p) => p.tissue))].sort();
    const traces = [], size = Math.max(4, Math.min(12, 250 / Math.sqrt(shown.points.length)));
    if (shown.surface) {
      const s = shown.surface;
      traces.push({ type: "heatmap", x: s.x_mm, y: s.y_mm, z: s.f0_hz, zmin: low, zmax: high, colorscale: scale,
        opacity: 0.6, showscale: false, hoverinfo: "skip", zsmooth: "best" });
    }
    const line = (lines, name, style) => lines.forEach((points, k) => traces.push({
      type: "scatter", mode: "lines", x: points.map((p) => p[0]), y: points.map((p) => p[1]), line: style, name,
      legendgroup: name, showlegend: k === 0, hoverinfo: "skip" }));
    if (shown.boundary) {
      line(shown.boundary.band_mm, "95 % band", { color: "black", dash: "dash", width: 1 });
      line(shown.boundary.outline_mm, "boundary", { color: "black", width: 2.5 });
      line(shown.boundary.truth_mm, "truth of the simulation", { color: "red", width: 1.5 });
    }
    const spot = (points, name, marker) => ({
      type: "scatter", mode: "markers", x: points.map((p) => p.x_mm), y: points.map((p) => p.y_mm), name: plain(name),
      customdata: points.map((p) => p.index), text: points.map((p) => hoverText(run, p)), hoverinfo: "text", marker });
    classes.forEach((name, k) => {
      const points = found.filter((p) => p.tissue === name);
      traces.push(spot(points, name || "poles", {
        size, symbol: SYMBOLS[k % SYMBOLS.length], color: points.map((p) => p.f0_hz), cmin: low, cmax: high,
        colorscale: scale, line: { color: "black", width: 1 }, showscale: k === 0, colorbar: { title: { text: "f0 [Hz]" }, thickness: 14 } }));
    });
    if (failed.length) traces.push(spot(failed, "failed", { size, symbol: "x", color: "red" }));
    const chosen = chosenOf(run);
    traces.push({ ...spot(chosen, "chosen", { size: size + 8, symbol: "circle-open", color: "black", line: { width: 2.5 } }),
      hoverinfo: "skip", showlegend: false }); // the last one: see `mark`
    const title = [page.runs.length > 1 ? plain(run.name) : "map of f0", run.bands.length > 1 ? shown.name : ""].filter(Boolean).join(", ");
    const square = { scaleanchor: "x", scaleratio: 1 };
    return draw(place, traces, { title: title + (run.simulated ? " (simulated, not measured)" : ""),
      // below: with a boundary it has more entries than fit between the title and the buttons
      legend: { orientation: "h", x: 0, yref: "container", y: 0.005, yanchor: "bottom", font: { size: 11 } },
      xaxis: axis("x [mm]", { constrain: "domain" }), yaxis: axis("y [mm]", square) });
  }

  // a ring about what is chosen; all other points stay as they are drawn
  function mark({ run, place }) {
    const chosen = chosenOf(run);
    Plotly.restyle(place, { x: [chosen.map((p) => p.x_mm)], y: [chosen.map((p) => p.y_mm)] }, [place.data.length - 1]);
  }

  const chosenOf = (run) => chosenPoints().filter((each) => each.run === run).map((each) => each.point);

  function addMap(parent, run, band) {
    maps.push({ run, band, place: make(parent, "div", "plot") });
  }

  // once all places are there: a drawing takes the width that its place then has
  function drawMaps() {
    maps.forEach(drawMap);
    maps.forEach(listen);
  }

  function listen({ run, place }) {
    const take = (pin) => (event) => {
      const index = event.points[0].customdata;
      if (index === undefined) return;
      pinned = pinned || pin;
      if (pin || !pinned) choose(run, index, pin);
    };
    place.on("plotly_click", take(true));
    place.on("plotly_hover", take(false));
  }

  // the chosen point, and what other runs have at its place
  function chosenPoints() {
    if (!selected) return [];
    const point = selected.run.bands[0].points.find((p) => p.index === selected.index);
    if (!point) return [];
    const off = (other) => (other.x_mm === null || other.frame !== point.frame ? Infinity :
      Math.hypot(other.x_mm - point.x_mm, other.y_mm - point.y_mm, other.z_mm - point.z_mm));
    const nearest = (points) => points.filter((each) => off(each) <= SAME_PLACE_MM).sort((a, b) => off(a) - off(b))[0];
    return page.runs.flatMap((run) => {
      const there = run === selected.run ? point : nearest(run.bands[0].points);
      return there ? [{ run, point: there, detail: run.details[there.index] }] : [];
    });
  }

  function choose(run, index, told) {
    selected = { run, index };
    drawDetails(chosenPoints());
    maps.forEach(mark);
    if (told && !page.live) history.replaceState(null, "", `#run=${page.runs.indexOf(run) + 1}&point=${index + 1}`);
  }

  // ---- details: each panel draws what it finds in the entries [{run, point, detail}]

  const PANELS = [drawFrf, drawPlane, drawForce];
  const TESTED = [drawTests, listTests]; // only where a run has mechanical tests
  let heading, facts, panels; // panels: {show, place}

  // one run: its maps and the facts on the left, what a point holds on the right; several: maps side by side above
  function addPanels(parent) {
    maps.length = 0;
    const several = page.runs.length > 1;
    const above = several ? make(parent, "div", "maps") : null;
    const grid = make(parent, "div", "two");
    const [left, right] = [make(grid, "div"), make(grid, "div")];
    page.runs.forEach((run) => run.bands.forEach((_, band) => addMap(above || left, run, band)));
    heading = make(left, "h2");
    facts = make(left, "div", "facts");
    const shown = [...PANELS, ...(page.runs.some((run) => run.tested) ? TESTED : [])];
    panels = shown.map((show) => ({ show, place: make(right, "div", show === listTests ? "facts" : "plot") }));
    drawMaps();
  }

  function drawDetails(entries, title = "") {
    heading.textContent = title || entries.map((each) => nameOf(each.run, each.point)).join(" and ");
    facts.replaceChildren();
    const table = make(facts, "table");
    const columns = entries.map(({ point, detail }) => rows(point, detail && detail.truth));
    (columns[0] || []).forEach(([name], k) => {
      const row = make(table, "tr");
      make(row, "td", "text", name);
      columns.forEach((column) => make(row, "td", "text", (column.find((each) => each[0] === name) || ["", "-"])[1]));
    });
    entries.forEach(({ run, point, detail }) => ((detail && detail.poles) || []).forEach((pole) => {
      if (pole.message && !point.reason.includes(pole.message)) make(facts, "p", "note", `${nameOf(run, point)}, ${pole.band_hz.join(" to ")} Hz: ${pole.message}`);
    }));
    panels.forEach(({ show, place }) => show(place, entries));
  }

  const nothing = (place, title, why) => draw(place, [], { title, xaxis: { visible: false }, yaxis: { visible: false },
    annotations: [{ text: why, showarrow: false, font: { size: 13, color: "#777" } }] });

  const level = (re, im) => re.map((_, k) => 20 * Math.log10(Math.hypot(re[k], im[k])));
  const phase = (re, im) => re.map((_, k) => (180 / Math.PI) * Math.atan2(im[k], re[k]));
  const DB = 20 / Math.LN10;

  function drawFrf(place, entries) {
    const there = entries.filter(({ detail }) => detail && detail.frf && detail.frf.lines);
    const known = !there.length || there.some(({ detail }) => detail.frf.std.some((std) => std !== null));
    const title = known ? "frequency response, 95 % bars, and the model" : "frequency response of one period, with its transient; errors unknown";
    if (!there.length) return nothing(place, title, "no FRF of this point in the page");
    const traces = [];
    let range = null;
    there.forEach(({ run, point, detail }, n) => {
      const frf = detail.frf, colour = COLOURS[n % COLOURS.length], name = plain(nameOf(run, point));
      const bars = frf.std.map((std, k) => (std === null ? 0 : (frf.bar_stds * DB * std) / Math.hypot(frf.re[k], frf.im[k])));
      const data = { type: "scatter", mode: "markers", x: frf.frequency_hz, marker: { size: 4, color: colour }, legendgroup: `${n}` };
      traces.push({ ...data, y: level(frf.re, frf.im), name, error_y: { type: "data", array: bars, thickness: 1, width: 2 } });
      traces.push({ ...data, y: phase(frf.re, frf.im), yaxis: "y2", showlegend: false });
      if (frf.std.some((std) => std !== null)) {
        traces.push({ ...data, y: frf.std.map((std) => (std === null ? null : 20 * Math.log10(std))), name: `its standard deviation (${frf.std_of})`,
          marker: { size: 3, color: colour, symbol: "circle-open" } });
      }
      frf.models.forEach((model, m) => {
        const curve = { type: "scatter", mode: "lines", x: model.frequency_hz, line: { color: "black", width: 1 }, hoverinfo: "skip", legendgroup: `${n}` };
        traces.push({ ...curve, y: level(model.re, model.im), name: "model", showlegend: m === 0 && n === 0 });
        traces.push({ ...curve, y: phase(model.re, model.im), yaxis: "y2", showlegend: false });
        const ends = [model.frequency_hz[0], model.frequency_hz[model.frequency_hz.length - 1]];
        range = range ? [Math.min(range[0], ends[0]), Math.max(range[1], ends[1])] : ends;
      });
    });
    draw(place, traces, { title, xaxis: axis("frequency [Hz]", { anchor: "y2", ...(range ? { range } : {}) }),
      yaxis: axis("|G| [dB]", { domain: [0.42, 1] }), yaxis2: axis("phase [degrees]", { domain: [0, 0.34] }) });
  }

  // points of the 95 % ellipse about (re, im) with covariance [rr, ri, ii]
  function ellipse(pole) {
    const [a, b, c] = pole.plane;
    const p = Math.sqrt(a), q = b / p, r = Math.sqrt(Math.max(c - q * q, 0)); // Cholesky
    const at = Array.from({ length: 49 }, (_, k) => (k * Math.PI) / 24);
    return { x: at.map((t) => pole.re + CHI * p * Math.cos(t)), y: at.map((t) => pole.im + CHI * (q * Math.cos(t) + r * Math.sin(t))) };
  }

  const hasEllipse = (pole) => pole.plane && pole.plane.every((value) => value !== null) && pole.re !== null;

  function drawPlane(place, entries) {
    const title = "poles in the s-plane, 95 % ellipses";
    const traces = [], corners = { x: [], y: [] };
    page.runs.forEach((run) => {
      const all = run.bands[0].points.filter((p) => p.re !== null), step = Math.ceil(all.length / MOST_OTHERS);
      const others = all.filter((_, k) => k % step === 0);
      traces.push({ type: "scatter", mode: "markers", x: others.map((p) => p.re), y: others.map((p) => p.im), name: "all points",
        showlegend: false, text: others.map((p) => plain(`${nameOf(run, p)}: ${tissueOf(p)}`)), hoverinfo: "text", marker: { color: "#bbb", size: 5 } });
    });
    entries.forEach(({ run, point, detail }, n) => {
      const colour = COLOURS[n % COLOURS.length];
      const poles = detail && detail.poles.length ? detail.poles : [point];
      poles.filter((pole) => pole.re !== null).forEach((pole, k) => {
        traces.push({ type: "scatter", mode: "markers", x: [pole.re], y: [pole.im], name: plain(nameOf(run, point)), legendgroup: `${n}`,
          showlegend: k === 0, marker: { symbol: "cross-thin", size: 11, line: { color: colour, width: 2 } } });
        if (hasEllipse(pole)) {
          const loop = ellipse(pole);
          traces.push({ type: "scatter", mode: "lines", ...loop, line: { color: colour, width: 1.5 }, hoverinfo: "skip", showlegend: false });
          if (k === 0) { corners.x.push(...loop.x); corners.y.push(...loop.y); }
        }
      });
      const truth = detail && detail.truth;
      if (truth && truth.re !== null) traces.push({ type: "scatter", mode: "markers", x: [truth.re], y: [truth.im], name: "truth of the simulation",
        marker: { symbol: "star", size: 9, color: "red" } });
    });
    const wide = (values) => {
      if (!values.length) return {};
      const [low, high] = rangeOf(values), more = 1.2 * (high - low);
      return { range: [low - more, high + more] };
    };
    draw(place, traces, { title, xaxis: axis("real part [rad/s]", wide(corners.x)), yaxis: axis("imaginary part [rad/s]", wide(corners.y)),
      uirevision: `${heading.textContent}` });
  }

  function drawForce(place, entries) {
    const title = "force while it was measured";
    const there = entries.filter(({ detail }) => detail && detail.force && detail.force.t_s.length);
    if (!there.length) return nothing(place, title, "no force of this point in the page");
    const traces = there.map(({ run, point, detail }, n) => ({
      type: "scatter", mode: "lines+markers", x: detail.force.t_s, y: detail.force.force_mn, name: plain(nameOf(run, point)),
      marker: { size: 4, color: COLOURS[n % COLOURS.length] }, line: { width: 1 } }));
    const shapes = there.flatMap(({ run, point }, n) => {
      const colour = COLOURS[n % COLOURS.length], wide = { type: "rect", xref: "paper", x0: 0, x1: 1, line: { width: 0 } };
      const lines = run.force_mn === null ? [] : [{ type: "line", xref: "paper", x0: 0, x1: 1, y0: run.force_mn, y1: run.force_mn, line: { color: "#888", dash: "dot" } }];
      if (point.force_mn === null || point.force_std_mn === null) return lines;
      const half = 1.96 * point.force_std_mn;
      return [...lines, { ...wide, y0: point.force_mn - half, y1: point.force_mn + half, fillcolor: colour, opacity: 0.15 }];
    });
    draw(place, traces, { title, shapes, xaxis: axis("time [s]"), yaxis: axis("force [mN]"), showlegend: there.length > 1 });
  }

  const testsOf = (entries) => entries.flatMap(({ run, point, detail }) => ((detail && detail.tests) || []).map((test) => ({
    test, name: (entries.length > 1 ? `${nameOf(run, point)}, ` : "") + test.protocol })));

  function drawTests(place, entries) {
    const all = testsOf(entries), fitted = all.filter(({ test }) => test.curve);
    const title = "mechanical tests: means of the force and the fit; depth" + (all.some(({ test }) => test.simulated) ? " (simulated)" : "");
    if (!fitted.length) return nothing(place, title, all.length ? "could not be fitted" : "no mechanical test of this point in the page");
    const traces = fitted.flatMap(({ test, name }, n) => {
      const curve = test.curve, colour = COLOURS[n % COLOURS.length], common = { type: "scatter", x: curve.t_s, legendgroup: `${n}` };
      return [
        { ...common, mode: "markers", y: curve.measured_mn, name: plain(name), marker: { size: 4, color: colour } },
        { ...common, mode: "lines", y: curve.model_mn, name: "fit", showlegend: n === 0, hoverinfo: "skip", line: { color: "black", width: 1 } },
        { ...common, mode: "lines", y: curve.depth_mm, yaxis: "y2", name: plain(name), showlegend: false, line: { color: colour, width: 1 } },
      ];
    });
    // most of a relaxation is soon over; of unloading the end matters
    const scale = fitted.some(({ test }) => test.protocol === "indentation") ? {} : { type: "log", dtick: 1 };
    return draw(place, traces, { title, xaxis: axis("time from the touch [s]", { anchor: "y2", ...scale }),
      yaxis: axis("force [mN]", { domain: [0.36, 1] }), yaxis2: axis("depth [mm]", { domain: [0, 0.28] }) });
  }

  // [constant, value, relative deviation] of a fit; what the record does not determine says so
  function constantsOf(test) {
    const percent = (std) => `± ${(100 * std).toPrecision(2)} %`;
    const pascal = (value) => `${value.toFixed(0)} Pa`;
    const found = Object.entries(test.modulus_pa).filter(([, [value]]) => value !== null).sort((a, b) => a[0] - b[0])
      .map(([at, [value, std]]) => [`E(${at} s)`, pascal(value), percent(std)]);
    const [value, std, known] = test.equilibrium_pa;
    found.push(known === "determined" ? ["Einf", pascal(value), percent(std)] : ["Einf", known, ""]);
    test.terms.forEach((term, k) => {
      if (term.known !== "determined") return found.push([`E${k + 1}, tau${k + 1}`, `${term.known} (about ${term.time_s.toPrecision(2)} s)`, ""]);
      return found.push([`E${k + 1}`, pascal(term.modulus_pa), percent(term.modulus_std)], [`tau${k + 1}`, `${term.time_s.toPrecision(3)} s`, percent(term.time_std)]);
    });
    return found;
  }

  function listTests(place, entries) {
    place.replaceChildren();
    testsOf(entries).forEach(({ test, name }) => {
      if (!test.curve) return make(place, "p", "note", `${name}: not fitted: ${test.reason}`);
      make(place, "h3", "", `${name}: peak ${(1e3 * test.peak_force_n).toFixed(1)} mN, ramp ${test.ramp_s.toFixed(2)} s, ` +
        `hold ${test.hold_s.toFixed(1)} s` + (test.protocol === "relaxation" ? `, ${(100 * test.relaxed_share).toFixed(0)} % lost` : ""));
      const table = make(place, "table");
      constantsOf(test).forEach((cells) => {
        const row = make(table, "tr");
        cells.forEach((cell) => make(row, "td", "text", cell));
      });
      return make(place, "p", "note", `status: ${test.status.join("; ") || "no remark"}`);
    });
  }

  // ---- the whole page

  function build() {
    const first = make(root, "div", page.runs.length > 1 ? "" : "screen"); // one run has its map on paper as a picture
    if (page.note) make(first, "p", "note", page.note);
    addPanels(first);
    const asked = new URLSearchParams(location.hash.slice(1));
    const run = page.runs[Number(asked.get("run") || 1) - 1] || page.runs[0];
    const points = run.bands.length ? run.bands[0].points : [];
    const wanted = points.find((p) => p.index === Number(asked.get("point")) - 1);
    const start = wanted || points.find((p) => run.details[p.index]) || points[0];
    if (start) choose(run, start.index, false);
    if (wanted) pinned = true;
    document.querySelectorAll("tr[data-point]").forEach((row) => row.addEventListener("click", () => {
      pinned = true;
      choose(page.runs[Number(row.dataset.run)], Number(row.dataset.point), true);
      first.scrollIntoView();
    }));
    if (page.figures.length) {
      make(root, "h2", "", page.heading);
      const figures = make(root, "div", "figures");
      const places = page.figures.map((figure) => {
        const box = make(figures, "div", "figure");
        const place = figure.traces.length ? make(box, "div", "plot") : make(box, "h3", "", figure.title);
        make(box, "p", "note", figure.note);
        return place;
      });
      page.figures.forEach((figure, k) => {
        if (figure.traces.length) draw(places[k], figure.traces, { ...figure.layout, title: plain(figure.title) });
      });
    }
  }

  // paper is narrower than the window, and drawings have the width of what they were drawn for
  function forPaper() {
    document.querySelectorAll(".js-plotly-plot").forEach((place) => Plotly.relayout(place, { width: PAPER_WIDTH, height: 400 }));
  }
  function forScreen() {
    document.querySelectorAll(".js-plotly-plot").forEach((place) => Plotly.relayout(place, { width: null, height: null, autosize: true }));
  }
  window.addEventListener("beforeprint", forPaper);
  window.addEventListener("afterprint", forScreen);

  // ---- a live page

  function follow() {
    const box = make(root, "div");
    const state = make(box, "p", "state", "waiting for the nodes");
    const told = make(box, "p", "note");
    const again = make(box, "button", "", "follow the scan again");
    again.hidden = true;
    again.addEventListener("click", () => { pinned = false; });
    const strip = make(box, "div", "plot low");
    const rest = make(root, "div");
    const forces = [];
    let newest = null, heard = 0;

    const showState = (now) => {
      state.textContent = now.text;
      told.textContent = `${now.points} points, ${now.failed} failed` + (now.simulated ? "; simulated, not measured" : "");
      again.hidden = !pinned;
      if (page.runs.length) page.runs[0].simulated = now.simulated;
      forces.push(...now.forces);
      while (forces.length && forces[0][0] < forces[forces.length - 1][0] - 20) forces.shift();
      const end = forces.length ? forces[forces.length - 1][0] : 0;
      draw(strip, [{ type: "scatter", mode: "lines", x: forces.map((f) => f[0] - end), y: forces.map((f) => f[1]), line: { color: COLOURS[0] } }],
        { title: "force [mN], last 20 s", margin: { l: 58, r: 14, t: 30, b: 24 }, xaxis: axis("", { range: [-20, 0] }), yaxis: axis("") });
    };
    const rebuild = () => {
      rest.replaceChildren();
      addPanels(rest);
      selected = null;
      const last = page.runs[0].newest;
      if (last !== null) choose(page.runs[0], last, false);
    };
    const events = new EventSource("events");
    const on = (name, take) => events.addEventListener(name, (event) => { heard = Date.now(); take(JSON.parse(event.data)); });
    on("run", (run) => { page.runs = [run]; rebuild(); });
    on("now", showState);
    on("point", ({ bands, details }) => {
      const run = page.runs[0];
      bands.forEach((point, band) => {
        const points = run.bands[band].points, at = points.findIndex((p) => p.index === point.index);
        if (at < 0) points.push(point); else points[at] = point;
      });
      Object.assign(run.details, details);
      maps.forEach(drawMap);
      if (!pinned) choose(run, bands[0].index, false);
    });
    on("surface", ({ band, surface }) => {
      page.runs[0].bands[band].surface = surface;
      maps.forEach(drawMap);
    });
    on("measuring", (entry) => {
      newest = { run: page.runs[0], point: entry.point, detail: entry.detail };
      if (!pinned) drawDetails([newest], `under way: ${entry.title}`);
    });
    setInterval(() => { if (heard && Date.now() - heard > 3000) state.textContent = "nothing heard from the server"; }, 1000);
  }

  if (page.live) follow(); else build();
})();
