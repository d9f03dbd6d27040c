"use strict";
// Draws the page of a dense answer; page_tools.js has what it shares with the page of a sample.

const NONE = 65535; // code of a value that is not there
const PANORAMAS = {
  image: "Down image, unrolled",
  depth: `D by ${data.method}`,
  error: "Error of D, where both images show the point",
  cause: "Where the up image shows the same point",
};
const down = data.views.down, grid = data.grid;

async function unpackedAll() {
  for (const position of ["down", "up"]) {
    const view = data.views[position];
    [view.shown, view.canvas] = [await image(view.picture), byId(position)];
  }
  for (const plane of Object.values(down.planes)) plane.codes = await codes(plane.data, down.width, down.height);
  for (const name of ["u", "v"]) grid[name] = await codes(grid[name], grid.width, grid.height);
}

// Value of a plane at a pixel, or null.
function known(name, index) {
  const plane = down.planes[name];
  if (plane.codes[index] === NONE) return null;
  const value = valueAt(down, name, index);
  return plane.log ? Math.exp(value) : value;
}

function relativeError(index) {
  const [given, truth] = [known("answer_m", index), known("depth_m", index)];
  return given === null || truth === null || known("group", index) !== 0 ? null : given / truth - 1;
}

// Colours.

function onScale(colours, part) {
  const place = Math.min(Math.max(part, 0), 1) * (colours.length - 1);
  const k = Math.min(Math.floor(place), colours.length - 2);
  return [0, 1, 2].map((c) => Math.round(colours[k][c] + (place - k) * (colours[k + 1][c] - colours[k][c])));
}

const [NEAREST_M, FARTHEST_M] = data.scales.depth_m;
const depthPart = (d) => Math.log(d / NEAREST_M) / Math.log(FARTHEST_M / NEAREST_M);
const errorPart = (e) => 0.5 + 0.5 * e / data.scales.error;
const UNKNOWN = [150, 150, 150]; // grey is on none of the scales

function colourOf(name, index, pixels) {
  if (name === "image") return pixels.subarray(4 * index, 4 * index + 3);
  if (name === "cause") return data.scales.of_causes[known("group", index)];
  const value = name === "depth" ? known("answer_m", index) : relativeError(index);
  if (value === null) return UNKNOWN;
  if (name === "depth") return onScale(data.scales.of_depth, depthPart(value));
  return onScale(data.scales.of_error, errorPart(value));
}

// Panoramas, drawn once, at a pixel per direction.
function drawnPanorama(name, pixels) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [grid.width, grid.height];
  const ctx = canvas.getContext("2d"), picture = ctx.createImageData(grid.width, grid.height);
  for (let k = 0; k < grid.u.length; k++) {
    picture.data.set(colourOf(name, grid.v[k] * down.width + grid.u[k], pixels), 4 * k);
    picture.data[4 * k + 3] = 255;
  }
  ctx.putImageData(picture, 0, 0);
  return canvas;
}

function pixelsOf(picture) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [down.width, down.height];
  const ctx = canvas.getContext("2d");
  ctx.drawImage(picture, 0, 0, down.width, down.height);
  return ctx.getImageData(0, 0, down.width, down.height).data;
}

const panoramas = {};

function makePanoramas() {
  const pixels = pixelsOf(down.shown), holder = byId("panoramas");
  holder.style.cssText = "display: grid; gap: 10px; margin: 8px 0; " +
    "grid-template-columns: repeat(auto-fit, minmax(min(100%, 520px), 1fr))";
  for (const [name, title] of Object.entries(PANORAMAS)) {
    const figure = holder.appendChild(document.createElement("figure"));
    const caption = figure.appendChild(document.createElement("figcaption"));
    caption.appendChild(document.createElement("b")).textContent = title;
    addKey(name, caption);
    const canvas = figure.appendChild(document.createElement("canvas"));
    Object.assign(canvas, { className: "picture", id: `panorama-${name}`, tabIndex: 0 });
    canvas.setAttribute("aria-label", `${title}. Arrow keys move the chosen pixel.`);
    canvas.style.aspectRatio = `${grid.width} / ${grid.height}`;
    // a view as page_tools.js has them: [column, row] in place of [u, v]
    panoramas[name] = { width: grid.width, height: grid.height, canvas, shown: drawnPanorama(name, pixels) };
    followPanorama(panoramas[name]);
  }
}

function addKey(name, caption) {
  const key = caption.appendChild(document.createElement("span"));
  key.className = "soft";
  if (name === "cause") {
    data.groups.forEach((text, k) => {
      const swatch = key.appendChild(document.createElement("span"));
      swatch.className = "swatch";
      swatch.style.background = `rgb(${data.scales.of_causes[k].join(" ")})`;
      key.append(` ${text} \u00a0`);
    });
  } else if (name !== "image") {
    const canvas = key.appendChild(document.createElement("canvas"));
    canvas.className = "scale";
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", name === "depth" ? "D from near to far" : "red is too near, blue too far");
    panoramas[`key-${name}`] = canvas;
  }
}

function drawScale(name) {
  const canvas = panoramas[`key-${name}`], ctx = context(canvas), wide = canvas.clientWidth;
  const colours = name === "depth" ? data.scales.of_depth : data.scales.of_error, e = data.scales.error;
  const left = 0.16 * wide, span = 0.68 * wide;
  for (let x = 0; x < span; x++) {
    ctx.fillStyle = `rgb(${onScale(colours, x / span).join(" ")})`;
    ctx.fillRect(left + x, 0, 1.5, 9);
  }
  ctx.fillStyle = colour("--soft");
  ctx.font = "11px system-ui, sans-serif";
  ctx.textAlign = "center";
  const ticks = name === "depth" ? [0.5, 1, 2, 5, 10].map((d) => [depthPart(d), d < 10 ? String(d) : `${d} m`])
    : [[0, `${-100 * e} %, near`], [0.5, "0"], [1, `+${100 * e} %, far`]];
  for (const [part, text] of ticks) ctx.fillText(text, left + part * span, 21);
}

function drawPanorama(view) {
  const ctx = context(view.canvas), frame = panoramaFrame(view);
  ctx.imageSmoothingEnabled = false;
  ctx.drawImage(view.shown, 0, 0, frame.wide, frame.high);
  const cell = state.chosen && state.chosen.cell;
  if (!cell) return;
  const [x, y] = [(cell[0] + 0.5) * frame.scale, (cell[1] + 0.5) * frame.scale];
  for (const [style, width] of [["#fff", 4], [colour("--pick"), 2]]) {
    ctx.strokeStyle = style;
    ctx.lineWidth = width;
    ctx.strokeRect(x - 5, y - 5, 10, 10);
  }
}

function panoramaFrame(view) {
  const box = view.canvas.getBoundingClientRect();
  const wide = view.canvas.clientWidth, high = view.canvas.clientHeight;
  const left = box.left + view.canvas.clientLeft, top = box.top + view.canvas.clientTop;
  return { scale: wide / view.width, x0: 0, y0: 0, left, top, wide, high };
}

function followPanorama(view) {
  const take = (event) => {
    const { left, top, scale } = panoramaFrame(view);
    chooseCell(Math.floor((event.clientX - left) / scale), Math.floor((event.clientY - top) / scale));
  };
  view.canvas.addEventListener("pointermove", take);
  view.canvas.addEventListener("pointerdown", take);
  view.canvas.addEventListener("keydown", (event) => {
    const step = arrowOf(event);
    if (!step) return;
    const [column, row] = (state.chosen && state.chosen.cell) || [grid.width >> 1, grid.height >> 1];
    chooseCell((column + step[0] + grid.width) % grid.width, row + step[1]);
  });
}

function chooseCell(column, row) {
  if (column < 0 || row < 0 || column >= grid.width || row >= grid.height) return;
  const k = row * grid.width + column;
  state.anchor = [grid.u[k], grid.v[k]];
  choose("down", ...state.anchor, [column, row]);
}

// Direction of the panoramas whose pixel is nearest; null beside the mirror.
function cellOf(u, v) {
  let best = 9, found = null; // three pixels away at most
  for (let k = 0; k < grid.u.length; k++) {
    const away = (grid.u[k] - u) ** 2 + (grid.v[k] - v) ** 2;
    if (away < best) [best, found] = [away, k];
  }
  return found === null ? null : [found % grid.width, Math.floor(found / grid.width)];
}

// Images.

function drawView(position) {
  const view = data.views[position], chosen = state.chosen;
  view.canvas.style.aspectRatio = `${view.width} / ${view.height}`;
  // the enlarged down image stays where it is while the pointer moves over it
  view.mark = !chosen ? null : position === "down" ? state.anchor : chosen.place || chosen.given;
  const ctx = context(view.canvas), frame = frameOf(view);
  ctx.imageSmoothingEnabled = frame.scale < 2;
  const [x, y] = toCanvas(frame, -0.5, -0.5);
  ctx.drawImage(view.shown, x, y, view.width * frame.scale, view.height * frame.scale);
  if (!chosen) return;
  if (position === "down") { drawChosen(ctx, frame, chosen.u, chosen.v); return; }
  if (chosen.place) drawMark(ctx, frame, chosen.place);
  if (chosen.given) {
    for (const [style, width] of [["#000b", 4], [colour("--curve"), 2]]) {
      ctx.beginPath();
      ctx.arc(...toCanvas(frame, ...chosen.given), Math.max(6, frame.scale), 0, 7);
      ctx.strokeStyle = style;
      ctx.lineWidth = width;
      ctx.stroke();
    }
  }
}

function pointAt(index, names) {
  const values = names.map((name) => known(name, index));
  return values.includes(null) ? null : values;
}

// Point of the answered D on the way from the mirror to the true point, prolonged; null where there is none.
function answeredPoint(chosen, depth) {
  const start = reflectionAt(chosen), end = ["x_m", "y_m", "z_m"].map((name) => chosen.values[name]);
  if (!start || depth === null) return null;
  const axis = data.scene.rigs[0].centre, way = end.map((value, k) => value - start[k]);
  const from = [start[0] - axis[0], start[1] - axis[1]];
  const a = way[0] ** 2 + way[1] ** 2, b = from[0] * way[0] + from[1] * way[1];
  const c = from[0] ** 2 + from[1] ** 2 - depth ** 2;
  const t = (-b + Math.sqrt(Math.max(b * b - a * c, 0))) / a;
  return a > 0 ? start.map((value, k) => value + t * way[k]) : null;
}

const metres = (value) => (value === null ? "not known" : `${value.toFixed(3)} m`);
const placeText = (uv) => (uv === null ? "not there" : `${uv[0].toFixed(2)}, ${uv[1].toFixed(2)}`);
const length = (value) => (value < 0.0995 ? `${(1e3 * value).toPrecision(2)} mm` : `${value.toFixed(2)} m`);
const sigma = (value, depth) => `${length(value)}, ` +
  (value > 0.5 * depth ? "no texture" : `${(100 * value / depth).toPrecision(2)} %`);

function errorWords(error, metresOff) {
  const size = `${Math.abs(100 * error).toFixed(2)} %, ${(1e3 * Math.abs(metresOff)).toFixed(0)} mm`;
  return error === 0 ? "0" : `${size} too ${error > 0 ? "far" : "near"}`;
}

function choose(position, u, v, cell = null) {
  const index = v * down.width + u, object = known("object_id", index);
  const values = Object.fromEntries(Object.keys(down.planes).map((name) => [name, known(name, index)]));
  const chosen = { position: "down", u, v, object, values, cell: cell || cellOf(u, v) };
  chosen.place = pointAt(index, ["up_u_px", "up_v_px"]);
  chosen.given = pointAt(index, ["answer_u_px", "answer_v_px"]);
  chosen.answer = object === null ? null : answeredPoint(chosen, values.answer_m);
  state.chosen = chosen;
  const cause = data.causes[values.cause], error = relativeError(index);
  const name = object === null ? "nothing" : data.objects[object];
  const rows = [[cause, ""], ["pixel (u, v), down", `${u}, ${v}`], ["it shows", name]];
  if (values.depth_m !== null) rows.push(["D, true", metres(values.depth_m)]);
  rows.push(["D, answered", metres(values.answer_m)]);
  if (error !== null) rows.push(["error", errorWords(error, values.answer_m - values.depth_m)]);
  rows.push(["true place, up", placeText(chosen.place)], ["answered place, up", placeText(chosen.given)]);
  if (chosen.place && chosen.given) {
    const off = Math.hypot(chosen.place[0] - chosen.given[0], chosen.place[1] - chosen.given[1]);
    rows.push(["apart", `${off.toFixed(2)} px`]);
  }
  if (values.sigma_m !== null) rows.push(["sigma claimed", sigma(values.sigma_m, values.answer_m)]);
  if (values.bound_m !== null) rows.push(["least sigma possible", sigma(values.bound_m, values.depth_m)]);
  writeReadout(rows, { ...values, u, v, cause, object: name, error: error === null ? "" : error, cell: chosen.cell || "" });
  byId("readout").firstChild.className = "whole";
  byId("note-up").textContent = values.cause !== null && known("group", index) === 0 ? "" : cause;
  drawAll();
}

function drawAll() {
  drawView("down");
  drawView("up");
  for (const name of Object.keys(PANORAMAS)) drawPanorama(panoramas[name]);
  drawScale("depth");
  drawScale("error");
  drawRoom();
}

// The page.

function writeTexts() {
  byId("title").textContent = `${data.dataset}: ${data.id}, dense depth by ${data.method}`;
  document.title = `${data.id}, ${data.method}, phibench`;
  const median = data.median === null ? "" : `, median error ${(100 * data.median).toFixed(2)} %`;
  byId("facts").textContent = `Stroke h = ${data.stroke_m.toFixed(3)} m, ${data.preset}. Of the pixels that both images ` +
    `show, ${(100 * data.answered).toFixed(1)} % are answered${median}.`;
  const planes = Object.entries(down.planes).filter(([name]) => !["object_id", "cause", "group"].includes(name));
  byId("steps").textContent = planes.map(([name, plane]) =>
    `${name} ${plane.step.toPrecision(2)}${plane.log ? " of its logarithm" : ""}`).join(", ");
}

function zoomIn() {
  if (!state.chosen) return;
  Object.assign(state, { zoom: "spot", anchor: [state.chosen.u, state.chosen.v] });
  drawAll();
}

// "#hover=down,640,359" puts the pointer there, "#hover=depth,360,80" over a panorama, "&zoom=near" enlarges.
function followAddress() {
  const wanted = new URLSearchParams(location.hash.slice(1));
  drawAll();
  const [name, u, v] = (wanted.get("hover") || "").split(",");
  const view = name === "down" ? down : panoramas[name];
  if (!view) return;
  const frame = name === "down" ? frameOf(view) : panoramaFrame(view);
  const [x, y] = toCanvas(frame, Number(u), Number(v));
  const at = { clientX: frame.left + x, clientY: frame.top + y, bubbles: true };
  view.canvas.dispatchEvent(new PointerEvent("pointermove", at));
  if (wanted.get("zoom") === "near") zoomIn();
  if (name === "down") return;
  const drawn = view.shown.getContext("2d").getImageData(Number(u), Number(v), 1, 1).data;
  byId("readout").dataset.drawn = [...drawn].slice(0, 3).join(",");
}

async function main() {
  await unpackedAll();
  writeTexts();
  makePanoramas();
  followPictures(["down"]);
  followRoom();
  markSides();
  lookFromAbove();
  const look = (name, turn) => byId(name).addEventListener("click", () => { turn(); drawRoom(); });
  look("above", lookFromAbove);
  look("far", lookAtRoom);
  look("rig", lookAtMirror);
  byId("whole").addEventListener("click", () => { state.zoom = "whole"; drawAll(); });
  byId("near").addEventListener("click", zoomIn);
  window.addEventListener("resize", drawAll);
  window.addEventListener("hashchange", followAddress);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  followAddress();
}

start(main);
