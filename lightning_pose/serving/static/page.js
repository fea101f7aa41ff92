// The page: sends a picture to /localize, and draws the answer in the map from above.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);
const earlier = []; // places of earlier answers, in the plane
let view = null; // of /map; null where the system has no map
let asked = 0; // number of the last question, so that a late answer does not replace a newer one

function shape(parent, name, attributes, text) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  parent.append(element);
  return element;
}

const project = (vector) => view.axes.map((axis) => axis[0] * vector[0] + axis[1] * vector[1] + axis[2] * vector[2]);

/** The third column of the rotation: where the camera looks, in the world. */
const lookingAt = (pose) => pose.T_world_cam.slice(0, 3).map((row) => row[2]);

/** From the plane to pixels of the drawing: one scale for both axes, up is up. */
function fitBox(box, width, height) {
  const scale = Math.min(width / (box[2] - box[0]), height / (box[3] - box[1]));
  const left = (width - scale * (box[2] - box[0])) / 2, top = (height - scale * (box[3] - box[1])) / 2;
  return { scale, place: ([x, y]) => [left + (x - box[0]) * scale, top + (box[3] - y) * scale] };
}

/** An arrow's head at a place, towards a direction of the plane. */
function arrow([x, y], [dx, dy], size) {
  const length = Math.hypot(dx, dy);
  if (length < 1e-3) return `M${x - size / 2},${y} a${size / 2},${size / 2} 0 1,0 ${size},0 a${size / 2},${size / 2} 0 1,0 ${-size},0`;
  const [ux, uy] = [dx / length, -dy / length];
  const corner = (along, across) => `${x + size * (along * ux - across * uy)},${y + size * (along * uy + across * ux)}`;
  return `M${corner(1.2, 0)} L${corner(-0.6, 0.6)} L${corner(-0.3, 0)} L${corner(-0.6, -0.6)} Z`;
}

function drawScale(svg, scale, height) {
  const wanted = 120 / scale, step = 10 ** Math.floor(Math.log10(wanted));
  const length = [5, 2, 1].map((factor) => factor * step).find((value) => value <= wanted) || step;
  shape(svg, "path", { class: "scale", d: `M12,${height - 14} h${length * scale}` });
  shape(svg, "text", { x: 12, y: height - 20 }, String(Number(length.toPrecision(2))));
}

function draw(pose) {
  const svg = byId("map");
  svg.replaceChildren();
  if (!view) {
    shape(svg, "text", { x: 20, y: 30 }, "This system has no map to draw.");
    return;
  }
  const { width, height } = svg.getBoundingClientRect();
  const box = [...view.box];
  const place = pose && project(pose.position_m);
  if (place) { // an answer outside the map is drawn, too
    const extent = Math.max(box[2] - box[0], box[3] - box[1]);
    const margin = Math.min(Math.max(0.05 * extent, 1.1 * (pose.radius_m || 0)), extent);
    for (const axis of [0, 1]) {
      box[axis] = Math.min(box[axis], place[axis] - margin);
      box[axis + 2] = Math.max(box[axis + 2], place[axis] + margin);
    }
  }
  const fit = fitBox(box, width, height);
  const dots = view.points.map((point) => fit.place(point).map((value) => value.toFixed(1)));
  const d = dots.map(([x, y]) => `M${x - 1},${y}h2v2h-2z`).join("");
  shape(svg, "path", { class: "point", d });
  const arrows = view.cameras.map(([x, y, dx, dy]) => arrow(fit.place([x, y]), [dx, dy], 5)).join("");
  shape(svg, "path", { class: "camera", d: arrows });
  for (const old of earlier) {
    const [x, y] = fit.place(old);
    shape(svg, "circle", { class: "earlier", cx: x, cy: y, r: 4 });
  }
  drawScale(svg, fit.scale, height);
  if (!place) return;
  const [x, y] = fit.place(place);
  const group = shape(svg, "g", { class: pose.status, "data-x": place[0], "data-y": place[1] });
  if (pose.radius_m !== null) shape(group, "circle", { class: "radius", cx: x, cy: y, r: Math.max(pose.radius_m * fit.scale, 6) });
  shape(group, "path", { class: "answer", d: arrow([x, y], project(lookingAt(pose)), 11) });
}

const digits = (values, count) => values.map((value) => value.toFixed(count)).join(", ");
const known = (value, count, name) => (value === null ? "unknown" : `${value.toFixed(count)} ${name}`.trim());

function showAnswer(pose) {
  const rows = [
    ["position", digits(pose.position_m, 3)],
    ["quaternion wxyz", digits(pose.quat_wxyz, 4)],
    ["90 % within", `${known(pose.radius_m, 3, "")}, ${known(pose.radius_deg, 2, "degrees")}`],
    ["source", pose.source],
    ["inliers", pose.inliers === null ? "no map" : `${pose.inliers} of ${pose.visible} visible points`],
    ["time", known(pose.milliseconds.total ?? null, 0, "ms")],
    ...pose.notes.map((note) => ["note", note]),
  ];
  byId("answer").replaceChildren(...rows.map(([name, text]) => {
    const row = document.createElement("tr");
    row.append(document.createElement("th"), document.createElement("td"));
    row.children[0].textContent = name;
    row.children[1].textContent = text;
    return row;
  }));
  byId("json").textContent = JSON.stringify(pose, null, 1);
  say(pose.status === "accepted" ? "accepted" : `refused: ${pose.reason}`, pose.status !== "accepted");
}

function say(text, bad) {
  byId("status").textContent = text;
  byId("status").className = bad ? "bad" : "";
}

async function ask(file) {
  const question = ++asked;
  const preview = byId("preview");
  URL.revokeObjectURL(preview.src);
  preview.src = URL.createObjectURL(file);
  preview.alt = file.name;
  preview.hidden = false;
  byId("hint").textContent = file.name;
  byId("answer").replaceChildren();
  byId("json").textContent = "";
  say("locating …", false);
  const form = new FormData();
  form.append("image", file);
  for (const name of ["camera", "prior"]) if (byId(name).value.trim()) form.append(name, byId(name).value.trim());
  let answer;
  try {
    answer = await (await fetch("localize", { method: "POST", body: form })).json();
  } catch (error) {
    answer = { error: { message: `the server does not answer (${error.message})` } };
  }
  if (question !== asked) return;
  if (answer.error) {
    draw(null);
    say(answer.error.message, true);
    return;
  }
  showAnswer(answer);
  draw(answer);
  if (view && answer.status === "accepted") earlier.push(project(answer.position_m));
}

function listen() {
  const drop = byId("drop");
  byId("file").addEventListener("change", (event) => {
    if (event.target.files.length) ask(event.target.files[0]);
    event.target.value = ""; // so that the same file may be chosen again
  });
  addEventListener("dragover", (event) => { event.preventDefault(); drop.classList.add("over"); });
  addEventListener("dragleave", () => drop.classList.remove("over"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    const [file] = event.dataTransfer.files;
    if (file) ask(file);
  });
}

async function start() {
  listen();
  const model = await (await fetch("model")).json();
  byId("model").textContent = ["architecture", "scene", "ground_truth", "camera", "version"]
    .filter((name) => model[name]).map((name) => `${name.replace("_", " ")} ${model[name]}`).join(" · ");
  const answer = await fetch("map");
  view = answer.ok ? await answer.json() : null;
  draw(null);
}

start();
