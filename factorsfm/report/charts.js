// ---- charts ----------------------------------------------------------------------------------------------

const charts = data.charts;
const SVG = "http://www.w3.org/2000/svg";
const margin = {left: 46, right: 14, top: 10, bottom: 24};

function element(parent, name, attributes, text) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return parent.appendChild(node);
}

// The range of the axis with some room, never empty.
function axisRange(chart, known) {
  const spread = k => chart.std[k] || 0;
  let low = Math.min(...known.map(k => chart.values[k] - spread(k))), high = Math.max(...known.map(k => chart.values[k] + spread(k)));
  if (chart.pale.length) high = Math.max(high, ...chart.pale);
  if (chart.zero) low = 0;
  if (high - low <= 1e-9 * Math.abs(high)) { high += 0.5 * (Math.abs(high) || 1); low -= chart.zero ? 0 : 0.5 * (Math.abs(low) || 1); }
  const room = 0.06 * (high - low);
  return [chart.zero ? low : low - room, high + room];
}

function drawChart(chart) {
  const {svg, values, std, pale} = chart, width = svg.clientWidth, height = svg.clientHeight;
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const isKnown = k => values[k] !== null, known = [...values.keys()].filter(isKnown);
  const [low, high] = axisRange(chart, known);
  const inner = width - margin.left - margin.right, bottom = height - margin.bottom;
  const x = chart.x = k => margin.left + inner * k / last;
  const y = v => bottom - (bottom - margin.top) * (v - low) / (high - low);

  const step = inner / last;
  data.registered.forEach((registered, k) => {
    if (!registered) element(svg, "rect", {x: x(k) - step / 2, y: margin.top, width: step, height: bottom - margin.top, fill: "var(--missing)"});
  });
  const rough = (high - low) / 4, tick = [1, 2, 5, 10].map(f => f * 10 ** Math.floor(Math.log10(rough))).find(t => t >= rough);
  for (let t = Math.ceil(low / tick); t * tick <= high; t++) {
    element(svg, "line", {x1: margin.left, x2: width - margin.right, y1: y(t * tick), y2: y(t * tick), stroke: "var(--line)"});
    element(svg, "text", {x: margin.left - 6, y: y(t * tick) + 4, "text-anchor": "end"}, format(t * tick));
  }
  const every = [1, 2, 5, 10, 20, 25, 50, 100, 200, 500].find(n => last / n <= inner / 45) || Math.ceil(last / 5);
  const name = width - margin.right;
  element(svg, "text", {x: name, y: height - 4, "text-anchor": "end"}, "frame");
  for (let k = 0; k < frameCount && (!k || x(k) < name - 48); k += every) element(svg, "text", {x: x(k), y: height - 4, "text-anchor": "middle"}, data.frame[k]);
  data.keyframe.forEach((keyframe, k) => {
    if (keyframe) element(svg, "line", {x1: x(k), x2: x(k), y1: bottom + 1, y2: bottom + 6, stroke: "var(--quiet)"});
  });

  // A line joins the known values; it does not cross frames that are not solved.
  const runsOf = numbers => {
    const runs = [];
    for (const k of [...numbers.keys()].filter(k => numbers[k] !== null)) {
      const run = runs[runs.length - 1];
      if (run && (numbers === pale || data.registered.slice(run[run.length - 1], k).every(Boolean))) run.push(k); else runs.push([k]);
    }
    return runs;
  };
  const line = (ks, value) => ks.map(k => x(k).toFixed(1) + "," + y(value(k)).toFixed(1)).join(" ");
  for (const run of runsOf(pale)) element(svg, "polyline", {points: line(run, k => pale[k]), fill: "none", stroke: "var(--accent)", opacity: 0.4});
  for (const run of runsOf(values)) {
    if (std.length) element(svg, "polygon", {points: line(run, k => values[k] + (std[k] || 0)) + " " + line([...run].reverse(), k => values[k] - (std[k] || 0)), fill: "var(--band)"});
    element(svg, "polyline", {points: line(run, k => values[k]), fill: "none", stroke: "var(--accent)", "stroke-width": 1.6, "stroke-linejoin": "round"});
  }
  if (known.length < inner / 14) for (const k of known) element(svg, "circle", {cx: x(k), cy: y(values[k]), r: 2.4, fill: "var(--accent)"});
  chart.marker = element(svg, "line", {y1: margin.top, y2: bottom, stroke: "var(--ink)", opacity: 0.6});
  markFrame(chart);
}

function markFrame(chart) {
  const k = seek.position, value = chart.values[k], std = chart.std[k], pale = chart.pale[k];
  chart.marker.setAttribute("x1", chart.x(k));
  chart.marker.setAttribute("x2", chart.x(k));
  chart.output.textContent = format(value) + (typeof std === "number" ? " ± " + format(std) : "") + (typeof pale === "number" ? " (" + format(pale) + ")" : "");
}

function startCharts() {
  for (const chart of charts) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    figure.className = "card";
    chart.output = document.createElement("output");
    caption.append(chart.title, chart.output);
    figure.append(caption);
    byId("charts").append(figure);
    chart.svg = element(figure, "svg", {tabindex: 0, role: "img", "aria-label": chart.title});
    const seekTo = event => {
      const inner = chart.svg.clientWidth - margin.left - margin.right;
      if (event.buttons) goTo(Math.round((event.clientX - chart.svg.getBoundingClientRect().left - margin.left) / inner * last));
    };
    for (const name of ["pointerdown", "pointermove"]) chart.svg.addEventListener(name, seekTo);
    chart.svg.addEventListener("keydown", event => {
      const delta = {ArrowLeft: -1, ArrowRight: 1}[event.key];
      if (delta) { event.preventDefault(); goTo(seek.position + delta); }
    });
  }
  seek.followers.push(() => charts.forEach(chart => { if (chart.marker) markFrame(chart); }));
}
