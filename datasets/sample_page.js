"use strict";
// Draws the page of one sample. Image coordinates: pixel (u, v) has its centre at integers, so that it covers
// [u - 0.5, u + 0.5]; "corner" coordinates below are u + 0.5, counted from the image's upper left corner.

const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const state = { chosen: null, zoom: "whole" };
const DEGREES = 180 / Math.PI;

// Planes.

function bytes(text) {
  return Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
}

async function codes(text, width, height) {
  const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const halves = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = width * height, result = new Uint16Array(count);
  for (let row = 0; row < height; row++) {
    let value = 0;
    for (let k = row * width; k < (row + 1) * width; k++) {
      value = (value + halves[k] + 256 * halves[count + k]) & 65535;
      result[k] = value;
    }
  }
  return result;
}

function image(text) {
  return new Promise((resolve, reject) => {
    const picture = new Image();
    picture.onload = () => resolve(picture);
    picture.onerror = () => reject(new Error("a picture of this page is damaged"));
    picture.src = "data:image/jpeg;base64," + text;
  });
}

async function unpacked(position) {
  const view = data.views[position];
  const { width, height } = view;
  view.pictures = { on: await image(view.on), off: await image(view.off) };
  for (const name of Object.keys(view.planes)) {
    view.planes[name].codes = await codes(view.planes[name].data, width, height);
  }
  if (view.spot) view.spot.codes = await codes(view.spot.data, view.spot.width, view.spot.height);
  view.canvas = byId(position);
}

// Decimals of a step: 1e-3 -> 3, 2.5e-5 -> 6.
function decimals(step) {
  for (let n = 0; n < 12; n++) if (Math.abs(step * 10 ** n - Math.round(step * 10 ** n)) < 1e-6) return n;
  return 12;
}

function valueAt(view, name, index) {
  const plane = view.planes[name];
  return plane.offset + plane.step * plane.codes[index];
}

function spotAt(view, u, v) {
  const spot = view.spot;
  if (!spot) return 0;
  const column = u - spot.u0, row = v - spot.v0;
  const inside = column >= 0 && row >= 0 && column < spot.width && row < spot.height;
  return inside ? spot.step * spot.codes[row * spot.width + column] : 0;
}

// What the truth says of a pixel: {object: number or null, name, values by plane}.
function truthAt(position, u, v) {
  const view = data.views[position], index = v * view.width + u;
  const object = view.planes.object_id.codes[index];
  if (object === 65535) return { object: null, name: "nothing", values: {} };
  const values = {};
  for (const name of Object.keys(view.planes)) {
    if (name !== "object_id") values[name] = valueAt(view, name, index).toFixed(decimals(view.planes[name].step));
  }
  return { object, name: data.objects[object], values };
}

// Pictures.

// Transform of a canvas: canvas pixel = (corner coordinate - origin) * scale.
function frameOf(view) {
  const box = view.canvas.getBoundingClientRect();
  const wide = view.canvas.clientWidth, high = view.canvas.clientHeight;
  let scale = wide / view.width, x0 = 0, y0 = 0;
  if (state.zoom === "spot" && view.mark) {
    scale = wide / 40;
    x0 = Math.round(view.mark[0]) + 0.5 - 20;
    y0 = Math.round(view.mark[1]) + 0.5 - (high / scale) / 2;
  }
  return { scale, x0, y0, left: box.left + view.canvas.clientLeft, top: box.top + view.canvas.clientTop, wide, high };
}

function toCanvas(frame, u, v) {
  return [(u + 0.5 - frame.x0) * frame.scale, (v + 0.5 - frame.y0) * frame.scale];
}

function pixelAt(view, clientX, clientY) {
  const frame = frameOf(view);
  const u = Math.floor((clientX - frame.left) / frame.scale + frame.x0);
  const v = Math.floor((clientY - frame.top) / frame.scale + frame.y0);
  return u >= 0 && v >= 0 && u < view.width && v < view.height ? [u, v] : null;
}

function context(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  return ctx;
}

function polyline(ctx, frame, points) {
  ctx.beginPath();
  let down = false;
  for (const point of points) {
    if (!point) { down = false; continue; }
    const [x, y] = toCanvas(frame, point[0], point[1]);
    if (down) ctx.lineTo(x, y); else ctx.moveTo(x, y);
    down = true;
  }
  ctx.stroke();
}

function haloed(ctx, text, x, y, fill) {
  ctx.lineWidth = 3;
  ctx.strokeStyle = "#000a";
  ctx.strokeText(text, x, y);
  ctx.fillStyle = fill;
  ctx.fillText(text, x, y);
}

function drawLine(ctx, frame, line, wide, mark) {
  ctx.strokeStyle = "#0009";
  ctx.lineWidth = 3.5;
  polyline(ctx, frame, line.points);
  ctx.strokeStyle = colour("--curve");
  ctx.lineWidth = 1.7;
  polyline(ctx, frame, line.points);
  ctx.font = "11px system-ui, sans-serif";
  const taken = mark && state.zoom !== "spot" ? [toCanvas(frame, ...mark)] : []; // no number on the cross
  for (const [depth, u, v] of line.marks) {
    const [x, y] = toCanvas(frame, u, v);
    ctx.beginPath();
    ctx.arc(x, y, 2.5, 0, 7);
    ctx.fillStyle = colour("--curve");
    ctx.fill();
    const free = taken.every(([a, b]) => Math.hypot(a - x, b - y) > 22);
    if (free && x > -5 && y > -5 && x < wide + 5) {
      taken.push([x, y]);
      haloed(ctx, String(depth), x + 5, y - 4, "#fff");
    }
  }
}

function drawMark(ctx, frame, mark) {
  const [x, y] = toCanvas(frame, mark[0], mark[1]);
  const gap = Math.max(4, 1.2 * frame.scale), length = Math.max(11, 3 * frame.scale);
  for (const [style, width] of [["#000b", 4], [colour("--mark"), 1.8]]) {
    ctx.strokeStyle = style;
    ctx.lineWidth = width;
    ctx.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      ctx.moveTo(x + dx * gap, y + dy * gap);
      ctx.lineTo(x + dx * length, y + dy * length);
    }
    if (state.zoom === "spot") { // the exact place, where it can be told
      ctx.moveTo(x - 4, y); ctx.lineTo(x + 4, y); ctx.moveTo(x, y - 4); ctx.lineTo(x, y + 4);
    }
    ctx.stroke();
  }
}

function drawSpotLayer(ctx, frame, spot) {
  for (let row = 0; row < spot.height; row++) {
    for (let column = 0; column < spot.width; column++) {
      const share = spot.codes[row * spot.width + column] / 65534;
      if (share < 1e-4) continue;
      const level = 1 + Math.log10(share) / 4; // four decades
      const [x, y] = toCanvas(frame, spot.u0 + column - 0.5, spot.v0 + row - 0.5);
      ctx.fillStyle = `hsl(${280 - 235 * level} 95% ${25 + 40 * level}% / 0.9)`;
      ctx.fillRect(x, y, frame.scale + 0.3, frame.scale + 0.3);
    }
  }
}

function drawView(position) {
  const view = data.views[position];
  view.canvas.style.aspectRatio = `${view.width} / ${view.height}`;
  const ctx = context(view.canvas), frame = frameOf(view);
  ctx.imageSmoothingEnabled = frame.scale < 2;
  const picture = view.pictures[byId("laser").checked ? "on" : "off"];
  const [x, y] = toCanvas(frame, -0.5, -0.5);
  ctx.drawImage(picture, x, y, view.width * frame.scale, view.height * frame.scale);
  if (byId("layers").checked && view.spot) drawSpotLayer(ctx, frame, view.spot);
  if (byId("marks").checked) {
    ctx.strokeStyle = colour("--mark");
    ctx.lineWidth = 1;
    polyline(ctx, frame, [...view.outline, view.outline[0]]);
  }
  if (byId("lines").checked && view.line) drawLine(ctx, frame, view.line, frame.wide, view.mark);
  if (byId("marks").checked && view.mark) drawMark(ctx, frame, view.mark);
  if (state.chosen && state.chosen.position === position) {
    const [cx, cy] = toCanvas(frame, state.chosen.u - 0.5, state.chosen.v - 0.5);
    const side = Math.max(frame.scale, 7), inset = (side - frame.scale) / 2;
    ctx.strokeStyle = colour("--pick");
    ctx.lineWidth = 2;
    ctx.strokeRect(cx - inset, cy - inset, side, side);
  }
}

// Code (R, G, B) of the picture's own pixel.
function codeAt(view, u, v) {
  const one = document.createElement("canvas");
  one.width = one.height = 1;
  const ctx = one.getContext("2d");
  ctx.drawImage(view.pictures[byId("laser").checked ? "on" : "off"], -u, -v);
  return [...ctx.getImageData(0, 0, 1, 1).data].slice(0, 3);
}

function choose(position, u, v) {
  state.chosen = { position, u, v, ...truthAt(position, u, v) };
  const view = data.views[position], chosen = state.chosen, values = chosen.values;
  const rows = [["image", position], ["pixel (u, v)", `${u}, ${v}`], ["object", chosen.name]];
  if (chosen.object !== null) {
    rows.push(["D", `${values.depth_m} m`], ["path", `${values.path_m} m`]);
    rows.push(["theta", `${(2 * valueAt(view, "phi_ray_rad", v * view.width + u) * DEGREES).toFixed(2)}°`]);
    rows.push(["azimuth", `${(valueAt(view, "azimuth_rad", v * view.width + u) * DEGREES).toFixed(2)}°`]);
    rows.push(["phi_ray", `${values.phi_ray_rad} rad`]);
    rows.push(["x, y, z", `${values.x_m}, ${values.y_m}, ${values.z_m} m`]);
  }
  rows.push(["R, G, B", codeAt(view, u, v).join(", ")]);
  rows.push(["spot layer", `${spotAt(view, u, v).toPrecision(3)} e⁻/s`]);
  const readout = byId("readout");
  readout.replaceChildren(...rows.map((row) => {
    const line = document.createElement("div");
    for (const text of row) line.appendChild(document.createElement("span")).textContent = text;
    return line;
  }));
  Object.assign(readout.dataset, { position, u, v, object: chosen.name, ...values, rgb: codeAt(view, u, v).join(",") });
  drawAll();
}

function drawAll() {
  drawView("down");
  drawView("up");
  drawRoom();
}

function followPictures() {
  for (const position of ["down", "up"]) {
    const view = data.views[position];
    const take = (event) => {
      const pixel = pixelAt(view, event.clientX, event.clientY);
      if (pixel) choose(position, ...pixel);
    };
    view.canvas.addEventListener("pointermove", take);
    view.canvas.addEventListener("pointerdown", take);
    view.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!step) return;
      event.preventDefault();
      const at = state.chosen && state.chosen.position === position ? state.chosen : middleOf(view);
      const u = Math.min(Math.max(at.u + step[0], 0), view.width - 1);
      choose(position, u, Math.min(Math.max(at.v + step[1], 0), view.height - 1));
    });
  }
}

function middleOf(view) {
  const [u, v] = view.mark || [view.width / 2, view.height / 2];
  return { u: Math.round(u), v: Math.round(v) };
}

// The page.

function writeTexts() {
  byId("title").textContent = `${data.dataset}: ${data.id}`;
  document.title = `${data.id}, phibench`;
  byId("facts").textContent = `D = ${data.depth_m.toFixed(6)} m, stroke h = ${data.stroke_m.toFixed(6)} m. ` +
    "MJPEG frames of draw 0, at the exposure that the camera chooses.";
  const table = byId("numbers");
  const row = (cells, tag) => {
    const line = table.insertRow();
    for (const text of cells) line.appendChild(document.createElement(tag)).textContent = text;
  };
  row(["centre of the light", "u (px)", "v (px)", "from the axis (px)", "phi_ray (rad)", "visible", "exposure (ms)"],
    "th");
  for (const position of ["down", "up"]) {
    const view = data.views[position];
    const numbers = view.mark ? view.mark.map((x) => x.toFixed(4)) : ["-", "-"];
    const phi = view.phi_ray_rad === null ? "-" : view.phi_ray_rad.toFixed(7);
    const apart = view.mark ? Math.hypot(view.mark[0] - view.axis[0], view.mark[1] - view.axis[1]).toFixed(4) : "-";
    row([position, ...numbers, apart, phi, view.visible ? "yes" : view.cause, (1e3 * view.exposure_s).toFixed(2)], "td");
    byId(`note-${position}`).textContent = view.visible ? "" : `spot not visible: ${view.cause}`;
  }
  const planes = Object.entries(data.views.down.planes).filter(([name]) => name !== "object_id");
  byId("steps").textContent = planes.map(([name, plane]) => `${name} ${plane.step.toPrecision(2)}`).join(", ");
}

// "#hover=down,640,359" puts the pointer there, also between centres, "&zoom=spot" enlarges, "&look=mirror" turns the room.
function followAddress() {
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (wanted.get("zoom") === "spot") state.zoom = "spot";
  if (wanted.get("look") === "mirror") lookAtMirror();
  for (const name of ["laser", "marks", "lines", "layers"]) {
    if (wanted.has(name)) byId(name).checked = wanted.get(name) === "1";
  }
  drawAll();
  const [position, u, v] = (wanted.get("hover") || "").split(",");
  const view = data.views[position];
  if (!view) return;
  const frame = frameOf(view), [x, y] = toCanvas(frame, Number(u), Number(v));
  const at = { clientX: frame.left + x, clientY: frame.top + y, bubbles: true };
  view.canvas.dispatchEvent(new PointerEvent("pointermove", at));
  const ratio = view.canvas.width / view.canvas.clientWidth, place = [x, y].map((value) => Math.floor(value * ratio));
  const drawn = view.canvas.getContext("2d").getImageData(...place, 1, 1).data; // what lies under the pointer
  byId("readout").dataset.drawn = [...drawn].slice(0, 3).join(",");
}

async function main() {
  await Promise.all([unpacked("down"), unpacked("up")]);
  writeTexts();
  followPictures();
  followRoom();
  markSides();
  lookAtRoom();
  for (const name of ["laser", "marks", "lines", "layers"]) byId(name).addEventListener("change", drawAll);
  byId("whole").addEventListener("click", () => { state.zoom = "whole"; drawAll(); });
  byId("near").addEventListener("click", () => { state.zoom = "spot"; drawAll(); });
  byId("far").addEventListener("click", () => { lookAtRoom(); drawRoom(); });
  byId("rig").addEventListener("click", () => { lookAtMirror(); drawRoom(); });
  window.addEventListener("resize", drawAll);
  window.addEventListener("hashchange", followAddress);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  followAddress();
  document.body.dataset.ready = "yes";
}

main().catch((error) => {
  document.body.dataset.ready = "no";
  byId("facts").textContent = `This page could not be drawn: ${error.message}`;
  console.error(error);
});
