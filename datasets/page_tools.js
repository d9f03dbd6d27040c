"use strict";
// Shared by the pages of a sample and of a dense answer. A page of its own defines drawAll() and choose(position, u, v).
// Image coordinates: pixel (u, v) has its centre at integers, so that it covers [u - 0.5, u + 0.5]; "corner"
// coordinates below are u + 0.5, counted from the image's upper left corner.

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

// Decimals of a step: 1e-3 -> 3, 2.5e-5 -> 6.
function decimals(step) {
  for (let n = 0; n < 12; n++) if (Math.abs(step * 10 ** n - Math.round(step * 10 ** n)) < 1e-6) return n;
  return 12;
}

function valueAt(view, name, index) {
  const plane = view.planes[name];
  return plane.offset + plane.step * plane.codes[index];
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

// Square around the chosen pixel, never smaller than 7 px of the page.
function drawChosen(ctx, frame, u, v) {
  const [cx, cy] = toCanvas(frame, u - 0.5, v - 0.5);
  const side = Math.max(frame.scale, 7), inset = (side - frame.scale) / 2;
  ctx.strokeStyle = colour("--pick");
  ctx.lineWidth = 2;
  ctx.strokeRect(cx - inset, cy - inset, side, side);
}

// Step of an arrow key, which then does not scroll; undefined for other keys.
function arrowOf(event) {
  const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (step) event.preventDefault();
  return step;
}

// Let pointer and arrow keys choose pixels of these images.
function followPictures(positions) {
  for (const position of positions) {
    const view = data.views[position];
    const take = (event) => {
      const pixel = pixelAt(view, event.clientX, event.clientY);
      if (pixel) choose(position, ...pixel);
    };
    view.canvas.addEventListener("pointermove", take);
    view.canvas.addEventListener("pointerdown", take);
    view.canvas.addEventListener("keydown", (event) => {
      const step = arrowOf(event);
      if (!step) return;
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

// Words.

// Lines "name: value" of the box below the pictures, and what tests read there.
function writeReadout(rows, facts) {
  const readout = byId("readout");
  readout.replaceChildren(...rows.map((row) => {
    const line = document.createElement("div");
    for (const text of row) line.appendChild(document.createElement("span")).textContent = text;
    return line;
  }));
  Object.assign(readout.dataset, facts);
}

// Draw the page, or say why it could not be.
function start(main) {
  main().then(() => { document.body.dataset.ready = "yes"; }).catch((error) => {
    document.body.dataset.ready = "no";
    byId("facts").textContent = `This page could not be drawn: ${error.message}`;
    console.error(error);
  });
}
