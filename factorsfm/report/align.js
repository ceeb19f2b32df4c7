// ---- picks in the picture and in the scene, and the command that aligns the result to them ------------------

const REACH = 0.08, FEWEST = 3; // as far around a pixel as `factorsfm align` looks for tracks, and how many it needs
const CLICK = 4, NEAR = 14; // screen pixels: a click moves less than the first, and takes a point within the second
const MAGNIFIED = 4; // by the loupe
const marks = {origin: "O", axis: "X", plane: "3", from: "A", to: "B"};
const aligning = {picks: {}, waiting: null, cross: null, controls: {}};
// A pick needs the camera of its frame, and the picture of this very frame where there are pictures at all.
const pickable = data.frame.map((_, k) => data.registered[k] && (!hasThumbnails || pictures[k] !== null));
const nextPickable = nearestTo(pickable);
const tracked = new Uint8Array(pointCount);
if (hasTracks) for (const point of tracks.point) tracked[point] = 1;

const chosen = name => document.querySelector(`input[name=${name}]:checked`).value;
const say = text => { byId("align_status").textContent = text; };

// ---- the command ----

// A frame by its number, or by its name where that says more.
const nameOf = position => data.name[position] === String(data.frame[position]).padStart(6, "0") ? data.frame[position] : data.name[position];

function pixelText({position, u, v}) {
  const [width, height] = data.sizes[position], pixel = share => Number(share.toFixed(1));
  return `${nameOf(position)}:${pixel(u * width - 0.5)},${pixel(v * height - 0.5)}`;
}

// What is still missing for a command; empty if nothing is.
function missing() {
  const {origin, axis, plane, from, to} = aligning.picks, scale = chosen("scale");
  if (chosen("ground") === "picked" && !(origin && axis && plane)) return "Pick three points of the ground: the origin, one along x, and a third one off their line.";
  if (axis && !origin) return "A point along x needs an origin.";
  if (scale === "distance" && !(from && to)) return "Pick both ends of the distance.";
  if (scale !== "kept" && !(Number(byId(scale === "distance" ? "metres" : "height").value) > 0)) return `Type the ${scale === "distance" ? "distance" : "height"} in metres.`;
  if (scale === "distance" && !byId("sigma").checkValidity()) return "The standard deviation is 0 metres or more.";
  return "";
}

function command() {
  const {origin, axis, plane, from, to} = aligning.picks, scale = chosen("scale"), words = ["factorsfm", "align", resultFolder()];
  if (origin) words.push("--origin", pixelText(origin));
  if (axis) words.push("--axis", pixelText(axis));
  if (chosen("ground") === "picked") words.push("--plane", pixelText(plane));
  const sigma = Number(byId("sigma").value);
  if (scale === "distance") words.push("--distance", pixelText(from), pixelText(to), byId("metres").value + (sigma > 0 ? `,${byId("sigma").value}` : ""));
  if (scale === "height") words.push("--camera-height", byId("height").value);
  if (data.footage) words.push("--footage", data.footage);
  return words.map(String).map(shellWord).join(" ");
}

function copyAlignment() {
  say(copied(byId("command")) ? "Copied." : "The command is selected: copy it.");
}

function showAlignment() {
  const lacking = missing(), scale = chosen("scale");
  byId("command").textContent = lacking ? "" : command();
  byId("command_row").hidden = Boolean(lacking);
  byId("distance_row").hidden = scale !== "distance";
  byId("height_row").hidden = scale !== "height";
  for (const [name, {box, button, place, drop}] of Object.entries(aligning.controls)) {
    const pick = aligning.picks[name];
    box.hidden = name === "plane" && chosen("ground") === "found";
    button.setAttribute("aria-pressed", aligning.waiting === name);
    place.textContent = pick ? pixelText(pick) : "";
    place.hidden = drop.hidden = !pick;
  }
  for (const id of ["scene", "footage"]) byId(id).classList.toggle("picking", aligning.waiting !== null);
  say(aligning.waiting ? `Click “${aligning.controls[aligning.waiting].title}” in the picture, or on a point of the scene; Escape leaves it.` : lacking);
  drawFootageLater();
  drawSceneLater();
}

// ---- picking ----

// Begins with a pick, or ends with null; the focus goes to the picture and comes back.
function wait(name) {
  const before = aligning.waiting;
  aligning.waiting = name;
  aligning.cross = null;
  if (name && !pickable[seek.position]) goTo(nextPickable[seek.position]);
  if (name && !before) byId("footage").focus();
  if (before && !name) aligning.controls[before].button.focus();
  showAlignment();
}

// The pick that follows another one by itself: of the three, and the other end of a distance.
function following(name) {
  const next = {origin: "axis", axis: "plane", from: "to"}[name];
  return next && !aligning.picks[next] && (name === "from" || chosen("ground") === "picked") ? next : null;
}

function place(pick) {
  const name = aligning.waiting, near = tracksNear(pick).length;
  aligning.picks[name] = {...pick, point: pick.point ?? behind(pick)};
  wait(following(name));
  if (near < FEWEST) say("Picked, but there are hardly any tracks around this pixel, so align may refuse it. Better pick where there is texture.");
}

function placeInPicture([u, v]) {
  const position = seek.position;
  if (pickable[position]) return place({position, u, v});
  goTo(nextPickable[position]);
  say(`Frame ${data.frame[position]} has no pose or no picture of its own; this is frame ${data.frame[seek.position]}. Click again.`);
}

// The observations around a pixel in its frame, the nearest first, with their distances.
function tracksNear({position, u, v}) {
  const [width, height] = data.sizes[position], most = REACH * Math.max(width, height), near = [];
  for (let o = tracks.start[position]; o < tracks.start[position + 1]; o++) {
    const away = Math.hypot((tracks.place[2 * o] / 65535 - u) * width, (tracks.place[2 * o + 1] / 65535 - v) * height);
    if (away < most) near.push([away, o]);
  }
  return near.sort((a, b) => a[0] - b[0]);
}

// About where the scene is behind a pixel, for its mark in 3-D; null where nothing tells.
function behind(pick) {
  const row = cameraOf.get(pick.position), near = tracksNear(pick).slice(0, 8);
  if (!near.length) return null;
  let sum = 0, inverse = 0;
  for (const [away, o] of near) {
    let z = 0;
    for (let axis = 0; axis < 3; axis++) z += rotations[9 * row + 3 * axis + 2] * (points[3 * tracks.point[o] + axis] - centers[3 * row + axis]);
    const weight = 1 / (1 + away * away);
    sum += weight;
    inverse += weight / z;
  }
  const ray = [(pick.u - 0.5) * data.width / data.focals[row], (pick.v - 0.5) * data.height / data.focals[row], 1];
  return [0, 1, 2].map(axis => centers[3 * row + axis] + sum / inverse * dot(rotations.subarray(9 * row + 3 * axis, 9 * row + 3 * axis + 3), ray));
}

// The tracked point at a place of the scene's canvas, the front one of several; -1 where there is none.
function pointAt(x, y) {
  const {clientWidth: width, clientHeight: height} = scene.canvas, from = viewer(width, height);
  let best = -1, least = [NEAR, Infinity];
  for (let i = 0; i < pointCount; i++) {
    if (!tracked[i]) continue;
    const d = [0, 1, 2].map(axis => points[3 * i + axis] - from.eye[axis]), w = dot(from.axes[2], d);
    if (w < from.near) continue;
    const away = Math.hypot(width / 2 + from.focal * dot(from.axes[0], d) / w - x, height / 2 + from.focal * dot(from.axes[1], d) / w - y);
    const cost = [Math.max(away, CLICK), w];
    if (cost[0] < least[0] || (cost[0] === least[0] && w < least[1])) [best, least] = [i, cost];
  }
  return best;
}

// Where a point is seen: in the shown frame if it is, else in the one nearest to it.
function seenAt(point) {
  let best = null;
  for (let k = 0; k < frameCount; k++) {
    if (best && Math.abs(k - seek.position) >= Math.abs(best.position - seek.position)) continue;
    const o = tracks.point.subarray(tracks.start[k], tracks.start[k + 1]).indexOf(point) + tracks.start[k];
    if (o >= tracks.start[k]) best = {position: k, u: tracks.place[2 * o] / 65535, v: tracks.place[2 * o + 1] / 65535};
  }
  return best;
}

function placeInScene(x, y) {
  const point = pointAt(x, y);
  if (point < 0) return say("There is no point here; click on one, or in the picture.");
  const pick = seenAt(point);
  goTo(pick.position);
  place({...pick, point: Array.from(points.subarray(3 * point, 3 * point + 3))});
}

// ---- drawing ----

function drawMark(context, ratio, [x, y], text) {
  context.font = `600 ${13 * ratio}px system-ui, sans-serif`;
  for (const [color, wide] of [["#000", 4], ["#fff", 1.6]]) {
    context.strokeStyle = color;
    context.lineWidth = wide * ratio;
    context.beginPath();
    context.moveTo(x - 6 * ratio, y); context.lineTo(x + 6 * ratio, y);
    context.moveTo(x, y - 6 * ratio); context.lineTo(x, y + 6 * ratio);
    context.stroke();
    if (wide > 2) context.strokeText(text, x + 8 * ratio, y - 5 * ratio);
  }
  context.fillStyle = "#fff";
  context.fillText(text, x + 8 * ratio, y - 5 * ratio);
}

// The picks of this frame, and the cross with its loupe.
function drawPicks({context, width, height, ratio}, position) {
  for (const [name, pick] of Object.entries(aligning.picks))
    if (pick.position === position) drawMark(context, ratio, [pick.u * width, pick.v * height], marks[name]);
  if (!aligning.waiting || !aligning.cross) return;
  const [u, v] = aligning.cross, picture = pictureOf(position), side = 0.42 * Math.min(width, height);
  if (picture) {
    const x = u < 0.5 ? width - side : 0, y = v < 0.5 ? height - side : 0, part = side / MAGNIFIED;
    context.save();
    context.beginPath();
    context.rect(x, y, side, side);
    context.clip();
    context.fillRect(x, y, side, side);
    context.setTransform(MAGNIFIED, 0, 0, MAGNIFIED, x - MAGNIFIED * (u * width - part / 2), y - MAGNIFIED * (v * height - part / 2));
    context.drawImage(picture, 0, 0, width, height);
    context.restore();
    context.strokeStyle = css("--card");
    context.lineWidth = 2 * ratio;
    context.strokeRect(x, y, side, side);
    drawMark(context, ratio, [x + side / 2, y + side / 2], "");
  }
  drawMark(context, ratio, [u * width, v * height], marks[aligning.waiting]);
}

// The picks in 3-D, and the line from the origin along x and that of the distance.
function drawScenePicks(context, ratio, project) {
  const at = {};
  for (const [name, {point}] of Object.entries(aligning.picks)) if (point) at[name] = project(point);
  context.strokeStyle = css("--accent");
  context.lineWidth = 2 * ratio;
  context.beginPath();
  for (const [a, b] of [["origin", "axis"], ["from", "to"]]) if (at[a] && at[b]) { context.moveTo(...at[a]); context.lineTo(...at[b]); }
  context.stroke();
  for (const name in at) if (at[name]) drawMark(context, ratio, at[name], marks[name]);
}

// ---- events ----

function addPickControl(box) {
  const name = box.dataset.pick, title = box.textContent;
  const [button, place, drop] = ["button", "button", "button"].map(kind => Object.assign(document.createElement(kind), {type: "button"}));
  button.textContent = title;
  place.title = "Go to this frame";
  drop.textContent = "×";
  drop.setAttribute("aria-label", `Remove ${title.toLowerCase()}`);
  button.addEventListener("click", () => wait(aligning.waiting === name ? null : name));
  place.addEventListener("click", () => goTo(aligning.picks[name].position));
  drop.addEventListener("click", () => { delete aligning.picks[name]; showAlignment(); button.focus(); });
  box.replaceChildren(button, place, drop);
  aligning.controls[name] = {box, title, button, place, drop};
}

function keyInPicture(event) {
  const page = {PageUp: -1, PageDown: 1}[event.key], arrow = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key];
  if (page) goTo(seek.position + page);
  else if (arrow && aligning.waiting) {
    const size = data.sizes[seek.position], cross = aligning.cross || [0.5, 0.5];
    aligning.cross = cross.map((at, k) => clamp(at + arrow[k] * (event.shiftKey ? 1 / size[k] : 0.02), 0, 1));
    drawFootageLater();
  } else if (arrow && arrow[0]) goTo(seek.position + arrow[0]);
  else if (event.key === "Enter" && aligning.waiting) placeInPicture(aligning.cross || [0.5, 0.5]);
  else return;
  event.preventDefault();
}

function startAligning() {
  const footage = byId("footage"), crossAt = event => {
    const box = footage.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height].map(at => clamp(at, 0, 1));
  };
  document.querySelectorAll("[data-pick]").forEach(addPickControl);
  for (const input of document.querySelectorAll("#align_section input")) input.addEventListener("input", showAlignment);
  byId("copy").addEventListener("click", copyAlignment);
  footage.tabIndex = 0;
  footage.setAttribute("aria-label", `${footage.getAttribute("aria-label")}; arrow keys go through the frames, or move the cross of a pick`);
  footage.addEventListener("keydown", keyInPicture);
  footage.addEventListener("pointerdown", event => { if (aligning.waiting) footage.setPointerCapture(event.pointerId); });
  for (const name of ["pointerdown", "pointermove"]) footage.addEventListener(name, event => {
    if (!aligning.waiting) return;
    aligning.cross = crossAt(event);
    drawFootageLater();
  });
  footage.addEventListener("pointerleave", () => { if (aligning.waiting) { aligning.cross = null; drawFootageLater(); } });
  footage.addEventListener("pointerup", event => { if (aligning.waiting && event.button === 0) placeInPicture(crossAt(event)); });
  let pressed = null;
  scene.canvas.addEventListener("pointerdown", event => { pressed = [event.offsetX, event.offsetY]; });
  scene.canvas.addEventListener("pointerup", event => {
    const still = pressed && Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) < CLICK;
    if (aligning.waiting && still && event.button === 0) placeInScene(event.offsetX, event.offsetY);
    pressed = null;
  });
  document.addEventListener("keydown", event => { if (event.key === "Escape" && aligning.waiting) wait(null); });
  byId("scale_choice").hidden = data.survey === "lengths";
  showAlignment();
}
