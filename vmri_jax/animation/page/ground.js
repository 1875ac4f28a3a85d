// Planes with a grid that fades outwards, shadows on planes that are turned upwards, and fixed spheres.

function drawPlane(painter, plane, positions) {
  const { context, camera, colors } = painter, near = 0.02 * camera.distance;
  if (plane.solid) {
    context.beginPath();
    outline(context, plane.corners.map((corner) => camera.project(corner)), near);
    context.fillStyle = painter.tone(colors.faint);
    context.globalAlpha = 0.45;
    context.fill();
  }
  context.strokeStyle = painter.tone(mix(colors.faint, colors.ink, 0.12));
  context.lineWidth = 1;
  for (let i = 0; i < plane.lines.length; i += 7) {
    const [from, to] = [i, i + 3].map((k) => camera.project(plane.lines.subarray(k, k + 3)));
    if (Math.min(from[2], to[2]) < near) continue;
    context.globalAlpha = plane.lines[i + 6];
    stroke(context, [from, to]);
  }
  context.globalAlpha = 1;
  if (plane.bears) shadows(painter, plane, positions);
}

// Foot of a point on the plane, straight below the point.
const dropped = ({ center, normal }, p) => plus(p, [0, 0, 1], dot(plus(center, p, -1), normal) / normal[2]);

// Shadows of joints, solids and balls, each kind in a single path: where they overlap they are no darker.
function shadows(painter, plane, positions) {
  const { context, camera, colors, data } = painter, { bodies, connections, spheres } = data, near = 0.02 * camera.distance;
  const at = (i) => positions.subarray(3 * i, 3 * i + 3);
  context.strokeStyle = context.fillStyle = painter.tone(colors.shadow);
  context.globalAlpha = 0.06 * painter.shade;
  context.lineWidth = Math.max(1, (2 * camera.scale * data.rod) / camera.distance);
  context.beginPath();
  for (const { body, other, point } of connections) {
    const [from, to] = [at(body), point ?? at(other)].map((p) => camera.project(dropped(plane, p)));
    if (Math.min(from[2], to[2]) < near) continue;
    trace(context, [from, to]);
  }
  context.stroke();
  context.beginPath();
  for (const shape of data.solids) {
    const corners = cornersOf(shape, at).map((p) => camera.project(dropped(plane, p)));
    const area = (face) => face.reduce((sum, i, k) => sum + cross(corners[face.at(k - 1)], corners[i])[2], 0);
    for (const face of shape.faces) if (area(face) < 0) outline(context, face.map((i) => corners[i]), near); // the upper ones cover the shadow
  }
  context.globalAlpha = 0.1 * painter.shade;
  context.fill("nonzero");
  const balls = [...bodies.map(({ radius, shown }, i) => ({ center: at(i), radius, shown })).filter(({ shown }) => shown === "ball"), ...spheres];
  const above = balls.map(({ center, radius }) => ({ center, radius, below: dropped(plane, center) })).filter(({ center, below }) => center[2] >= below[2]);
  context.globalAlpha = 0.026 * painter.shade;
  for (let grown = 0.7; grown < 1.5; grown += 0.1) { // a soft edge
    context.beginPath();
    for (const { below, radius } of above) outline(context, ring(painter, plane, below, grown * radius), near);
    context.fill();
  }
  context.globalAlpha = 1;
}

function ring(painter, { sides }, center, radius) {
  return Array.from({ length: 28 }, (_, k) => {
    const angle = (2 * Math.PI * k) / 28, [u, v] = [radius * Math.cos(angle), radius * Math.sin(angle)];
    return painter.camera.project(plus(plus(center, sides[0], u), sides[1], v));
  });
}

// Adds a polygon to the path, unless a corner lies behind the eye.
function outline(context, corners, near) {
  if (corners.some((corner) => corner[2] < near)) return;
  trace(context, corners);
  context.closePath();
}

function obstacle(painter, { center, radius }) {
  const { camera, colors } = painter, [x, y, depth] = camera.project(center), r = (camera.scale * radius) / depth;
  painter.add(depth, (context) => {
    const shine = context.createRadialGradient(x - 0.4 * r, y - 0.5 * r, 0.1 * r, x, y, r);
    [[0, 0.5], [0.5, 0.1], [1, -0.15]].forEach(([at, shade]) => shine.addColorStop(at, painter.tone(colors.faint, shade, depth)));
    context.fillStyle = shine;
    context.globalAlpha = 0.92;
    disc(context, x, y, r);
    context.globalAlpha = 1;
  });
}
