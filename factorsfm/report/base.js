"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const byId = id => document.getElementById(id);
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const typed = (text, Type) => new Type(Uint8Array.from(atob(text || ""), c => c.charCodeAt(0)).buffer);
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
const quantile = (sorted, q) => sorted.length ? sorted[Math.round(q * (sorted.length - 1))] : 0;
const format = x => x === null ? "–" : x && Math.abs(x) < 1e-3 ? Number(x.toPrecision(3)).toExponential() : Number(x.toPrecision(4)).toString();
const roundLength = most => [5, 2, 1].map(f => f * 10 ** Math.floor(Math.log10(most))).find(l => l <= most * 1.0001);

// Selects an element and copies its text; whether the browser lets it.
function copied(element) {
  if (element.select) element.select();
  else getSelection().selectAllChildren(element);
  return document.execCommand("copy");
}

const frameCount = data.frame.length, last = Math.max(frameCount - 1, 1);
const solved = Boolean(data.positions && data.positions.length);
const hasTracks = solved && data.tracks.start[frameCount] > 0;
const alignable = hasTracks && data.survey !== "world";
const hasThumbnails = data.thumbnail.some(Boolean);

// The frame that is shown, and who follows it.
const seek = {position: 0, followers: []};
function goTo(position) {
  seek.position = clamp(position, 0, frameCount - 1);
  for (const follow of seek.followers) follow(seek.position);
}

// Fits the pixels of a canvas to its place on the screen; null where it has none.
function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (!width || !height) return null;
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, width, height);
  return {context, width, height, ratio};
}

// At most one drawing per refresh of the screen.
function coalesced(draw) {
  let pending = false;
  return () => {
    if (pending) return;
    pending = true;
    requestAnimationFrame(() => { pending = false; draw(); });
  };
}

// ---- commands that the page writes ------------------------------------------------------------------------

const onWindows = /^\/[A-Za-z]:\//.test(location.pathname);

// The folder in which the page lies.
function resultFolder() {
  if (location.protocol !== "file:") return "RESULT";
  const folder = decodeURIComponent(location.pathname).replace(/\/[^/]*$/, "");
  return onWindows ? folder.slice(1).replaceAll("/", "\\") : folder;
}

// A word of a command as the shell takes it.
function shellWord(word) {
  if (/^[\w@%+=:,./-]+$/.test(word)) return word;
  return onWindows ? `"${word}"` : `'${word.replaceAll("'", "'\\''")}'`;
}

// ---- points, cameras and tracks -------------------------------------------------------------------------

const points = typed(data.points, Float32Array), colors = typed(data.colors, Uint8Array);
const ground = data.ground ? typed(data.ground, Float32Array) : new Float32Array(); // ends of lines
const centers = typed(data.centers, Float32Array), rotations = typed(data.rotations, Float32Array);
const pointCount = points.length / 3, cameraCount = centers.length / 3;
const cameraOf = new Map((data.positions || []).map((position, row) => [position, row]));

const tracks = hasTracks ? {
  start: data.tracks.start,
  point: typed(data.tracks.point, Uint16Array),
  place: typed(data.tracks.place, Uint16Array),
  residual: typed(data.tracks.residual, Int16Array),
  prior: typed(data.tracks.prior, Int16Array),
} : null;
// What moves by itself, by frame as the tracks; null where nothing does.
const moving = data.moving ? {
  start: data.moving.start,
  track: typed(data.moving.track, Uint32Array),
  place: typed(data.moving.place, Uint16Array),
} : null;
const NONE = -32768;

const sortedDepths = points.filter((_, i) => i % 3 === 2).sort();
const nearest = Math.max(quantile(sortedDepths, 0.03), 1e-9), farthest = Math.max(quantile(sortedDepths, 0.97), nearest * 1.01);
const depthRamp = [[250, 205, 60], [240, 130, 70], [205, 75, 115], [125, 60, 165], [60, 90, 190]];
const errorRamp = [[60, 190, 150], [240, 205, 70], [235, 60, 50]];

function onRamp(ramp, share) {
  const at = clamp(share, 0, 1) * (ramp.length - 1), k = Math.min(Math.floor(at), ramp.length - 2);
  return ramp[k].map((c, i) => Math.round(c + (at - k) * (ramp[k + 1][i] - c)));
}
// By inverse depth, which is how depth shows in an image.
function depthColor(z) {
  return onRamp(depthRamp, (1 / nearest - 1 / Math.max(z, nearest)) / (1 / nearest - 1 / farthest));
}
const rgb = color => `rgb(${color[0]},${color[1]},${color[2]})`;
