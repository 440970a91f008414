// The cursor: a moment that plots, map and the table of values show together; and the beginning of it all.

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
