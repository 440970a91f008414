// The interactive part of a flight's report: map and plots by Plotly, one cursor in time for both.
"use strict";

const { figures, series, colours, engaged: steering } = JSON.parse(document.getElementById("flight").textContent);
const { rows } = series;

const INK = "#1f2933", SOFT = "#7a8794", RULE = "#e6eaee", ACCENT = "#1d5fa8", PALE = "rgba(29,95,168,0.16)";
const REFUSED = [
  ["outlier", "#b3261e", "x"], ["jump", "#b3261e", "cross"], ["absurd", "#b3261e", "square"],
  ["no line of sight", "#e07b00", "triangle-up"], ["stale", "#e07b00", "triangle-left"],
  ["repeated", "#8a5fb0", "diamond"], ["out of order", "#8a5fb0", "triangle-right"],
  ["second publisher", SOFT, "star"], ["unknown beacon", SOFT, "square-open"],
];
const STATION = figures.problem.kind === "station", AIM = STATION ? "station" : "target";
const FONT = { family: getComputedStyle(document.body).fontFamily, size: 12, color: INK };
const CONFIG = { responsive: true, displayModeBar: false, showTips: false };

const colour = (phase) => colours[phase];
const plain = (text) => String(text).replace(/[<>&]/g, (c) => ({ "<": "&lt;", ">": "&gt;", "&": "&amp;" })[c]);
const known = (...values) => values.every((v) => v !== null && v !== undefined);
const rad = (deg) => (deg * Math.PI) / 180;

// ------------------------------------------------------------------------------------------------ geometry

/** Where the estimate of row i puts the target, off by so many metres and degrees. */
function target(i, metres = 0, degrees = 0) {
  const azimuth = rad(rows.heading[i] - rows.b[i] - degrees), d = rows.d[i] + metres;
  return [rows.x[i] + d * Math.cos(azimuth), rows.y[i] + d * Math.sin(azimuth)];
}

const hasEstimate = (i) => known(rows.x[i], rows.y[i], rows.heading[i], rows.d[i], rows.b[i], rows.sd[i], rows.sb[i]);

/** The 2σ region of row i: the ellipse in distance and bearing, drawn on the map, where it is bent. */
function region(i) {
  const x = [], y = [], wide = Math.min(2 * rows.sb[i], 180), deep = 2 * rows.sd[i], points = 240;
  for (let k = 0; k <= points; k++) {
    const phi = (2 * Math.PI * k) / points;
    const [px, py] = target(i, Math.max(deep * Math.cos(phi), -rows.d[i]), wide * Math.sin(phi));
    x.push(px); y.push(py);
  }
  return [x, y];
}

/** Moments whose regions are drawn for good: each has a third of the area of the one before. */
function moments() {
  const found = [];
  let area = Infinity;
  for (let i = 0; i < rows.t.length && found.length < 6; i++) {
    if (!hasEstimate(i) || rows.sb[i] > 60 || !engaged(i)) continue;
    const now = rows.d[i] * rad(rows.sb[i]) * rows.sd[i];
    if (now > 0 && now < area / 3) { area = now; found.push(i); }
  }
  return found;
}

function disc([cx, cy], radius) {
  const x = [], y = [];
  for (let k = 0; k <= 72; k++) {
    const phi = (2 * Math.PI * k) / 72;
    x.push(cx + radius * Math.cos(phi)); y.push(cy + radius * Math.sin(phi));
  }
  return [x, y];
}

const seconds = (t) => `${t.toFixed(1)} s`;

// ----------------------------------------------------------------------------------------------------- map

const engaged = (i) => steering.includes(rows.phase[i]);
const anyEngaged = rows.phase.some((_, i) => engaged(i));

function paths() {
  const traces = [], named = new Set();
  let run = null;
  rows.t.forEach((t, i) => {
    if (!known(rows.x[i], rows.y[i]) || (anyEngaged && !engaged(i))) { run = null; return; }
    const phase = rows.phase[i];
    if (run === null || run.phase !== phase) {
      const before = run;
      run = {
        phase, x: [], y: [], customdata: [], mode: "lines", type: "scatter", legendgroup: phase, name: phase,
        showlegend: !named.has(phase), line: { color: colour(phase), width: 4 }, text: [],
        hovertemplate: "%{text}<br>East %{x:.2f} m, North %{y:.2f} m<extra></extra>",
      };
      if (before) { run.x.push(before.x.at(-1)); run.y.push(before.y.at(-1)); run.customdata.push(t); run.text.push(phase); }
      named.add(phase); traces.push(run);
    }
    run.x.push(rows.x[i]); run.y.push(rows.y[i]); run.customdata.push(t); run.text.push(`${seconds(t)}, ${phase}`);
  });
  return traces;
}

function estimates() {
  const at = rows.t.map((_, i) => i).filter((i) => hasEstimate(i) && engaged(i));
  const traces = moments().map((i, n) => {
    const [x, y] = region(i);
    return {
      x, y, type: "scatter", mode: "lines", line: { color: ACCENT, width: 1, dash: "dot" }, opacity: 0.6,
      name: "estimate 2σ, as it shrinks", legendgroup: "regions", showlegend: n === 0, hoverinfo: "text",
      text: `2σ of the estimate at ${seconds(rows.t[i])}`,
    };
  });
  const points = at.map((i) => target(i));
  traces.push({
    x: points.map((p) => p[0]), y: points.map((p) => p[1]), customdata: at.map((i) => rows.t[i]), type: "scatter",
    mode: "markers", marker: { size: 4, color: ACCENT, opacity: 0.4 }, name: "estimate over time",
    text: at.map((i) => `estimate at ${seconds(rows.t[i])}`), hovertemplate: "%{text}<extra></extra>",
  });
  return traces;
}

function mapTraces() {
  const s = figures.summary, radius = figures.problem.radius_m, traces = [];
  const last = known(s.target_x_m, s.target_y_m) ? [s.target_x_m, s.target_y_m] : null;
  const aim = series.truth ? series.truth.target : last;
  if (aim) {
    const [x, y] = disc(aim, radius);
    traces.push({
      x, y, type: "scatter", mode: "lines", fill: "toself", fillcolor: "rgba(47,143,91,0.13)", hoverinfo: "skip",
      line: { color: "#2f8f5b", width: 1 }, name: `${STATION ? "station" : "capture"} radius, ${radius} m`,
    });
  }
  if (series.truth) {
    traces.push({
      x: series.truth.x, y: series.truth.y, type: "scatter", mode: "lines", line: { color: SOFT, width: 1 },
      name: "true path", hoverinfo: "skip",
    });
  }
  if (series.shortest) {
    traces.push({
      x: series.shortest.x, y: series.shortest.y, type: "scatter", mode: "lines", hoverinfo: "skip",
      line: { color: INK, width: 1.5, dash: "dash" }, name: `shortest path, ${series.shortest.length_m.toFixed(2)} m`,
    });
  }
  traces.push(...estimates(), ...paths());
  if (s.start) {
    traces.push({
      x: [s.start.x_m], y: [s.start.y_m], type: "scatter", mode: "markers", name: "start", hoverinfo: "name",
      marker: { symbol: "circle", size: 10, color: "#ffffff", line: { color: INK, width: 2 } },
    });
  }
  if (series.truth) {
    const [x, y] = series.truth.target, beacons = series.truth.beacons;
    if (beacons.length) {
      traces.push({
        x: beacons.map((b) => b[0]), y: beacons.map((b) => b[1]), type: "scatter", mode: "markers", name: "true beacons",
        hoverinfo: "name+x+y", marker: { symbol: "triangle-up", size: 10, color: "#f2b705", line: { color: INK, width: 1 } },
      });
    }
    traces.push({
      x: [x], y: [y], type: "scatter", mode: "markers", name: `true ${AIM}`, hoverinfo: "name",
      marker: { symbol: "star", size: 14, color: "#f2b705", line: { color: INK, width: 1 } },
    });
  }
  if (last) {
    traces.push({
      x: [last[0]], y: [last[1]], type: "scatter", mode: "markers", name: `${AIM}, estimated last`, hoverinfo: "name",
      marker: { symbol: "x-thin", size: 11, line: { color: INK, width: 2 } },
    });
  }
  return traces;
}

/** What moves with the cursor: the region, the line of sight, the vehicle. */
const MOVING = [
  { x: [], y: [], type: "scatter", mode: "lines", fill: "toself", fillcolor: PALE, line: { color: ACCENT, width: 1.5 },
    name: "estimate 2σ at the cursor", hoverinfo: "skip" },
  { x: [], y: [], type: "scatter", mode: "lines", line: { color: ACCENT, width: 1 }, showlegend: false, hoverinfo: "skip" },
  { x: [], y: [], type: "scatter", mode: "markers", showlegend: false, hoverinfo: "skip",
    marker: { symbol: "arrow", size: 16, angle: 0, color: INK, line: { color: "#ffffff", width: 1 } } },
];

/** The window of the map: all that was flown and flown to; not the first, wide guesses of the estimate. */
function mapWindow(traces) {
  const inside = traces.filter((t) => t.legendgroup !== "regions" && !t.name.startsWith("estimate"));
  const xs = inside.flatMap((t) => t.x), ys = inside.flatMap((t) => t.y);
  if (!xs.length) return [[-5, 5], [-5, 5]];
  const span = (v) => {
    const low = v.reduce((a, b) => Math.min(a, b)), high = v.reduce((a, b) => Math.max(a, b));
    const margin = Math.max(0.07 * (high - low), 0.5);
    return [low - margin, high + margin];
  };
  return [span(xs), span(ys)];
}

const SYMBOLS = { circle: "○", star: "★", "x-thin": "✕", "triangle-up": "▲" };

/** What is what on the map, in HTML, so that it takes the room that it needs on any screen. */
function drawKey(traces) {
  const drawn = (t) => t.x.length > 0 || (MOVING.includes(t) && rows.d.some(known));
  const shown = traces.filter((t) => t.name && t.showlegend !== false && drawn(t));
  document.getElementById("key").replaceChildren(...shown.map((t) => {
    const item = document.createElement("li"), swatch = document.createElement("span");
    if (t.mode === "markers") {
      swatch.textContent = SYMBOLS[t.marker.symbol] ?? "•";
      swatch.style.color = ["star", "triangle-up"].includes(t.marker.symbol) ? t.marker.color : t.marker.opacity ? ACCENT : INK;
    } else {
      const style = { dash: "dashed", dot: "dotted" }[t.line.dash] ?? "solid";
      swatch.className = "line";
      swatch.style.borderTop = `${t.line.width}px ${style} ${t.line.color}`;
      if (t.fill) { swatch.className = "area"; swatch.style.border = `1px solid ${t.line.color}`; swatch.style.background = t.fillcolor; }
    }
    item.append(swatch, t.name);
    return item;
  }));
}

let moving = [];

function drawMap() {
  const div = document.getElementById("map");
  if (!rows.x.some((x, i) => known(x, rows.y[i]))) {
    div.outerHTML = '<p class="empty">No map: the autopilot told no position.</p>';
    return null;
  }
  const traces = mapTraces(), [x, y] = mapWindow(traces);
  moving = MOVING.map((_, i) => traces.length + i);
  const axis = { gridcolor: RULE, zerolinecolor: RULE, linecolor: SOFT, ticks: "outside", tickcolor: SOFT };
  Plotly.newPlot(div, [...traces, ...MOVING], {
    font: FONT, margin: { l: 52, r: 8, t: 8, b: 42 }, hovermode: "closest", dragmode: "pan", showlegend: false,
    paper_bgcolor: "#ffffff", plot_bgcolor: "#ffffff",
    xaxis: { ...axis, range: x, title: { text: "East, m", standoff: 6 } },
    yaxis: { ...axis, range: y, title: { text: "North, m", standoff: 6 }, scaleanchor: "x", scaleratio: 1 },
  }, { ...CONFIG, scrollZoom: true });
  drawKey([...traces, ...MOVING]);
  div.on("plotly_hover", ({ points }) => { if (known(points[0].customdata)) setTime(points[0].customdata); });
  return div;
}

// --------------------------------------------------------------------------------------------------- plots

const told = series.answers.t.length + series.transports.t.length > 0;
const ROWS = [
  { key: "phase", share: 0.5, title: "" },
  { key: "range", share: 3, title: "range and distance, m" },
  { key: "bearing", share: 2.3, title: "bearing, ° (right positive)" },
  { key: "speed", share: 1.7, title: "forward speed, m/s" },
  { key: "yaw", share: 1.7, title: "yaw rate, °/s (left positive)" },
  { key: "height", share: 1.5, title: "height, m" },
  ...(told ? [{ key: "delay", share: 1.6, title: "latency, ms" }] : []),
];

/** Closed outlines of `low` to `high`, cut where either is not known. */
function band(t, low, high) {
  const x = [], y = [];
  let run = [];
  const close = () => {
    if (run.length > 1) {
      const back = [...run].reverse();
      x.push(...run.map((i) => t[i]), ...back.map((i) => t[i]), t[run[0]], null);
      y.push(...run.map((i) => high[i]), ...back.map((i) => low[i]), high[run[0]], null);
    }
    run = [];
  };
  t.forEach((_, i) => { if (known(low[i], high[i])) run.push(i); else close(); });
  close();
  return { x, y, type: "scatter", mode: "lines", fill: "toself", fillcolor: PALE, line: { width: 0 }, hoverinfo: "skip" };
}

/** A line over the circle, broken where it jumps from one end to the other. */
function around(t, degrees) {
  const x = [], y = [];
  degrees.forEach((v, i) => {
    if (i && known(v, degrees[i - 1]) && Math.abs(v - degrees[i - 1]) > 180) { x.push(t[i]); y.push(null); }
    x.push(t[i]); y.push(v);
  });
  return { x, y };
}

const top_ = (values) => values.reduce((a, b) => Math.max(a, b), 0);

function plotTraces() {
  const traces = [];
  const add = (row, trace) => traces.push({
    type: "scatter", mode: "lines", xaxis: "x", yaxis: row ? `y${row + 1}` : "y", legend: `legend${row + 1}`, ...trace,
  });
  ROWS.forEach((_, row) => add(row, { x: [null], y: [null], showlegend: false, hoverinfo: "skip" }));  // axes for all
  const spans = figures.phases.filter((p) => p.to_s > p.from_s);
  add(0, {
    type: "bar", orientation: "h", y: spans.map(() => "phase"), base: spans.map((p) => p.from_s), width: 1,
    x: spans.map((p) => p.to_s - p.from_s), text: spans.map((p) => p.phase), textposition: "inside", showlegend: false,
    insidetextanchor: "middle", textangle: 0, marker: { color: spans.map((p) => colour(p.phase)) },
    customdata: spans.map((p) => [plain(p.reason), seconds(p.from_s), seconds(p.to_s)]), insidetextfont: { size: 11.5 },
    hovertemplate: "<b>%{text}</b> from %{customdata[1]} to %{customdata[2]}<br>%{customdata[0]}<extra></extra>",
  });

  const believed = series.ranges.find((r) => r.verdict === "accepted");
  const limit = 1.12 * Math.max(1, top_(believed?.m ?? []), top_(rows.d.filter((d, i) => known(d) && engaged(i))));
  const clip = (v, low, high) => Math.min(Math.max(v, low), high);
  add(1, {
    ...band(rows.t, rows.d.map((d, i) => known(d, rows.sd[i]) ? clip(d - 2 * rows.sd[i], 0, limit) : null),
      rows.d.map((d, i) => known(d, rows.sd[i]) ? clip(d + 2 * rows.sd[i], 0, limit) : null)), showlegend: false,
  });
  for (const fate of series.ranges) {
    const [, tint, symbol] = REFUSED.find(([name]) => name === fate.verdict) ?? ["", "#c8372d", "cross-open"];
    const fine = fate.verdict === "accepted";
    add(1, {
      x: fate.t, y: fate.m.map((m) => Math.min(m, limit)), mode: "markers",
      name: `${fine ? "range believed" : plain(fate.verdict)} (${fate.count})`,
      marker: fine ? { size: 3.5, color: SOFT } : { size: fate.t.length > 150 ? 4.5 : 7, color: tint, symbol },
      text: fate.m.map((m, i) => `${plain(fate.beacon[i])}: ${m.toFixed(2)} m, ${plain(fate.verdict)}`),
      hovertemplate: "%{text}<extra></extra>",
    });
  }
  add(1, { x: rows.t, y: rows.d, name: "distance ± 2σ", line: { color: ACCENT, width: 2 },
    hovertemplate: "distance %{y:.2f} m<extra></extra>" });

  const low = rows.b.map((b, i) => known(b, rows.sb[i]) ? Math.max(b - 2 * rows.sb[i], -180) : null);
  const high = rows.b.map((b, i) => known(b, rows.sb[i]) ? Math.min(b + 2 * rows.sb[i], 180) : null);
  add(2, { ...band(rows.t, low, high), showlegend: false });
  add(2, { ...around(rows.t, rows.b), name: "bearing ± 2σ", line: { color: ACCENT, width: 2 },
    hovertemplate: "bearing %{y:.0f}°<extra></extra>" });

  const pair = (row, flown, asked, unit) => {
    add(row, { x: flown[0], y: flown[1], name: "flown", line: { color: SOFT, width: 1.5 },
      hovertemplate: `flown %{y:.2f} ${unit}<extra></extra>` });
    add(row, { x: asked[0], y: asked[1], name: "commanded", line: { color: ACCENT, width: 2, shape: "hv" },
      hovertemplate: `commanded %{y:.2f} ${unit}<extra></extra>` });
  };
  pair(3, series.speed_flown, series.speed_asked, "m/s");
  pair(4, series.yaw_flown, series.yaw_asked, "°/s");
  pair(5, series.height_flown, series.height_asked, "m");
  const dots = (of, name, tint) => add(6, { x: of.t, y: of.ms, mode: "markers", name, marker: { size: 3.5, color: tint },
    hovertemplate: `${name}: %{y:.2f} ms<extra></extra>` });
  if (series.transports.t.length) dots(series.transports, "transport of a range, beyond the quickest", SOFT);
  if (series.answers.t.length) dots(series.answers, "range arrived → setpoint handed over", ACCENT);
  return { traces, limit };
}

/** From a second before the first engagement to a second after the last; all of it if there was none. */
function flightWindow() {
  const t = rows.t.filter((_, i) => engaged(i));
  const [a, b] = t.length ? [t[0] - 1, t.at(-1) + 1] : [rows.t[0] ?? 0, rows.t.at(-1) ?? 1];
  return [a, Math.max(b, a + 1)];
}

const wholeWindow = () => [rows.t[0] ?? 0, Math.max(rows.t.at(-1) ?? 1, (rows.t[0] ?? 0) + 1)];

/** The extremes of a line's values in a window of time, with room around them. */
function span(lines, [from, to], least) {
  let low = Infinity, high = -Infinity;
  for (const [t, v] of lines) {
    t.forEach((s, i) => { if (known(v[i]) && s >= from && s <= to) { low = Math.min(low, v[i]); high = Math.max(high, v[i]); } });
  }
  if (low > high) return [0, 1];
  const room = Math.max(0.12 * (high - low), least);
  return [low - room, high + room];
}

/** Whole decades around these values, at least two of them: a range of a logarithmic axis. */
function decades(values) {
  const positive = values.filter((v) => v > 0);
  if (!positive.length) return [-1, 1];
  const low = Math.floor(Math.log10(positive.reduce((a, b) => Math.min(a, b))));
  return [Math.max(low, -2), Math.max(Math.ceil(Math.log10(top_(positive))), low + 2)];
}

function plotLayout(limit, narrow) {
  const window_ = flightWindow(), total = ROWS.reduce((sum, row) => sum + row.share, 0), gap = narrow ? 0.05 : 0.036;
  const usable = 1 - gap * (ROWS.length - 1);
  const layout = {
    font: FONT, margin: { l: 46, r: 10, t: 8, b: 40 }, hovermode: "x", hoverdistance: 30, dragmode: "zoom",
    paper_bgcolor: "#ffffff", plot_bgcolor: "#ffffff", bargap: 0, annotations: [], shapes: [],
    uniformtext: { mode: "hide", minsize: 10 },
    xaxis: {
      range: window_, anchor: `y${ROWS.length}`, gridcolor: RULE, zeroline: false, linecolor: SOFT, ticks: "outside",
      tickcolor: SOFT, title: { text: "seconds since OFFBOARD was selected", standoff: 6 }, hoverformat: ".2f",
    },
  };
  if (!anyEngaged) layout.xaxis.title.text = "seconds";
  const ranges = [
    [-0.5, 0.5], [0, 1.05 * limit], [-185, 185], span([series.speed_flown, series.speed_asked], window_, 0.05),
    span([series.yaw_flown, series.yaw_asked], window_, 3), span([series.height_flown, series.height_asked], window_, 0.3),
    decades([...series.transports.ms, ...series.answers.ms]),
  ];
  let bottom = 1;
  ROWS.forEach((row, i) => {
    const height = (usable * row.share) / total, head = bottom;
    bottom -= height;
    layout[i ? `yaxis${i + 1}` : "yaxis"] = {
      domain: [Math.max(bottom, 0), head], fixedrange: true, gridcolor: RULE, zerolinecolor: "#aab4be", anchor: "x",
      range: ranges[i] ?? undefined, nticks: 5, tickfont: { size: 11 },
      ...(row.key === "phase" ? { showticklabels: false, type: "category", showgrid: false } : {}),
      ...(row.key === "bearing" ? { tickvals: [-180, -90, 0, 90, 180], nticks: undefined } : {}),
      ...(row.key === "delay" ? { type: "log", nticks: 4, dtick: 1, tickformat: "~g" } : {}),
    };
    layout[`legend${i + 1}`] = {
      orientation: "h", x: narrow ? 0 : 1, xanchor: narrow ? "left" : "right", y: head - 0.004, yanchor: "bottom", font: { ...FONT, size: 11 },
      bgcolor: "rgba(0,0,0,0)", itemwidth: 30,
    };
    layout.annotations.push({
      text: `<b>${row.title}</b>`, xref: "paper", yref: "paper", x: 0, xanchor: "left", y: head, yanchor: "bottom",
      showarrow: false, font: { ...FONT, size: 11.5 }, yshift: narrow ? (row.key === "range" ? 34 : 17) : 0,
    });
    bottom -= gap;
  });
  for (const span_ of figures.phases) {
    if (!steering.includes(span_.phase)) continue;
    layout.shapes.push({
      type: "rect", xref: "x", yref: "paper", x0: span_.from_s, x1: span_.to_s, y0: 0, y1: 1, layer: "below",
      fillcolor: colour(span_.phase), opacity: 0.07, line: { width: 0 },
    });
  }
  layout.shapes.push({
    type: "line", xref: "paper", yref: "y2", x0: 0, x1: 1, y0: figures.problem.radius_m, y1: figures.problem.radius_m,
    line: { color: "#2f8f5b", width: 1, dash: "dash" },
  });
  const missing = (row, text) => layout.annotations.push({
    text, xref: "paper", yref: `y${row + 1} domain`, x: 0.5, y: 0.5, showarrow: false, font: { ...FONT, color: SOFT },
  });
  if (!series.ranges.length) missing(1, "no ranges were heard");
  if (!rows.b.some(known)) missing(2, "no estimate");
  return layout;
}

function drawPlots() {
  const div = document.getElementById("plots");
  if (!rows.t.length) {
    div.outerHTML = '<p class="empty">Nothing to plot: the record holds no status.</p>';
    return null;
  }
  const { traces, limit } = plotTraces();
  Plotly.newPlot(div, traces, plotLayout(limit, div.clientWidth < 620), CONFIG);
  div.on("plotly_hover", ({ xvals }) => setTime(xvals[0]));
  div.on("plotly_relayout", () => placeCursor());
  div.on("plotly_doubleclick", () => { zoomTo(flightWindow()); return false; });
  const line = document.createElement("div");
  line.id = "cursor";
  div.append(line);
  return div;
}

const zoomTo = (window_) => Plotly.relayout(plots, { "xaxis.range": window_ });

// -------------------------------------------------------------------------------------------------- cursor

let cursor = null, due = false;

/** The last row at or before this time. */
function rowAt(t) {
  let low = 0, high = rows.t.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (rows.t[middle] <= t) low = middle; else high = middle - 1;
  }
  return low;
}

/** A line's value at this time, by its last point before; null in a gap. */
function valueAt([t, v], at) {
  let low = -1, high = t.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (t[middle] <= at) low = middle; else high = middle - 1;
  }
  return low >= 0 && at - t[low] < 1 ? v[low] : null;
}

function setTime(t) {
  cursor = t;
  if (due) return;
  due = true;
  requestAnimationFrame(() => { due = false; placeCursor(); showNow(); moveOnMap(); });
}

function placeCursor() {
  const line = document.getElementById("cursor");
  if (!line || cursor === null) return;
  const { xaxis, _size: size } = plots._fullLayout, x = xaxis.l2p(cursor);
  line.style.display = x >= 0 && x <= xaxis._length ? "block" : "none";
  line.style.left = `${size.l + x}px`;
  line.style.top = `${size.t}px`;
  line.style.height = `${size.h}px`;
}

function showNow() {
  const i = rowAt(cursor), round = (v, digits) => v.toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");
  const n = (v, digits, unit) => known(v) ? `${round(v, digits)} ${unit}` : "–";
  const off = (v, s, digits, unit) => known(v) ? `${round(v, digits)} ± ${round(s, digits)} ${unit}` : "–";
  const of = (asked, flown, digits, unit) => `${n(valueAt(asked, cursor), digits, "")}/ ${n(valueAt(flown, cursor), digits, unit)}`;
  const values = {
    time: n(cursor, 2, "s"), phase: rows.phase[i], range: n(rows.range[i], 2, "m"),
    "distance ± σ": off(rows.d[i], rows.sd[i], 2, "m"), "bearing ± σ": off(rows.b[i], rows.sb[i], 0, "°"),
    "speed, asked / flown": of(series.speed_asked, series.speed_flown, 2, "m/s"),
    "yaw rate": of(series.yaw_asked, series.yaw_flown, 0, "°/s"),
    height: of(series.height_asked, series.height_flown, 2, "m"),
    East: n(rows.x[i], 2, "m"), North: n(rows.y[i], 2, "m"),
  };
  document.getElementById("now").replaceChildren(...Object.entries(values).map(([name, value]) => {
    const cell = document.createElement("div"), dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value;
    cell.append(dt, dd);
    return cell;
  }));
}

function moveOnMap() {
  if (!map) return;
  const i = rowAt(cursor), [x, y] = [rows.x[i], rows.y[i]], there = known(x, y), sure = hasEstimate(i);
  const [rx, ry] = sure ? region(i) : [[], []], [tx, ty] = sure ? target(i) : [null, null];
  Plotly.restyle(map, {
    x: [rx, sure ? [x, tx] : [], there ? [x] : []], y: [ry, sure ? [y, ty] : [], there ? [y] : []],
    "marker.angle": 90 - (rows.heading[i] ?? 90),
  }, moving);
}

// --------------------------------------------------------------------------------------------------- begin

const map = drawMap();
const plots = drawPlots();
if (plots) {
  document.getElementById("zoom-flight").onclick = () => zoomTo(flightWindow());
  document.getElementById("zoom-all").onclick = () => zoomTo(wholeWindow());
  for (const line of document.querySelectorAll("tr[data-t]")) line.onclick = () => setTime(Number(line.dataset.t));
  const last = rows.phase.findLastIndex((phase) => steering.includes(phase) && phase !== "hand over");
  setTime(rows.t[last < 0 ? rows.t.length - 1 : last]);
}
document.documentElement.dataset.drawn = "yes";
