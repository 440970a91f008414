// The map: trails, vehicles, where each takes its target to be; moved by dragging, zoomed by the wheel.

import { phaseColour, sharp, step } from "./plots.js";

const INK = "#1f2933", SOFT = "#5b6875", RULE = "#e6eaee", TARGET = "#b36b00", JUMP_M = 4;

/** East and North of the target as a row has it, off by so many metres and degrees; null where not known. */
export function targetOf(rows, i, metres = 0, degrees = 0) {
  const { x, y, heading, d, b } = rows;
  if (i < 0 || [heading[i], d[i], b[i]].some((v) => v === null)) return null;
  const azimuth = heading[i] - ((b[i] + degrees) * Math.PI) / 180, away = Math.max(d[i] + metres, 0);
  return [(x[i] ?? 0) + away * Math.cos(azimuth), (y[i] ?? 0) + away * Math.sin(azimuth)];
}

/** The 2σ region in distance and bearing, bent as it is on the map. */
function region(rows, i) {
  const points = [], deep = 2 * rows.sd[i], wide = Math.min(2 * rows.sb[i], 180);
  for (let k = 0; k <= 90; k++) {
    const phi = (2 * Math.PI * k) / 90;
    points.push(targetOf(rows, i, deep * Math.cos(phi), wide * Math.sin(phi)));
  }
  return points;
}

export class FlightMap {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.view = null; // {x, y, scale}: the middle in metres, pixels a metre; null: fitted
    let held = null;
    canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", () => { held = null; });
    canvas.addEventListener("pointercancel", () => { held = null; });
    canvas.addEventListener("pointermove", (e) => {
      if (!held || !this.shown) return;
      this.view = { ...this.shown, x: this.shown.x - (e.clientX - held[0]) / this.shown.scale, y: this.shown.y + (e.clientY - held[1]) / this.shown.scale };
      held = [e.clientX, e.clientY];
      changed();
    });
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      if (!this.shown) return;
      const factor = Math.exp(-e.deltaY * 0.0015), box = canvas.getBoundingClientRect();
      const px = e.clientX - box.left - box.width / 2, py = e.clientY - box.top - box.height / 2;
      const scale = Math.min(Math.max(this.shown.scale * factor, 0.02), 5000), { x, y, scale: old } = this.shown;
      this.view = { x: x + px / old - px / scale, y: y - py / old + py / scale, scale };
      changed();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { this.fit(); changed(); });
  }

  fit() { this.view = null; }

  /** Draw these vehicles; `cursor`: a row of the first that is marked, or −1. */
  draw(vehicles, cursor) {
    const { g, w, h } = sharp(this.canvas);
    const view = (this.shown = this.view ?? fitted(vehicles, w, h));
    const at = (x, y) => [w / 2 + (x - view.x) * view.scale, h / 2 - (y - view.y) * view.scale];
    grid(g, view, w, h, at);
    for (const vehicle of vehicles) trail(g, vehicle.rows, at);
    for (const vehicle of vehicles) {
      const i = vehicle === vehicles[0] && cursor >= 0 ? cursor : vehicle.rows.t.length - 1;
      if (i < 0) continue;
      target(g, vehicle, i, view, at);
      arrow(g, vehicle, i, at, vehicles.length > 1);
    }
    scaleBar(g, view, w, h);
  }
}

/** A view that holds every trail and target, with some room around. */
function fitted(vehicles, w, h) {
  let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  const hold = (p) => { if (p) for (const k of [0, 1]) { low[k] = Math.min(low[k], p[k]); high[k] = Math.max(high[k], p[k]); } };
  for (const { rows, radius } of vehicles) {
    for (let i = 0; i < rows.t.length; i++) if (rows.x[i] !== null) hold([rows.x[i], rows.y[i]]);
    const last = rows.t.length - 1, aim = targetOf(rows, last);
    if (last >= 0 && rows.x[last] === null) hold([0, 0]);
    if (aim) for (const s of [-1, 1]) hold([aim[0] + s * radius * 1.5, aim[1] + s * radius * 1.5]);
  }
  if (!Number.isFinite(low[0])) return { x: 0, y: 0, scale: Math.min(w, h) / 20 };
  const wide = Math.max(high[0] - low[0], 4), tall = Math.max(high[1] - low[1], 4);
  return { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale: 0.82 * Math.min(w / wide, h / tall) };
}

function grid(g, view, w, h, at) {
  const gap = step(Math.min(w, h) / view.scale, 6), [east, north] = [w / 2 / view.scale, h / 2 / view.scale];
  g.lineWidth = 1;
  g.fillStyle = SOFT;
  const name = (v) => String(Math.round(v * 1e6) / 1e6).replace("-", "−");
  g.textBaseline = "top";
  g.textAlign = "center";
  for (let v = Math.ceil((view.x - east) / gap) * gap; v <= view.x + east; v += gap) {
    const [px] = at(v, 0);
    stroke(g, RULE, [[px, 0], [px, h]]);
    if (px > 30 && px < w - 30) g.fillText(name(v), px, 3);
  }
  g.textAlign = "left";
  g.textBaseline = "middle";
  for (let v = Math.ceil((view.y - north) / gap) * gap; v <= view.y + north; v += gap) {
    const [, py] = at(0, v);
    stroke(g, RULE, [[0, py], [w, py]]);
    if (py > 24 && py < h - 34) g.fillText(name(v), 3, py);
  }
}

function trail(g, rows, at) {
  g.lineWidth = 2.2;
  g.lineJoin = "round";
  let points = [], phase = null;
  const flush = () => { if (points.length > 1) stroke(g, phaseColour(phase), points); };
  for (let i = 0; i < rows.t.length; i++) {
    const jumped = i > 0 && rows.x[i - 1] !== null && Math.hypot(rows.x[i] - rows.x[i - 1], rows.y[i] - rows.y[i - 1]) > JUMP_M;
    if (rows.x[i] === null || jumped) { flush(); points = []; }
    if (rows.x[i] === null) continue;
    const p = at(rows.x[i], rows.y[i]);
    if (rows.phase[i] !== phase) { flush(); points = points.slice(-1); phase = rows.phase[i]; }
    points.push(p);
  }
  flush();
}

function target(g, vehicle, i, view, at) {
  const { rows, radius } = vehicle, aim = targetOf(rows, i);
  if (!aim) return;
  g.lineWidth = 1.3;
  g.beginPath();
  region(rows, i).forEach((p, k) => g[k ? "lineTo" : "moveTo"](...at(...p)));
  g.closePath();
  g.fillStyle = "rgba(179,107,0,0.13)";
  g.fill();
  g.strokeStyle = "rgba(179,107,0,0.55)";
  g.stroke();
  const [x, y] = at(...aim);
  g.strokeStyle = TARGET;
  g.setLineDash([5, 4]);
  g.beginPath();
  g.arc(x, y, radius * view.scale, 0, 2 * Math.PI);
  g.stroke();
  g.setLineDash([]);
  g.lineWidth = 2;
  stroke(g, TARGET, [[x - 5, y], [x + 5, y]]);
  stroke(g, TARGET, [[x, y - 5], [x, y + 5]]);
  g.fillStyle = TARGET;
  g.textAlign = "center";
  g.textBaseline = "bottom";
  g.fillText(vehicle.target, x, y - Math.max(radius * view.scale, 6) - 3);
}

function arrow(g, vehicle, i, at, named) {
  const { rows } = vehicle, [x, y] = at(rows.x[i] ?? 0, rows.y[i] ?? 0), heading = rows.heading[i];
  g.save();
  g.translate(x, y);
  g.fillStyle = vehicle.live ? phaseColour(rows.phase[i]) : "#8d97a1";
  g.strokeStyle = "#fff";
  g.lineWidth = 1.5;
  g.beginPath();
  if (heading === null) g.arc(0, 0, 6, 0, 2 * Math.PI);
  else {
    g.rotate(-heading);
    g.moveTo(12, 0);
    g.lineTo(-8, 7.5);
    g.lineTo(-4.5, 0);
    g.lineTo(-8, -7.5);
    g.closePath();
  }
  g.fill();
  g.stroke();
  g.restore();
  if (!named) return;
  g.fillStyle = INK;
  g.textAlign = "left";
  g.textBaseline = "top";
  g.fillText(vehicle.uav, x + 12, y + 6);
}

function scaleBar(g, view, w, h) {
  const metres = step(w / view.scale, 5), long = metres * view.scale;
  g.lineWidth = 2;
  stroke(g, INK, [[14, h - 18], [14, h - 13], [14 + long, h - 13], [14 + long, h - 18]]);
  g.fillStyle = INK;
  g.textAlign = "left";
  g.textBaseline = "bottom";
  g.fillText(`${metres} m`, 20, h - 16);
  g.textAlign = "center";
  g.textBaseline = "alphabetic";
  g.fillText("N", w - 18, h - 36);
  g.lineWidth = 1.6;
  stroke(g, INK, [[w - 18, h - 12], [w - 18, h - 32]]);
  stroke(g, INK, [[w - 22, h - 27], [w - 18, h - 32], [w - 14, h - 27]]);
}

function stroke(g, colour, points) {
  g.strokeStyle = colour;
  g.beginPath();
  points.forEach((p, k) => g[k ? "lineTo" : "moveTo"](...p));
  g.stroke();
}
