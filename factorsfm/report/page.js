// ---- the page --------------------------------------------------------------------------------------------

const slider = byId("slider"), play = byId("play");
const FRAMES_PER_SECOND = 24;
let playing = null;

function showStatus(position) {
  slider.value = position;
  const seconds = data.timestamp[position];
  const parts = [`Frame ${data.frame[position]}`];
  if (data.name[position] !== String(data.frame[position]).padStart(6, "0")) parts.push(data.name[position]);
  if (seconds !== null) parts.push(`${seconds.toFixed(2)} s`);
  parts.push(data.status[position] + (data.keyframe[position] ? ", keyframe" : ""));
  if (data.message[position]) parts.push(data.message[position]);
  byId("status").textContent = parts.join(" · ");
}

function togglePlay() {
  if (playing) clearInterval(playing);
  playing = playing ? null : setInterval(() => goTo((seek.position + 1) % frameCount), 1000 / FRAMES_PER_SECOND);
  play.textContent = playing ? "Pause" : "Play";
}

function drawAll() {
  if (solved) drawScene();
  drawFootageAll();
  charts.forEach(drawChart);
}

byId("scene_card").hidden = byId("scene_hint").hidden = !solved;
byId("footage_card").hidden = !hasThumbnails && !hasTracks;
byId("tracks_controls").hidden = byId("tracks_section").hidden = !hasTracks;
byId("moving_control").hidden = !moving;
if (!solved) byId("footage_title").textContent = "Footage";
byId("depth_section").hidden = withPrior.every(position => position < 0);
byId("charts_section").hidden = !charts.length;
byId("align_section").hidden = !alignable;
byId("footage_section").hidden = !frameCount;
if (frameCount) {
  slider.max = frameCount - 1;
  startFootage();
  if (solved) startScene();
  if (alignable) startAligning();
  if (hasTracks) startList();
  startCharts();
  seek.followers.push(showStatus);
  slider.addEventListener("input", () => goTo(Number(slider.value)));
  play.addEventListener("click", togglePlay);
  goTo(0);
  new ResizeObserver(coalesced(drawAll)).observe(document.querySelector("main"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
}
