// Draws a picture of one moment, the farthest parts first.

const mix = (a, b, share) => a.map((x, k) => x + (b[k] - x) * share);
const rgb = (text) => [1, 3, 5].map((k) => parseInt(text.trim().slice(k, k + 2), 16));
const clamped = (x) => Math.min(1, Math.max(0, x));

// Adds a line through points to the path.
function trace(context, points) {
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
}

function stroke(context, points) {
  context.beginPath();
  trace(context, points);
  context.stroke();
}

function disc(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

// Gives a canvas a size in pixels of the page, and as many pixels of the screen; returns their ratio.
function sharpen(canvas, width, height) {
  const ratio = Math.min(3, window.devicePixelRatio || 1);
  [canvas.width, canvas.height] = [width * ratio, height * ratio].map(Math.round);
  canvas.getContext("2d").setTransform(ratio, 0, 0, ratio, 0, 0);
  return ratio;
}

class Painter {
  constructor(canvas, data) {
    Object.assign(this, { canvas, data, context: canvas.getContext("2d"), names: false });
    for (const plane of data.planes) plane.lines = decoded(plane.grid, Float32Array);
    this.recolor();
  }

  // Read the colours of the page again, after a switch between light and dark.
  recolor() {
    const style = getComputedStyle(document.documentElement);
    this.colors = {};
    for (const name of ["paper", "ink", "faint", "rod", "shadow", "slow", "fast"]) {
      this.colors[name] = rgb(style.getPropertyValue(`--${name}`));
    }
    this.bodies = this.data.bodies.map((body) => (body.color ? rgb(body.color) : this.colors[body.pace]));
    this.shade = this.colors.paper[0] < 100 ? 2 : 1; // shadows on dark paper have to be stronger
    this.tones = new Map();
  }

  resize(width, height) {
    Object.assign(this, { width, height });
    sharpen(this.canvas, width, height);
  }

  // A shade of a colour, -1 dark, 0 the colour, 1 light, faded into the paper with the distance from the eye.
  tone(color, shade = 0, depth = 0) {
    const { distance, radius } = this.camera;
    const fade = Math.round(10 * clamped((depth - distance + radius) / (2 * radius)));
    const level = Math.round(8 * shade), key = `${color},${level},${fade}`;
    let text = this.tones.get(key);
    if (text === undefined) {
      const lit = mix(color, level < 0 ? [12, 16, 20] : [255, 255, 255], Math.abs(level) / 8);
      text = `rgb(${mix(lit, this.colors.paper, 0.04 * fade).map(Math.round)})`;
      this.tones.set(key, text);
    }
    return text;
  }

  // Notes a part to draw, after all parts that are farther from the eye.
  add(depth, paint) {
    if (depth > 0.01 * this.camera.distance) this.items.push([depth, paint]);
  }

  // positions: x, y, z of all bodies; trail: such positions at earlier times, the oldest first.
  draw(camera, positions, trail) {
    const { data, context } = this, { bodies } = data;
    const at = (i) => positions.subarray(3 * i, 3 * i + 3);
    Object.assign(this, { camera, items: [] });
    context.clearRect(0, 0, this.width, this.height);
    context.lineCap = context.lineJoin = "round";
    for (const plane of data.planes) drawPlane(this, plane, positions);
    for (const sphere of data.spheres) obstacle(this, sphere);
    bodies.forEach((body, i) => body.shown === "ball" && drawTrail(this, trail, i, at(i), body.radius));
    for (const { kind, body, other, point, pace, turns } of data.connections) {
      const ends = [at(body), point ?? at(other), bodies[body].radius, point ? 0 : bodies[other].radius];
      if (kind === "link") rod(this, ...ends);
      else spring(this, ...ends, this.colors[pace], turns);
      if (point && Math.hypot(...plus(point, ends[0], -1)) > ends[2]) ball(this, point, 1.5 * data.rod, this.colors.rod); // else the ball of the body hides the point
    }
    bodies.forEach((body, i) => body.shown === "ball" && ball(this, at(i), body.radius, this.bodies[i]));
    data.solids.forEach((shape) => solid(this, shape, at));
    this.items.sort((a, b) => b[0] - a[0]);
    for (const item of this.items) item[1](context);
    if (this.names) bodies.forEach((body, i) => body.shown && label(this, at(i), body));
  }
}

function label(painter, center, body) {
  const { context, camera } = painter, [x, y, depth] = camera.project(center), r = (camera.scale * body.radius) / depth;
  context.font = "600 12px system-ui, sans-serif";
  context.lineWidth = 4;
  context.strokeStyle = painter.tone(painter.colors.paper);
  context.fillStyle = painter.tone(painter.colors.ink);
  context.strokeText(body.name, x + r + 5, y + 4);
  context.fillText(body.name, x + r + 5, y + 4);
}
