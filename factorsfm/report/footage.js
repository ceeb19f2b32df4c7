// ---- the footage: thumbnails, tracks and residuals, depths ------------------------------------------------

const TAIL = 12; // frames
const pictures = data.thumbnail.map(text => {
  if (!text) return null;
  const picture = new Image();
  picture.addEventListener("load", drawFootageLater);
  return {picture, text};
});
const withPicture = nearestTo(pictures.map(Boolean));
const withPrior = nearestTo(data.frame.map((_, k) => hasTracks && tracks.prior.subarray(tracks.start[k], tracks.start[k + 1]).some(p => p !== NONE)));

// For each place the nearest one with a mark, -1 where nothing has one.
function nearestTo(marked) {
  const marks = marked.map((mark, k) => mark ? k : -1).filter(k => k >= 0);
  return marked.map((_, k) => marks.reduce((best, mark) => best < 0 || Math.abs(mark - k) < Math.abs(best - k) ? mark : best, -1));
}

// The picture of a frame, or of the nearest one that has been kept; decoded when it is first wanted.
function pictureOf(position) {
  const kept = pictures[withPicture[position]];
  if (!kept) return null;
  if (!kept.picture.src) kept.picture.src = "data:image/jpeg;base64," + kept.text;
  return kept.picture.complete && kept.picture.naturalWidth ? kept.picture : null;
}

function drawPicture({context, width, height}, position, opacity) {
  const picture = pictureOf(position);
  if (!picture) return;
  context.globalAlpha = opacity * (withPicture[position] === position ? 1 : 0.6);
  context.drawImage(picture, 0, 0, width, height);
  context.globalAlpha = 1;
}

const errorOf = o => tracks.residual[2 * o] === NONE ? null : Math.hypot(tracks.residual[2 * o], tracks.residual[2 * o + 1]) / data.tracks.residual_steps;
const sortedErrors = hasTracks ? Float32Array.from(tracks.point.keys(), o => errorOf(o) ?? 0).sort() : [];
const worstError = Math.max(2 * quantile(sortedErrors, 0.9), 0.05);
// Typical residuals are to appear about 1 % of the width long.
const magnified = hasTracks ? clamp(roundLength(0.01 * data.width / Math.max(quantile(sortedErrors, 0.5), 1e-3)), 1, 200) : 1;

// The way of the tracks of a frame through those before it.
function drawTails({context, width, height, ratio}, position, start, track, place, color) {
  const x = o => place[2 * o] / 65535 * width, y = o => place[2 * o + 1] / 65535 * height;
  const before = new Map(), shown = new Set(track.subarray(start[position], start[position + 1]));
  context.beginPath();
  for (let k = Math.max(0, position - TAIL); k <= position; k++) {
    for (let o = start[k]; o < start[k + 1]; o++) {
      const from = before.get(track[o]);
      if (shown.has(track[o]) && from !== undefined) { context.moveTo(x(from), y(from)); context.lineTo(x(o), y(o)); }
      before.set(track[o], o);
    }
  }
  context.strokeStyle = color;
  context.lineWidth = ratio;
  context.stroke();
}

function drawMoving(prepared, position) {
  const {context, width, height, ratio} = prepared, side = 4 * ratio;
  drawTails(prepared, position, moving.start, moving.track, moving.place, css("--moving"));
  context.fillStyle = css("--moving");
  for (let o = moving.start[position]; o < moving.start[position + 1]; o++)
    context.fillRect(moving.place[2 * o] / 65535 * width - side / 2, moving.place[2 * o + 1] / 65535 * height - side / 2, side, side);
}

function drawFootage() {
  const prepared = prepare(byId("footage"));
  if (!prepared) return;
  const position = seek.position;
  drawPicture(prepared, position, 1);
  if (moving && byId("show_moving").checked) drawMoving(prepared, position);
  if (hasTracks) drawTracks(prepared, position);
  drawPicks(prepared, position);
}

function drawTracks(prepared, position) {
  const {context, width, height, ratio} = prepared;
  const x = o => tracks.place[2 * o] / 65535 * width, y = o => tracks.place[2 * o + 1] / 65535 * height;
  if (byId("show_tracks").checked) drawTails(prepared, position, tracks.start, tracks.point, tracks.place, "#ffffffb0");
  const pixel = magnified * width / data.width / data.tracks.residual_steps, side = 3 * ratio;
  for (let o = tracks.start[position]; o < tracks.start[position + 1]; o++) {
    const error = errorOf(o);
    context.fillStyle = context.strokeStyle = error === null ? "#999" : rgb(onRamp(errorRamp, error / worstError));
    if (byId("show_tracks").checked) context.fillRect(x(o) - side / 2, y(o) - side / 2, side, side);
    if (error === null || !byId("show_residuals").checked) continue;
    context.lineWidth = 1.4 * ratio;
    context.beginPath();
    context.moveTo(x(o), y(o));
    context.lineTo(x(o) + pixel * tracks.residual[2 * o], y(o) + pixel * tracks.residual[2 * o + 1]);
    context.stroke();
  }
  drawPointed(prepared, position);
}

// ---- depth -----------------------------------------------------------------------------------------------

// Solved depth and that of the prior at each observation of a frame; the prior's null where it has none.
function depthsOf(position) {
  const row = cameraOf.get(position), found = [];
  for (let o = tracks.start[position]; o < tracks.start[position + 1]; o++) {
    const i = tracks.point[o];
    let z = 0;
    for (let axis = 0; axis < 3; axis++) z += rotations[9 * row + 3 * axis + 2] * (points[3 * i + axis] - centers[3 * row + axis]);
    const rest = tracks.prior[o] === NONE ? 0 : 1 - tracks.prior[o] / data.tracks.prior_steps;
    found.push({u: tracks.place[2 * o] / 65535, v: tracks.place[2 * o + 1] / 65535, z, prior: rest > 0 ? z / rest : null});
  }
  return found.sort((a, b) => b.z - a.z);
}

function drawDepths() {
  const position = withPrior[seek.position];
  if (position < 0) return;
  const depths = depthsOf(position), both = depths.filter(d => d.prior !== null);
  for (const [id, key, shown] of [["solved_depth", "z", depths], ["prior_depth", "prior", both]]) {
    const prepared = prepare(byId(id));
    if (!prepared) continue;
    const {context, width, height} = prepared, radius = width / 110;
    drawPicture(prepared, position, 0.35);
    for (const d of shown) {
      context.fillStyle = rgb(depthColor(d[key]));
      context.beginPath();
      context.arc(d.u * width, d.v * height, radius, 0, 7);
      context.fill();
    }
  }
  drawScatter(both);
  const off = both.map(d => Math.abs(Math.log(d.prior / d.z))).sort((a, b) => a - b);
  byId("depth_hint").textContent = `Frame ${data.frame[position]}${position === seek.position ? "" : ", the nearest one with a depth prior"}: ` +
    `the prior is off by ${(100 * Math.expm1(quantile(off, 0.5))).toFixed(1)} % at half of the ${both.length} points. Near is yellow, far is blue; on the diagonal both agree.`;
}

function drawScatter(both) {
  const prepared = prepare(byId("depth_scatter"));
  if (!prepared) return;
  const {context, width, height, ratio} = prepared;
  const low = Math.log(nearest / 1.5), high = Math.log(farthest * 1.5), left = 46 * ratio, below = 24 * ratio, top = 8 * ratio, right = 12 * ratio;
  const x = z => left + (width - left - right) * (Math.log(z) - low) / (high - low);
  const y = z => height - below - (height - below - top) * (Math.log(z) - low) / (high - low);
  context.font = `${11 * ratio}px system-ui, sans-serif`;
  context.strokeStyle = css("--line");
  context.fillStyle = css("--quiet");
  context.lineWidth = ratio;
  const decades = [], several = farthest / nearest > 30 ? [1] : [1, 2, 5];
  for (let power = Math.floor(low / Math.LN10); power <= high / Math.LN10; power++) for (const f of several) decades.push(f * 10 ** power);
  for (const z of decades.filter(z => Math.log(z) > low && Math.log(z) < high)) {
    context.beginPath();
    context.moveTo(x(z), top); context.lineTo(x(z), height - below);
    context.moveTo(left, y(z)); context.lineTo(width - right, y(z));
    context.stroke();
    context.textAlign = "center";
    context.fillText(format(z), x(z), height - 8 * ratio);
    context.textAlign = "right";
    context.fillText(format(z), left - 6 * ratio, y(z) + 4 * ratio);
  }
  context.save();
  context.beginPath();
  context.rect(left, top, width - left - right, height - below - top);
  context.clip();
  for (const d of both) {
    context.fillStyle = rgb(depthColor(d.z));
    context.fillRect(x(d.z) - ratio, y(d.prior) - ratio, 2 * ratio, 2 * ratio);
  }
  context.strokeStyle = css("--ink");
  context.beginPath();
  context.moveTo(x(Math.exp(low)), y(Math.exp(low))); context.lineTo(x(Math.exp(high)), y(Math.exp(high)));
  context.stroke();
  context.restore();
}

// ---- the strip of thumbnails -----------------------------------------------------------------------------

function drawStrip() {
  const prepared = prepare(byId("strip"));
  if (!prepared) return;
  const {context, width, height, ratio} = prepared, bar = 6 * ratio, tall = height - bar;
  const first = hasThumbnails ? pictureOf(0) : null;
  if (first) {
    const wide = tall * first.naturalWidth / first.naturalHeight, number = Math.max(1, Math.round(width / wide));
    for (let n = 0; n < number; n++) {
      const picture = pictureOf(Math.min(frameCount - 1, Math.floor((n + 0.5) / number * frameCount)));
      if (picture) context.drawImage(picture, n * width / number, 0, width / number, tall);
    }
  }
  const step = width / frameCount;
  for (let k = 0; k < frameCount; k++) {
    context.fillStyle = css(data.registered[k] ? "--accent" : "--path");
    context.globalAlpha = data.registered[k] && !data.keyframe[k] ? 0.45 : 1;
    context.fillRect(k * step, tall, Math.max(step, 1), bar);
  }
  context.globalAlpha = 1;
  context.fillStyle = css("--moving");
  for (const [first, last] of moving ? data.moving.stretches : []) {
    const begin = data.frame.indexOf(first), end = data.frame.indexOf(last);
    context.fillRect(begin * step, tall - bar / 2, (end + 1 - begin) * step, bar / 2);
  }
  for (const [color, wide] of [["#000", 4], ["#fff", 2]]) {
    context.fillStyle = color;
    context.fillRect((seek.position + 0.5) * step - wide * ratio / 2, 0, wide * ratio, height);
  }
}

const drawFootageAll = () => { drawFootage(); drawPointedAlone(); drawDepths(); drawStrip(); };
const drawFootageCoalesced = coalesced(drawFootageAll);
function drawFootageLater() { drawFootageCoalesced(); }

function startFootage() {
  const aspect = data.width ? `${data.width} / ${data.height}` : "16 / 9";
  for (const id of ["footage", "pointed", "solved_depth", "prior_depth", "depth_scatter"]) byId(id).style.aspectRatio = aspect;
  byId("residuals_label").textContent = `residuals, ${magnified} times longer`;
  for (const id of ["show_tracks", "show_residuals", "show_moving"]) byId(id).addEventListener("change", drawFootageLater);
  const strip = byId("strip");
  if (!hasThumbnails) strip.style.height = "14px";
  const seekTo = event => { if (event.buttons) goTo(Math.floor(event.offsetX / strip.clientWidth * frameCount)); };
  for (const name of ["pointerdown", "pointermove"]) strip.addEventListener(name, seekTo);
  seek.followers.push(drawFootageLater);
}
