"use strict";
// Rig, rays and room. An orbit around a target; world z is up.

const orbit = { yaw: 0.9, pitch: 0.75, distance: 10, target: [0, 0, 1] };

function roomBox() {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const polygon of data.scene.polygons) {
    for (const point of polygon.p) {
      for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], point[k]); high[k] = Math.max(high[k], point[k]); }
    }
  }
  return { low, high };
}

function lookAtRoom() {
  const { low, high } = roomBox();
  orbit.target = low.map((value, k) => (value + high[k]) / 2);
  orbit.distance = 0.5 * Math.hypot(...low.map((value, k) => high[k] - value));
  Object.assign(orbit, { yaw: 0.9, pitch: 0.85 });
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((n) => [0, 1, 2].map((k) => ((n >> k) & 1 ? high : low)[k]));
  for (let step = 0; step < 60 && !allSeen(corners); step++) orbit.distance *= 1.05;
}

// World x to the right, world y upwards.
function lookFromAbove() {
  lookAtRoom();
  Object.assign(orbit, { yaw: -Math.PI / 2, pitch: 1.5 });
}

function allSeen(points) {
  const { wide, high, focal } = screen(byId("room")), { look } = camera();
  return points.map(look).every(([x, y, z]) =>
    z > NEAR && focal * Math.abs(x) < 0.48 * wide * z && focal * Math.abs(y) < 0.48 * high * z);
}

function screen(canvas) {
  const wide = canvas.clientWidth, high = canvas.clientHeight;
  return { wide, high, focal: 0.95 * Math.min(wide, high * 1.5) };
}

function lookAtMirror() {
  const rigs = data.scene.rigs;
  orbit.target = rigs[0].centre.map((value, k) => (value + rigs[1].centre[k]) / 2);
  orbit.distance = 1.2 + 1.9 * Math.abs(rigs[1].centre[2] - rigs[0].centre[2]);
  orbit.pitch = 0.12;
  const spot = data.scene.spot;
  if (spot) orbit.yaw = Math.atan2(spot[1] - orbit.target[1], spot[0] - orbit.target[0]) + Math.PI / 2;
}

// Eye coordinates (right, up, ahead) of a world point.
function camera() {
  const { yaw, pitch, distance, target } = orbit;
  const back = [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];
  const right = [-Math.sin(yaw), Math.cos(yaw), 0];
  const up = [-Math.sin(pitch) * Math.cos(yaw), -Math.sin(pitch) * Math.sin(yaw), Math.cos(pitch)];
  const eye = target.map((value, k) => value + distance * back[k]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const look = (point) => {
    const d = [point[0] - eye[0], point[1] - eye[1], point[2] - eye[2]];
    return [dot(d, right), dot(d, up), -dot(d, back)];
  };
  return { look, eye };
}

// Sides of the room's box, [axis, place, outwards], that hold a polygon as a whole: near walls and ceilings hide the rest.
function markSides() {
  const { low, high } = roomBox(), reach = 0.25;
  const sides = [0, 1, 2].flatMap((axis) => [[axis, low[axis], -1], [axis, high[axis], 1]]);
  for (const polygon of data.scene.polygons) {
    polygon.sides = sides.filter(([axis, place]) => polygon.p.every((point) => Math.abs(point[axis] - place) < reach));
  }
}

const NEAR = 0.02;

function clipped(points, closed) {
  const result = [], count = points.length;
  for (let k = 0; k < (closed ? count : count - 1); k++) {
    const a = points[k], b = points[(k + 1) % count];
    if (a[2] >= NEAR) result.push(a);
    if ((a[2] < NEAR) !== (b[2] < NEAR)) {
      const t = (NEAR - a[2]) / (b[2] - a[2]);
      result.push([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), NEAR]);
    }
    if (!closed && k === count - 2 && b[2] >= NEAR) result.push(b);
  }
  return result;
}

function trace(ctx, flat, points, closed) {
  const seen = clipped(points, closed);
  if (seen.length < 2) return false;
  ctx.beginPath();
  seen.forEach((point, k) => { const [x, y] = flat(point); if (k) ctx.lineTo(x, y); else ctx.moveTo(x, y); });
  if (closed) ctx.closePath();
  return true;
}

function facing(points) {
  const [a, b, c] = points;
  const p = [b[0] - a[0], b[1] - a[1], b[2] - a[2]], q = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
  const n = [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
  // eye coordinates (right, up, ahead) are left-handed: the outward normal comes out reversed
  return { towards: n[0] * a[0] + n[1] * a[1] + n[2] * a[2], upright: Math.abs(n[1]) / (Math.hypot(...n) || 1) };
}

function drawRoom() {
  const canvas = byId("room"), ctx = context(canvas), { look, eye } = camera();
  const { wide, high, focal } = screen(canvas);
  const flat = (p) => [wide / 2 + focal * p[0] / p[2], high / 2 - focal * p[1] / p[2]];
  const chosen = state.chosen && state.chosen.object;
  const seen = [];
  data.scene.polygons.forEach((polygon, place) => {
    if (polygon.sides.some(([axis, at, outwards]) => (eye[axis] - at) * outwards > 0)) return;
    const points = polygon.p.map(look), face = facing(points);
    if (face.towards <= 0 && !polygon.both) return;
    const distance = points.reduce((sum, p) => sum + Math.hypot(...p), 0) / points.length;
    seen.push({ polygon, points, face, order: polygon.front ? [0, place] : [1, -distance] });
  });
  seen.sort((a, b) => a.order[0] - b.order[0] || a.order[1] - b.order[1]);
  for (const { polygon, points, face } of seen) {
    if (!trace(ctx, flat, points, true)) continue;
    const shade = 0.72 + 0.28 * face.upright;
    ctx.fillStyle = `rgb(${polygon.rgb.map((c) => Math.round(c * shade)).join(" ")})`;
    ctx.fill();
    const isChosen = polygon.id === chosen;
    ctx.strokeStyle = isChosen ? colour("--pick") : "#0005";
    ctx.lineWidth = isChosen ? 2 : 0.6;
    ctx.stroke();
  }
  drawRigs(ctx, look, flat, focal);
}

function drawRigs(ctx, look, flat, focal) {
  const path = (points, style, width, dash = []) => {
    ctx.setLineDash(dash);
    if (trace(ctx, flat, points.map(look), false)) {
      ctx.strokeStyle = "#000a"; ctx.lineWidth = width + 1.6; ctx.stroke();
      ctx.strokeStyle = style; ctx.lineWidth = width; ctx.stroke();
    }
    ctx.setLineDash([]);
  };
  const dot = (point, radius, style) => {
    const p = look(point);
    if (p[2] < NEAR) return;
    ctx.beginPath(); ctx.arc(...flat(p), radius, 0, 7); ctx.fillStyle = style; ctx.fill();
    ctx.strokeStyle = "#000a"; ctx.lineWidth = 1; ctx.stroke();
  };
  for (const rig of data.scene.rigs) {
    const centre = look(rig.centre);
    if (rig.radius_m && centre[2] > NEAR) { // outline of a sphere, as a circle
      const radius = focal * rig.radius_m / Math.sqrt(Math.max(centre[2] ** 2 - rig.radius_m ** 2, 1e-9));
      const [x, y] = flat(centre), shine = ctx.createRadialGradient(x - radius / 3, y - radius / 3, 0, x, y, radius);
      shine.addColorStop(0, "#fffe"); shine.addColorStop(1, "#7d8894dd");
      ctx.beginPath(); ctx.arc(x, y, Math.max(radius, 1.5), 0, 7);
      ctx.fillStyle = shine; ctx.fill(); ctx.strokeStyle = "#000a"; ctx.lineWidth = 1; ctx.stroke();
    }
    for (const line of rig.mirror) path(line, "#9aa7b4", 1);
  }
  const spot = data.scene.spot, axis = data.scene.rigs[0].centre;
  if (spot) path([[axis[0], axis[1], spot[2]], spot], colour("--mark"), 1.4, [6, 4]);
  for (const rig of data.scene.rigs) {
    if (rig.chief_ray.length) path(rig.chief_ray, colour("--ray"), rig.visible ? 1.8 : 1, rig.visible ? [] : [2, 4]);
    dot(rig.lens, 2.5, "#30363d");
  }
  const chosen = state.chosen;
  if (chosen && chosen.object !== null) {
    const rig = data.scene.rigs.find((r) => r.position === chosen.position);
    const hit = ["x_m", "y_m", "z_m"].map((name) => Number(chosen.values[name]));
    path([rig.lens, reflectionAt(chosen) || rig.centre, hit], colour("--pick"), 1.8);
    dot(hit, 4, colour("--pick"));
    if (chosen.answer) drawAnswer(ctx, look(chosen.answer), flat);
  }
  if (!spot) return;
  dot(spot, 4.5, colour("--ray"));
  const label = look([(axis[0] + spot[0]) / 2, (axis[1] + spot[1]) / 2, spot[2]]);
  ctx.font = "13px system-ui, sans-serif";
  if (label[2] > NEAR) {
    const [x, y] = flat(label); // below the rays, which come from above
    haloed(ctx, `D = ${data.depth_m.toFixed(3)} m`, x - 20, y + 24, "#fff");
  }
}

// A ring where an answer puts the chosen point: another shape than the truth's dot, for eyes that see no colours.
function drawAnswer(ctx, point, flat) {
  if (point[2] < NEAR) return;
  for (const [style, width] of [["#000b", 5], [colour("--curve"), 2.4]]) {
    ctx.beginPath(); ctx.arc(...flat(point), 8, 0, 7); ctx.strokeStyle = style; ctx.lineWidth = width; ctx.stroke();
  }
}

// Reflection point between the four of the grid around a pixel; the nearest where the mirror ends.
function reflectionAt({ position, u, v }) {
  const grid = data.views[position].reflection, rows = grid.points.length / grid.columns;
  const x = Math.min(u / grid.every_px, grid.columns - 1.001), y = Math.min(v / grid.every_px, rows - 1.001);
  const corners = [[0, 0], [1, 0], [0, 1], [1, 1]].map(([a, b]) => {
    const i = Math.floor(x) + a, j = Math.floor(y) + b;
    return { point: grid.points[j * grid.columns + i], weight: (1 - Math.abs(x - i)) * (1 - Math.abs(y - j)) };
  });
  const there = corners.filter((corner) => corner.point);
  if (there.length < 4) return there.sort((a, b) => b.weight - a.weight)[0]?.point;
  return [0, 1, 2].map((k) => there.reduce((sum, corner) => sum + corner.weight * corner.point[k], 0));
}

function followRoom() {
  const canvas = byId("room"), held = new Map();
  const zoom = (factor) => { orbit.distance = Math.min(Math.max(orbit.distance * factor, 0.25), 300); drawRoom(); };
  const turn = (dx, dy) => {
    orbit.yaw -= dx;
    orbit.pitch = Math.min(Math.max(orbit.pitch + dy, -1.5), 1.5);
    drawRoom();
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const now = [event.clientX, event.clientY];
    if (held.size === 1) {
      turn((now[0] - last[0]) * 0.008, (now[1] - last[1]) * 0.008);
    } else {
      const other = [...held].find(([id]) => id !== event.pointerId)[1];
      zoom(Math.hypot(last[0] - other[0], last[1] - other[1]) / (Math.hypot(now[0] - other[0], now[1] - other[1]) || 1));
    }
    held.set(event.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(event.deltaY * 0.001)); },
    { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (step) { event.preventDefault(); turn(...step); }
    if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 0.85 : 1 / 0.85);
  });
}
