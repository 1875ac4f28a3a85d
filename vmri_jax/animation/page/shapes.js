// Bodies as balls and solids, links as rods, springs as helices, and trails of bodies.

function ball(painter, center, radius, color) {
  const { camera } = painter, [x, y, depth] = camera.project(center), r = Math.max(1.2, (camera.scale * radius) / depth);
  painter.add(depth, (context) => {
    const shine = context.createRadialGradient(x - 0.34 * r, y - 0.42 * r, 0.03 * r, x - 0.12 * r, y - 0.16 * r, 1.2 * r);
    [[0, 0.8], [0.22, 0.35], [0.55, 0], [1, -0.5]].forEach(([at, shade]) => shine.addColorStop(at, painter.tone(color, shade, depth)));
    context.fillStyle = shine;
    disc(context, x, y, r);
  });
}

// Corners of a solid: its first point, plus weights times the vectors to the other three.
function cornersOf({ points, corners }, at) {
  const [center, ...others] = points.map(at), axes = others.map((p) => plus(p, center, -1));
  return corners.map((weights) => weights.reduce((p, w, k) => plus(p, axes[k], w), center));
}

// The faces of a convex solid whose outer side is turned to the eye, lit by the lamp.
function solid(painter, shape, at) {
  const { camera } = painter, lamp = unit(painter.data.lamp), color = shape.color ? rgb(shape.color) : painter.bodies[shape.points[0]];
  const corners = cornersOf(shape, at), places = corners.map((p) => camera.project(p));
  for (const face of shape.faces) {
    const [a, b, c] = face.map((i) => corners[i]), normal = unit(cross(plus(b, a, -1), plus(c, b, -1)));
    const middle = face.reduce((sum, i) => plus(sum, corners[i], 1 / face.length), [0, 0, 0]);
    if (dot(normal, plus(camera.eye, middle, -1)) <= 0) continue;
    const bright = [camera.right, camera.up, camera.back].reduce((sum, axis, k) => sum + dot(normal, axis) * lamp[k], 0);
    const depth = face.reduce((sum, i) => sum + places[i][2], 0) / face.length;
    painter.add(depth, (context) => {
      context.fillStyle = context.strokeStyle = painter.tone(color, -0.12 + (bright > 0 ? 0.5 : 0.35) * bright, depth);
      context.lineWidth = 0.7; // without it seams show between faces
      context.beginPath();
      outline(context, face.map((i) => places[i]), 0.02 * camera.distance);
      context.fill();
      context.stroke();
    });
  }
}

// Start and end of a joint between two balls, and its direction; null if the balls touch or an end lies within the other ball.
function joint({ span }, a, b, reachA, reachB) {
  const gap = plus(b, a, -1), length = Math.hypot(...gap);
  if (length <= Math.max(span * (reachA + reachB), reachA, reachB)) return null;
  const along = unit(gap);
  return [plus(a, along, span * reachA), plus(b, along, -span * reachB), along];
}

// A rod in pieces, each with a depth of its own, so that a rod may pass in front of one ball and behind another.
function rod(painter, a, b, reachA, reachB) {
  const ends = joint(painter.data, a, b, reachA, reachB);
  if (!ends) return;
  const { camera, data } = painter, [start, end] = ends, gap = plus(end, start, -1);
  const pieces = Math.min(12, Math.ceil((10 * Math.hypot(...gap)) / data.size) || 1);
  let last = camera.project(start);
  for (let i = 1; i <= pieces; i++) {
    const from = last, to = camera.project(plus(start, gap, i / pieces));
    last = to;
    painter.add((from[2] + to[2]) / 2, (context) => rodPiece(painter, context, from, to));
  }
}

function rodPiece(painter, context, from, to) {
  const { camera, data, colors } = painter, [dx, dy] = [to[0] - from[0], to[1] - from[1]], length = Math.hypot(dx, dy);
  if (length < 1e-6) return;
  const side = dy * data.lamp[0] + dx * data.lamp[1] > 0 ? 1 : -1; // towards the light
  const [nx, ny] = [(side * dy) / length, (-side * dx) / length], [ox, oy] = [(0.5 * dx) / length, (0.5 * dy) / length];
  const [w, v] = [from[2], to[2]].map((depth) => Math.max(0.8, (camera.scale * data.rod) / depth));
  const [x, y] = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2], depth = (from[2] + to[2]) / 2;
  const across = context.createLinearGradient(x + nx * w, y + ny * w, x - nx * w, y - ny * w);
  [[0, 0.1], [0.3, 0.5], [1, -0.45]].forEach(([at, shade]) => across.addColorStop(at, painter.tone(colors.rod, shade, depth)));
  context.fillStyle = across;
  const edge = ([x, y], along, across) => [x + across * nx + along * ox, y + across * ny + along * oy];
  context.beginPath();
  trace(context, [edge(from, -1, w), edge(to, 1, v), edge(to, 1, -v), edge(from, -1, -w)]); // pieces overlap by a pixel, without it seams show
  context.fill();
}

// A helix with straight ends, whose number of turns stays when it stretches.
function spring(painter, a, b, reachA, reachB, color, turns) {
  const ends = joint(painter.data, a, b, reachA, reachB);
  if (!ends) return;
  const { camera, data } = painter, [start, end, along] = ends, gap = plus(end, start, -1);
  const sideways = unit(cross(along, [0.36, 0.48, 0.8])), third = cross(along, sideways);
  const lamp = unit(data.lamp), [first, ...others] = data.helices[turns];
  const place = ([share, radius, cos, sin]) => {
    const radial = plus(plus([0, 0, 0], sideways, cos), third, sin);
    return [camera.project(plus(plus(start, gap, share), radial, data.coil * radius)), radial];
  };
  const piece = (from, to, shade) => {
    const depth = (from[2] + to[2]) / 2;
    painter.add(depth, (context) => {
      context.strokeStyle = painter.tone(color, shade, depth);
      context.lineWidth = Math.max(1.1, (2 * camera.scale * data.wire) / depth);
      stroke(context, [from, to]);
    });
  };
  let [last, radial] = place(first);
  piece(camera.project(start), last, 0);
  for (const row of others) {
    const from = last;
    [last, radial] = place(row);
    const bright = [camera.right, camera.up, camera.back].reduce((sum, axis, k) => sum + dot(radial, axis) * lamp[k], 0);
    piece(from, last, bright < 0 ? 0.42 * bright : 0.5 * bright);
  }
  piece(last, camera.project(end), 0);
}

// A trail that gets fainter and thinner into the past.
function drawTrail(painter, trail, i, now, radius) {
  const { camera } = painter, color = painter.bodies[i];
  let last = null;
  trail.forEach((positions, k) => {
    const point = positions.subarray(3 * i, 3 * i + 3), hidden = Math.hypot(...plus(point, now, -1)) < 0.9 * radius;
    const from = last, to = camera.project(point), age = 1 - (k + 1) / trail.length;
    last = to;
    if (!from || hidden) return;
    const depth = (from[2] + to[2]) / 2;
    painter.add(depth + 0.002 * camera.distance, (context) => {
      context.globalAlpha = 0.7 * (1 - age) ** 1.5;
      context.lineCap = "butt"; // round ends overlap and show as dots
      context.strokeStyle = painter.tone(color, 0, depth);
      context.lineWidth = 0.6 + 1.6 * (1 - age);
      stroke(context, [from, to]);
      context.globalAlpha = 1;
      context.lineCap = "round";
    });
  });
}
