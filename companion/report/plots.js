// The plots: one time axis for all, the phases as bands.

const told = series.answers.t.length + series.transports.t.length > 0;
const ROWS = [
  { key: "phase", share: 0.5, title: "" },
  { key: "range", share: 3, title: "distances, m" },
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
