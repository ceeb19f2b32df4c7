// ---- the tracks by their error, and the command that leaves out those that are chosen ----------------------

// Of the listed tracks: which are chosen; the point of the one that is looked at; by what the rows are sorted.
const list = {chosen: new Set(), point: null, key: "error", descending: true, rows: []};

function lookAt(row) {
  list.point = data.listed.point[row];
  for (const [k, element] of list.rows.entries()) element.classList.toggle("current", k === row);
  goTo(data.listed.worst[row]);
}

// A ring around the track that is looked at, and all of its way.
function drawPointed({context, width, height, ratio}, position) {
  if (list.point === null) return;
  const ways = [];
  let here = null;
  for (let k = 0; k < frameCount; k++) {
    for (let o = tracks.start[k]; o < tracks.start[k + 1]; o++) {
      if (tracks.point[o] !== list.point) continue;
      const at = [tracks.place[2 * o] / 65535 * width, tracks.place[2 * o + 1] / 65535 * height];
      ways.push(at);
      if (k === position) here = at;
    }
  }
  for (const [color, wide] of [["#000", 4], [css("--accent"), 2]]) {
    context.strokeStyle = color;
    context.lineWidth = wide * ratio;
    context.beginPath();
    ways.forEach((at, k) => k ? context.lineTo(...at) : context.moveTo(...at));
    if (here) { context.moveTo(here[0] + 12 * ratio, here[1]); context.arc(...here, 12 * ratio, 0, 7); }
    context.stroke();
  }
}

function drawPointedAlone() {
  const prepared = prepare(byId("pointed"));
  if (!prepared) return;
  drawPicture(prepared, seek.position, 1);
  drawPointed(prepared, seek.position);
}

function sortRows(key) {
  list.descending = key === list.key ? !list.descending : key !== "name" && key !== "first";
  list.key = key;
  const values = data.listed[key], sign = list.descending ? -1 : 1;
  const order = [...list.rows.keys()].sort((a, b) => sign * (values[a] < values[b] ? -1 : values[a] > values[b] ? 1 : 0));
  byId("tracks_rows").append(...order.map(row => list.rows[row]));
  for (const button of document.querySelectorAll("[data-sort]")) {
    const sorted = button.dataset.sort === key;
    button.closest("th").setAttribute("aria-sort", !sorted ? "none" : list.descending ? "descending" : "ascending");
  }
}

function showCommand() {
  const {number, name} = data.listed, names = new Set(name);
  // A number that the user has called another track is its name to the command.
  const words = [...list.chosen].sort((a, b) => number[a] - number[b])
    .map(row => names.has(String(number[row])) ? shellWord(name[row]) : number[row]);
  byId("mend_command").value = words.length
    ? `factorsfm solve ${shellWord(resultFolder())} --without-tracks ${words.join(" ")} --output ${shellWord(resultFolder() + "-mended")}`
    : "";
  byId("mend_copy").disabled = byId("mend_none").disabled = !words.length;
  byId("mend_copy").textContent = "Copy";
}

function choose(row, chosen) {
  list.rows[row].querySelector("input").checked = chosen;
  list.chosen[chosen ? "add" : "delete"](row);
  showCommand();
}

function copyCommand() {
  byId("mend_copy").textContent = copied(byId("mend_command")) ? "Copied" : "Selected";
}

function trackRow(row) {
  const {name, error, frames, first, last, supervised} = data.listed;
  const element = document.createElement("tr"), button = document.createElement("button"), box = document.createElement("input");
  button.type = "button";
  button.textContent = name[row];
  button.addEventListener("click", () => lookAt(row));
  box.type = "checkbox";
  box.setAttribute("aria-label", `Leave ${name[row]} out`);
  box.addEventListener("change", () => choose(row, box.checked));
  const cells = [box, button, `${error[row].toFixed(2)} px`, String(frames[row]), `${data.frame[first[row]]} to ${data.frame[last[row]]}`, supervised[row] ? "supervised" : ""];
  for (const [k, content] of cells.entries()) {
    const cell = document.createElement("td");
    cell.append(content);
    cell.hidden = k === 0 && !data.canBeMended;
    element.append(cell);
  }
  return element;
}

function startList() {
  list.rows = data.listed.name.map((_, row) => trackRow(row));
  byId("tracks_rows").append(...list.rows);
  for (const button of document.querySelectorAll("[data-sort]")) button.addEventListener("click", () => sortRows(button.dataset.sort));
  byId("mend_controls").hidden = byId("mend_column").hidden = !data.canBeMended;
  byId("mend_copy").addEventListener("click", copyCommand);
  byId("mend_none").addEventListener("click", () => { for (const row of [...list.chosen]) choose(row, false); });
  byId("mend_command").addEventListener("focus", event => event.target.select());
  showCommand();
}
