"use strict";
// Draws the page of one sample; page_tools.js has what it shares with other pages.

// Planes.

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
    drawChosen(ctx, frame, state.chosen.u, state.chosen.v);
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
  writeReadout(rows, { position, u, v, object: chosen.name, ...values, rgb: codeAt(view, u, v).join(",") });
  drawAll();
}

function drawAll() {
  drawView("down");
  drawView("up");
  drawRoom();
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
  followPictures(["down", "up"]);
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
}

start(main);
