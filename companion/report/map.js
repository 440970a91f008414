// The map: the path, the shortest one, the target, and the estimate with its 2σ region over time.

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
