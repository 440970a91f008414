// Strip charts over a common axis of time, on one canvas: lines with gaps, ±2σ bands, phases, a cursor.

export const PHASES = {
  await: "#aab4be", standby: "#6c8ebf", inhibited: "#c08a2b", acquire: "#7fb2e5", approach: "#1d5fa8", hold: "#2f8f5b",
  keep: "#2f8f5b", coast: "#e0a100", stall: "#d9622b", "hand over": "#b3261e", released: "#8f7aa8", ended: "#5b6875",
};
export const phaseColour = (phase) => PHASES[phase] ?? "#aab4be";

const INK = "#1f2933", SOFT = "#5b6875", RULE = "#e6eaee", ACCENT = "#1d5fa8", SECOND = "#b36b00", BAND = "rgba(29,95,168,0.16)";
const LEFT = 46, RIGHT = 8, STRIP = 14, AXIS = 20, GAP_S = 3;

/** What is drawn, from top to bottom. Values are of `rows` (see page.js); `span` gives the least range of the axis. */
const PLOTS = [
  { title: "range, distance · m", lines: [["range", ACCENT, "range"], ["d", SECOND, "distance"]], span: [0, 2], zero: true, share: 1.2 },
  { title: "bearing ±2σ · ° (right positive)", lines: [["b", ACCENT, "bearing"]], band: ["b", "sb"], span: [-20, 20], even: 180, share: 1.5 },
  { title: "commanded speed · m/s", lines: [["v", ACCENT, "speed"]], span: [0, 0.5], zero: true, share: 0.8 },
  { title: "commanded yaw rate · °/s (left positive)", lines: [["w", ACCENT, "yaw rate"]], span: [-20, 20], even: Infinity, share: 0.8 },
];

/** A round step that divides `range` into about `n` parts. */
export function step(range, n) {
  const raw = range / n, power = 10 ** Math.floor(Math.log10(raw));
  return power * ([1, 2, 5, 10].find((f) => f * power >= raw) ?? 10);
}

/** Canvas and its context in CSS pixels, as sharp as the screen. */
export function sharp(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, w, h);
  g.font = `12px ${getComputedStyle(document.body).fontFamily}`;
  return { g, w, h };
}

/** The least and largest of a plot's values between two rows. */
function extent(plot, rows, from, to) {
  let [low, high] = plot.span;
  for (let i = from; i < to; i++) {
    for (const [key] of plot.lines) {
      const value = rows[key][i];
      if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); }
    }
    if (plot.band && rows[plot.band[0]][i] !== null) {
      const reach = Math.abs(rows[plot.band[0]][i]) + 2 * rows[plot.band[1]][i];
      high = Math.max(high, Math.min(reach, plot.even));
    }
  }
  if (plot.even) {
    high = Math.min(Math.max(high, -low) * 1.08, plot.even);
    low = -high;
  } else {
    high += 0.06 * (high - low);
    if (!plot.zero) low -= 0.06 * (high - low);
  }
  return [low, high];
}

/** Draw the last `span` seconds, up to `end`. `cursor`: a time to mark, or null. Returns where time is on the canvas. */
export function drawPlots(canvas, rows, span, end, cursor) {
  const { g, w, h } = sharp(canvas);
  const start = end - span, x = (t) => LEFT + ((t - start) / span) * (w - LEFT - RIGHT);
  let from = 0;
  while (from < rows.t.length && rows.t[from] < start - GAP_S) from++;
  const to = rows.t.length;
  phases(g, rows, from, to, x, w);
  const shares = PLOTS.reduce((sum, plot) => sum + plot.share, 0), room = h - STRIP - AXIS;
  const at = cursor === null ? -1 : nearest(rows, cursor);
  let top = STRIP;
  for (const plot of PLOTS) {
    const height = (room * plot.share) / shares;
    onePlot(g, plot, rows, from, to, x, { top: top + 20, bottom: top + height - 4, left: LEFT, right: w - RIGHT }, at);
    top += height;
  }
  timeAxis(g, start, span, x, h);
  if (at >= 0) {
    g.strokeStyle = INK;
    g.globalAlpha = 0.5;
    line(g, x(rows.t[at]), STRIP, x(rows.t[at]), h - AXIS);
    g.globalAlpha = 1;
  }
  return { time: (px) => start + ((px - LEFT) / (w - LEFT - RIGHT)) * span };
}

/** The row nearest to a time, or −1. */
export function nearest(rows, t) {
  let best = -1;
  for (let i = 0; i < rows.t.length; i++) if (best < 0 || Math.abs(rows.t[i] - t) < Math.abs(rows.t[best] - t)) best = i;
  return best;
}

function phases(g, rows, from, to, x, w) {
  for (let i = from; i < to; ) {
    let k = i;
    while (k + 1 < to && rows.phase[k + 1] === rows.phase[i] && rows.t[k + 1] - rows.t[k] < GAP_S) k++;
    const a = Math.max(x(rows.t[i]), LEFT);
    const b = Math.min(x(k + 1 < to && rows.t[k + 1] - rows.t[k] < GAP_S ? rows.t[k + 1] : rows.t[k]), w - RIGHT);
    if (b > a) {
      g.fillStyle = phaseColour(rows.phase[i]);
      g.fillRect(a, 0, b - a, STRIP - 3);
    }
    i = k + 1;
  }
}

function onePlot(g, plot, rows, from, to, x, box, at) {
  const [low, high] = extent(plot, rows, from, to);
  const y = (v) => box.bottom - ((v - low) / (high - low)) * (box.bottom - box.top);
  g.textBaseline = "middle";
  g.textAlign = "right";
  g.lineWidth = 1;
  const gap = plot.even === 180 && high > 100 ? 90 : step(high - low, Math.max(2, (box.bottom - box.top) / 34));
  for (let v = Math.ceil(low / gap) * gap; v <= high + 1e-9; v += gap) {
    g.strokeStyle = Math.abs(v) < 1e-9 ? "#c3cbd3" : RULE;
    line(g, box.left, y(v), box.right, y(v));
    g.fillStyle = SOFT;
    g.fillText(String(Math.round(v * 1e6) / 1e6).replace("-", "−"), box.left - 6, y(v));
  }
  g.save();
  g.beginPath();
  g.rect(box.left, box.top - 1, box.right - box.left, box.bottom - box.top + 2);
  g.clip();
  if (plot.band) band(g, rows, plot.band, from, to, x, y);
  for (const [key, colour] of plot.lines) curve(g, rows, key, colour, from, to, x, y, plot.even === 180);
  g.restore();
  g.textAlign = "left";
  g.fillStyle = INK;
  g.fillText(plot.title, box.left, box.top - 10);
  values(g, plot, rows, at, to, box);
}

/** The values at the cursor, or now, at the right end of the title. */
function values(g, plot, rows, at, to, box) {
  const i = at >= 0 ? at : to - 1;
  if (i < 0) return;
  g.textAlign = "right";
  let right = box.right;
  for (const [key, colour, name] of [...plot.lines].reverse()) {
    const value = rows[key][i];
    let text = value === null ? "–" : value.toFixed(2).replace("-", "−");
    if (value !== null && plot.band) text = `${value.toFixed(0).replace("-", "−")} ± ${(2 * rows[plot.band[1]][i]).toFixed(0)}`;
    if (plot.lines.length > 1) text = `${name} ${text}`;
    g.fillStyle = colour;
    g.fillText(text, right, box.top - 10);
    right -= g.measureText(text).width + 14;
  }
}

function curve(g, rows, key, colour, from, to, x, y, wraps) {
  g.strokeStyle = colour;
  g.lineWidth = 1.6;
  g.lineJoin = "round";
  g.beginPath();
  let last = -1;
  for (let i = from; i < to; i++) {
    const value = rows[key][i];
    if (value === null) { last = -1; continue; }
    const joined = last >= 0 && rows.t[i] - rows.t[last] < GAP_S && !(wraps && Math.abs(value - rows[key][last]) > 180);
    if (joined) g.lineTo(x(rows.t[i]), y(value));
    else { g.moveTo(x(rows.t[i]), y(value)); g.lineTo(x(rows.t[i]) + 0.5, y(value)); }
    last = i;
  }
  g.stroke();
}

/** ±2σ as a filled band, one piece between each two rows; it goes on at the other end where it passes ±180°. */
function band(g, rows, [middle, sigma], from, to, x, y) {
  g.fillStyle = BAND;
  g.beginPath();
  for (let i = from; i + 1 < to; i++) {
    const a = rows[middle][i], s = rows[sigma][i];
    if (a === null || rows.t[i + 1] - rows.t[i] >= GAP_S) continue;
    const reach = Math.min(2 * s, 180), left = x(rows.t[i]), width = x(rows.t[i + 1]) - left;
    for (const turn of [-360, 0, 360]) {
      const low = Math.max(a - reach + turn, -180), high = Math.min(a + reach + turn, 180);
      if (high > low) g.rect(left, y(high), width, y(low) - y(high));
    }
  }
  g.fill();
}

function timeAxis(g, start, span, x, h) {
  const gap = span <= 60 ? 10 : span <= 300 ? 60 : 120;
  g.fillStyle = SOFT;
  g.textAlign = "center";
  g.textBaseline = "alphabetic";
  for (let t = Math.ceil(start / gap) * gap; t <= start + span; t += gap) {
    if (t < 0) continue;
    const text = t >= 60 ? `${Math.floor(t / 60)}:${String(t % 60).padStart(2, "0")}` : `${t} s`;
    g.fillText(text, Math.min(x(t), x(start + span) - 14), h - 5);
  }
}

function line(g, x0, y0, x1, y1) {
  g.beginPath();
  g.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
  g.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
  g.stroke();
}
