// The interactive part of a flight's report: map and plots by Plotly, one cursor in time for both. This file: what
// map.js, plots.js and cursor.js share; the page holds the four one after another.
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
