// The page of `companion watch --web`: takes the stream of events, shows the vehicles, one of them in full.

import { FlightMap } from "./map.js";
import { drawPlots, nearest, phaseColour, PHASES } from "./plots.js";

const KEPT = 3000; // rows of each vehicle, as many as the server keeps
const KEYS = ["t", "phase", "x", "y", "height", "heading", "range", "d", "sd", "b", "sb", "v", "w"];
const $ = (id) => document.getElementById(id);
const deg = (rad) => (rad * 180) / Math.PI;

const vehicles = new Map(); // uav → {uav, rows, now, target, radius, live}
let chosen = null, span = 60, hover = null, scale = null, drawn = 0, dirty = true;
const map = new FlightMap($("map"), () => { dirty = true; });

// -------------------------------------------------------------------------------------------------- what comes

const stream = new EventSource("events");
stream.onmessage = (event) => {
  const feed = JSON.parse(event.data);
  tell(feed.missing || (feed.turned_away ? `${feed.turned_away} messages of other ids are not shown` : ""), false);
  for (const now of feed.now) {
    const vehicle = entry(now.uav);
    vehicle.now = now;
    vehicle.live = now.link === "live";
    vehicle.target = now.message?.target ?? "";
    vehicle.radius = now.message?.radius_m ?? 0;
  }
  for (const uav of [...vehicles.keys()]) if (!feed.now.some((now) => now.uav === uav)) vehicles.delete(uav);
  for (const story of feed.stories) take(entry(story.uav), story);
  if (!vehicles.has(chosen)) chosen = vehicles.keys().next().value ?? null;
  list();
  facts();
  dirty = true;
};
stream.onerror = () => tell("companion watch does not answer; trying again …", true);

function entry(uav) {
  if (!vehicles.has(uav)) {
    vehicles.set(uav, { uav, rows: empty(), now: null, target: "", radius: 0, live: false });
  }
  return vehicles.get(uav);
}

const empty = () => Object.fromEntries(KEYS.map((key) => [key, []]));

function take(vehicle, story) {
  if (story.afresh) vehicle.rows = empty();
  for (const row of story.rows) KEYS.forEach((key, k) => vehicle.rows[key].push(row[k]));
  const surplus = vehicle.rows.t.length - KEPT;
  if (surplus > 0) for (const key of KEYS) vehicle.rows[key].splice(0, surplus);
}

function tell(text, lost) {
  $("missing").textContent = text;
  $("missing").classList.toggle("lost", lost);
}

// -------------------------------------------------------------------------------------------------- what is shown

function list() {
  const known = [...vehicles.keys()].sort(), items = [...$("vehicles").children];
  if (items.map((item) => item.dataset.uav).join(" ") !== known.join(" ")) {
    $("vehicles").replaceChildren(...known.map(item));
  }
  for (const li of $("vehicles").children) {
    const vehicle = vehicles.get(li.dataset.uav), { now } = vehicle, status = now?.message?.status, e = status?.estimate;
    const [name, pill, link, aim] = li.firstChild.children;
    li.firstChild.setAttribute("aria-pressed", String(vehicle.uav === chosen));
    name.textContent = vehicle.uav;
    pill.textContent = status?.phase ?? "";
    pill.style.background = vehicle.live && status ? phaseColour(status.phase) : "#8d97a1";
    link.textContent = now?.link === "live" ? "live" : `${now?.link}, ${age(now?.age_s)}`;
    link.className = `link ${now?.link}`;
    aim.textContent = e ? `${e.distance_m.toFixed(1)} m, ${side(e.bearing_rad)}` : "";
  }
}

function item(uav) {
  const li = document.createElement("li"), button = document.createElement("button");
  li.dataset.uav = uav;
  for (const [tag, kind] of [["b", ""], ["span", "pill"], ["span", "link"], ["span", "aim"]]) {
    const part = document.createElement(tag);
    part.className = kind;
    button.append(part);
  }
  button.addEventListener("click", () => { chosen = uav; map.fit(); list(); facts(); dirty = true; });
  li.append(button);
  return li;
}

const age = (s) => (s === null || s === undefined ? "never heard" : s < 1 ? `${(s * 1000).toFixed(0)} ms ago` : `${s.toFixed(1)} s ago`);
const side = (rad) => `${Math.abs(deg(rad)).toFixed(0)}° ${rad >= 0 ? "right" : "left"}`;
const metres = (m, digits = 2) => (m === null ? "–" : `${m.toFixed(digits)} m`);
const counts = (all) => Object.entries(all).filter(([, n]) => n).map(([why, n]) => `${why} ${n}`).join(", ");

/** The chosen vehicle in words. */
function facts() {
  const vehicle = vehicles.get(chosen), now = vehicle?.now, s = now?.message?.status;
  $("now").hidden = !vehicle;
  if (!vehicle) return;
  $("name").textContent = vehicle.uav;
  $("reason").textContent = s ? `${s.phase}: ${s.reason}` : "nothing readable heard yet";
  const lines = [...(s?.awaited ?? []).map((what) => `awaiting ${what}`), ...(s?.warnings ?? [])];
  $("awaited").replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), { textContent: line })));
  const rows = [];
  if (s) {
    const e = s.estimate, old = (limit, value) => (value === null || value > limit ? "bad" : "");
    rows.push(["mode", `${s.mode ?? "–"}${s.armed === null ? "" : s.armed ? ", armed" : ", disarmed"}`]);
    if (e) {
      rows.push(["distance", `${e.distance_m.toFixed(2)} ± ${e.distance_sigma_m.toFixed(2)} m`]);
      rows.push(["bearing", `${side(e.bearing_rad)} ± ${deg(e.bearing_sigma_rad).toFixed(0)}°`]);
    }
    rows.push(["range", `${metres(s.range_m)}, ${age(s.range_age_s)}`, old(1, s.range_age_s)]);
    rows.push(["telemetry", age(s.telemetry_age_s), old(1, s.telemetry_age_s)]);
    rows.push(["speed", s.speed_m_s === null ? "nothing is sent" : `${s.speed_m_s.toFixed(2)} m/s`]);
    rows.push(["height", metres(s.height_m)]);
    rows.push(["flown", `${s.path_m.toFixed(1)} m in ${s.engaged_s.toFixed(0)} s`]);
    rows.push(["captured", s.captured ? "yes" : "no"]);
    rows.push(["ranges believed", String(s.ranges_accepted)]);
    if (counts(s.rejected)) rows.push(["refused", counts(s.rejected)]);
    if (counts(s.malformed)) rows.push(["unreadable", counts(s.malformed), "bad"]);
    for (const [id, heard] of Object.entries(s.beacons)) rows.push([`beacon ${id}`, age(heard), old(1, heard)]);
  }
  if (now.lost) rows.push(["messages lost", String(now.lost)]);
  for (const problem of now.problems) rows.push(["problem", problem, "bad"]);
  $("facts").replaceChildren(...rows.map(([name, text, kind]) => {
    const row = document.createElement("div");
    row.append(Object.assign(document.createElement("dt"), { textContent: name }));
    row.append(Object.assign(document.createElement("dd"), { textContent: text, className: kind ?? "" }));
    return row;
  }));
}

/** Once a frame at most, and only where something has changed. */
function paint() {
  requestAnimationFrame(paint);
  if (!dirty) return;
  dirty = false;
  drawn += 1;
  const vehicle = vehicles.get(chosen), rows = vehicle?.rows ?? empty();
  const end = rows.t.length ? Math.max(rows.t[rows.t.length - 1], span) : span;
  scale = drawPlots($("plots"), rows, span, end, hover);
  const everybody = $("everybody").getAttribute("aria-pressed") === "true";
  const others = everybody ? [...vehicles.values()].filter((v) => v !== vehicle) : [];
  map.draw(vehicle ? [vehicle, ...others] : others, hover === null ? -1 : nearest(rows, hover));
  const last = rows.t.length - 1;
  $("where").textContent = last >= 0 && rows.x[last] === null ? "no position told: metres from the vehicle" : "metres East, North";
  legend(rows);
}

/** The phases that are in the plots, with their colours. */
function legend(rows) {
  const seen = Object.keys(PHASES).filter((phase) => rows.phase.includes(phase));
  if ([...$("legend").children].map((li) => li.textContent).join() === seen.join()) return;
  $("legend").replaceChildren(...seen.map((phase) => {
    const li = document.createElement("li"), patch = document.createElement("i");
    patch.style.background = phaseColour(phase);
    li.append(patch, phase);
    return li;
  }));
}

// -------------------------------------------------------------------------------------------------- what is done

$("plots").addEventListener("pointermove", (e) => {
  hover = scale ? scale.time(e.clientX - $("plots").getBoundingClientRect().left) : null;
  dirty = true;
});
$("plots").addEventListener("pointerleave", () => { hover = null; dirty = true; });
$("fit").addEventListener("click", () => { map.fit(); dirty = true; });
$("everybody").addEventListener("click", (e) => {
  const now = e.currentTarget.getAttribute("aria-pressed") !== "true";
  e.currentTarget.setAttribute("aria-pressed", String(now));
  map.fit();
  dirty = true;
});
for (const button of $("spans").children) {
  button.addEventListener("click", () => {
    span = Number(button.dataset.span);
    for (const other of $("spans").children) other.setAttribute("aria-pressed", String(other === button));
    dirty = true;
  });
}
new ResizeObserver(() => { dirty = true; }).observe(document.body);
paint();

/** For tests: what is held and how often it was drawn. */
window.watching = () => ({ vehicles: [...vehicles.keys()], chosen, rows: vehicles.get(chosen)?.rows.t.length ?? 0, drawn, hover, view: map.shown });
