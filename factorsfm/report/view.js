// ---- the scene in 3-D: points as squares with a depth buffer, lines over them ------------------------------

const scene = {canvas: byId("scene"), paint: "depth", look: "scene", yaw: 0, pitch: 0, distance: 1, target: [0, 0, 0], seen: new Uint8Array(pointCount)};

function range(coordinates, trim) {
  return [0, 1, 2].map(axis => {
    const values = coordinates.filter((_, i) => i % 3 === axis).sort();
    return [quantile(values, trim), quantile(values, 1 - trim)];
  });
}
const pathRange = range(centers, 0);
const sceneRange = range(pointCount ? points : centers, 0.03).map(([low, high], axis) => [Math.min(low, pathRange[axis][0]), Math.max(high, pathRange[axis][1])]);
const sceneSize = Math.hypot(...sceneRange.map(([low, high]) => high - low)) || 1;

// Rows: the screen's right, down and away from the viewer.
function orientation(yaw, pitch) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return [[cy, 0, -sy], [sp * sy, cp, sp * cy], [cp * sy, -sp, cp * cy]];
}
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const FOCAL = 1.1; // of the viewer, in units of the shorter side

// Turns to a named view; moves until the path and, except for its own view, most of the points fill the canvas.
function look(name) {
  [scene.yaw, scene.pitch] = {above: [0, -Math.PI / 2], side: [-Math.PI / 2, 0]}[name] || [-0.55, -0.35];
  scene.look = name;
  scene.target = (name === "path" ? pathRange : sceneRange).map(([low, high]) => (low + high) / 2);
  scene.distance = 2 * sceneSize;
  const axes = orientation(scene.yaw, scene.pitch), size = [scene.canvas.clientWidth || 1, scene.canvas.clientHeight || 1];
  const span = (coordinates, axis, trim) => {
    const slopes = Float32Array.from({length: coordinates.length / 3}, (_, i) => {
      const d = scene.target.map((t, k) => coordinates[3 * i + k] - t);
      return dot(axes[axis], d) / Math.max(dot(axes[2], d) + scene.distance, 1e-4 * sceneSize);
    }).sort();
    return [quantile(slopes, trim), quantile(slopes, 1 - trim)];
  };
  const some = points.filter((_, i) => Math.floor(i / 3) % Math.ceil(pointCount / 1000) === 0);
  for (let round = 0; round < 25; round++) {
    const spans = [0, 1].map(axis => {
      const path = span(centers, axis, 0), scattered = name === "path" || !pointCount ? path : span(some, axis, 0.02);
      return [Math.min(path[0], scattered[0]), Math.max(path[1], scattered[1])];
    });
    // half of what would be right if everything were as far away as the target: near things move more
    scene.target = scene.target.map((t, k) => t + spans.reduce((sum, [low, high], axis) => sum + scene.distance * axes[axis][k] * (low + high) / 4, 0));
    const filled = Math.max(...spans.map(([low, high], axis) => FOCAL * Math.min(...size) * (high - low) / (0.88 * size[axis])));
    let before = 0; // how far the path comes towards the viewer
    for (let k = 0; k < cameraCount; k++) before = Math.max(before, -dot(axes[2], scene.target.map((t, axis) => centers[3 * k + axis] - t)));
    scene.distance = Math.max(scene.distance * clamp(filled, 0.5, 2), 1.6 * before, 0.002 * sceneSize);
  }
  drawSceneLater();
}

// The viewer: axes, place, focal length in pixels, nearest distance that is drawn.
function viewer(width, height) {
  const row = cameraOf.get(seek.position);
  if (scene.look === "through" && row !== undefined) {
    const r = rotations.subarray(9 * row, 9 * row + 9);
    return {
      axes: [0, 1, 2].map(column => [r[column], r[3 + column], r[6 + column]]),
      eye: centers.subarray(3 * row, 3 * row + 3),
      focal: data.focals[row] * Math.min(width / data.width, height / data.height),
      near: 1e-6 * sceneSize,
      inside: true,
    };
  }
  const axes = orientation(scene.yaw, scene.pitch);
  return {
    axes,
    eye: scene.target.map((t, k) => t - scene.distance * axes[2][k]),
    focal: FOCAL * Math.min(width, height),
    near: 0.02 * scene.distance,
    inside: false,
  };
}

const packed = (r, g, b, alpha) => (alpha << 24 | b << 16 | g << 8 | r) >>> 0;
const palettes = {
  depth: Uint32Array.from({length: pointCount}, (_, i) => packed(...depthColor(points[3 * i + 2]), 255)),
  image: Uint32Array.from({length: pointCount}, (_, i) => packed(colors[3 * i], colors[3 * i + 1], colors[3 * i + 2], 255)),
};
let buffers = null;

function drawPoints(context, width, height, ratio, from) {
  if (!buffers || buffers.image.width !== width || buffers.image.height !== height) {
    const image = context.createImageData(width, height);
    buffers = {image, pixels: new Uint32Array(image.data.buffer), depth: new Float32Array(width * height)};
  }
  const {pixels, depth} = buffers, [right, down, away] = from.axes, [ex, ey, ez] = from.eye, palette = palettes[scene.paint];
  pixels.fill(0);
  depth.fill(Infinity);
  const small = Math.max(1, Math.round((pointCount > 5000 ? 1.2 : 1.7) * ratio)), large = Math.round((pointCount > 5000 ? 2 : 3) * ratio);
  for (let i = 0; i < pointCount; i++) {
    const dx = points[3 * i] - ex, dy = points[3 * i + 1] - ey, dz = points[3 * i + 2] - ez;
    const w = away[0] * dx + away[1] * dy + away[2] * dz;
    if (w < from.near) continue;
    const size = scene.seen[i] ? large : small, scale = from.focal / w;
    const x = Math.round(width / 2 + scale * (right[0] * dx + right[1] * dy + right[2] * dz) - size / 2);
    const y = Math.round(height / 2 + scale * (down[0] * dx + down[1] * dy + down[2] * dz) - size / 2);
    if (x < 0 || y < 0 || x + size > width || y + size > height) continue;
    for (let v = y; v < y + size; v++) {
      for (let at = v * width + x, end = at + size; at < end; at++) {
        if (w < depth[at]) { depth[at] = w; pixels[at] = palette[i]; }
      }
    }
  }
  context.putImageData(buffers.image, 0, 0);
}

function drawScene() {
  const prepared = prepare(scene.canvas);
  if (!prepared) return;
  const {context, width, height, ratio} = prepared, from = viewer(width, height);
  drawPoints(context, width, height, ratio, from);
  const project = p => {
    const d = [p[0] - from.eye[0], p[1] - from.eye[1], p[2] - from.eye[2]], w = dot(from.axes[2], d);
    return w < from.near ? null : [width / 2 + from.focal * dot(from.axes[0], d) / w, height / 2 + from.focal * dot(from.axes[1], d) / w];
  };
  if (!from.inside) drawPath(prepared, from, project);
  drawScenePicks(context, ratio, project);
}

// The ground, the path, some cameras and a scale bar, as seen from outside.
function drawPath({context, width, height, ratio}, from, project) {
  const line = (a, b) => { if (a && b) { context.moveTo(...a); context.lineTo(...b); } };

  context.strokeStyle = css("--quiet");
  context.lineWidth = 0.5 * ratio;
  context.beginPath();
  for (let i = 0; i < ground.length; i += 6) line(project(ground.subarray(i, i + 3)), project(ground.subarray(i + 3, i + 6)));
  context.stroke();

  context.strokeStyle = css("--path");
  context.lineWidth = 1.8 * ratio;
  context.lineCap = "round";
  context.beginPath();
  const path = Array.from({length: cameraCount}, (_, k) => project(centers.subarray(3 * k, 3 * k + 3)));
  for (let k = 1; k < cameraCount; k++) line(path[k - 1], path[k]);
  context.stroke();

  // the pyramid of view of the first, the last and, larger, the shown frame
  const current = cameraOf.get(seek.position);
  for (const row of new Set([0, cameraCount - 1, current])) {
    if (row === undefined) continue;
    const shown = row === current, reach = (shown ? 0.13 : 0.07) * scene.distance;
    const r = rotations.subarray(9 * row, 9 * row + 9), c = centers.subarray(3 * row, 3 * row + 3);
    const w = data.width / 2 / data.focals[row], h = data.height / 2 / data.focals[row];
    const corners = [[-w, -h], [w, -h], [w, h], [-w, h]].map(([x, y]) => project([0, 1, 2].map(a => c[a] + reach * (r[3 * a] * x + r[3 * a + 1] * y + r[3 * a + 2]))));
    context.lineWidth = (shown ? 1.8 : 1) * ratio;
    context.beginPath();
    corners.forEach((corner, k) => { line(path[row], corner); line(corner, corners[(k + 1) % 4]); });
    context.stroke();
  }

  // scale bar, at the distance of the point that the view turns about
  const scale = from.focal / scene.distance, length = roundLength(width / 5 / scale), x = 12 * ratio, y = height - 12 * ratio;
  context.strokeStyle = context.fillStyle = css("--quiet");
  context.lineWidth = ratio;
  context.beginPath();
  context.moveTo(x, y - 4 * ratio); context.lineTo(x, y); context.lineTo(x + length * scale, y); context.lineTo(x + length * scale, y - 4 * ratio);
  context.stroke();
  context.font = `${12 * ratio}px system-ui, sans-serif`;
  context.fillText(format(length) + " " + (length === 1 ? data.unit.replace("units", "unit") : data.unit), x + 6 * ratio, y - 6 * ratio);
}
const drawSceneLater = coalesced(drawScene);

function turn(dx, dy) {
  if (scene.look === "through") look("scene");
  scene.yaw += dx;
  scene.pitch = clamp(scene.pitch - dy, -Math.PI / 2, Math.PI / 2);
  drawSceneLater();
}
function zoom(factor) {
  if (scene.look === "through") look("scene");
  scene.distance = clamp(scene.distance / factor, 1e-4 * sceneSize, 20 * sceneSize);
  drawSceneLater();
}
function move(dx, dy) {
  const axes = orientation(scene.yaw, scene.pitch);
  const unit = scene.distance / (FOCAL * Math.min(scene.canvas.clientWidth, scene.canvas.clientHeight));
  scene.target = scene.target.map((t, k) => t - unit * (dx * axes[0][k] + dy * axes[1][k]));
  drawSceneLater();
}

function startScene() {
  const {canvas} = scene, pointers = new Map();
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => pointers.delete(event.pointerId));
  canvas.addEventListener("pointermove", event => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before[0], dy = event.clientY - before[1];
    const other = [...pointers].find(([id]) => id !== event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (other) {
      const distance = (x, y) => Math.hypot(x - other[1][0], y - other[1][1]) || 1;
      zoom(distance(event.clientX, event.clientY) / distance(...before));
      move(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons > 1) move(dx, dy);
    else turn(dx * 0.008, dy * 0.008);
  });
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("wheel", event => { event.preventDefault(); zoom(Math.exp(-event.deltaY * 0.0015)); }, {passive: false});
  canvas.addEventListener("keydown", event => {
    const actions = {
      ArrowLeft: () => turn(-0.08, 0), ArrowRight: () => turn(0.08, 0), ArrowUp: () => turn(0, -0.08), ArrowDown: () => turn(0, 0.08),
      "+": () => zoom(1.2), "=": () => zoom(1.2), "-": () => zoom(1 / 1.2), 0: () => look("scene"),
    };
    if (actions[event.key] && !event.ctrlKey && !event.metaKey) { event.preventDefault(); actions[event.key](); }
  });
  for (const button of document.querySelectorAll("[data-look]")) button.addEventListener("click", () => look(button.dataset.look));
  for (const input of document.getElementsByName("paint")) {
    input.addEventListener("change", () => { scene.paint = input.value; drawSceneLater(); });
  }
  seek.followers.push(position => {
    scene.seen.fill(0);
    if (hasTracks) for (let o = tracks.start[position]; o < tracks.start[position + 1]; o++) scene.seen[tracks.point[o]] = 1;
    drawSceneLater();
  });
  look("scene");
}
