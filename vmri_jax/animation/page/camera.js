// A perspective view that turns about a target: z points upwards.

const FIELD = 1 / Math.tan(Math.PI / 12); // cotangent of half the angle of view, 15 degrees

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const unit = (a) => plus([0, 0, 0], a, 1 / (Math.hypot(...a) || 1));

class Camera {
  constructor(view) {
    this.start = view;
    this.reset();
  }

  reset() {
    Object.assign(this, { azimuth: this.start.azimuth, elevation: this.start.elevation, moved: false });
    this.target = [0, 0, 0];
    this.distance = 1;
  }

  // Sets the size of the view in pixels; called before `project`.
  aim(width, height) {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
    this.back = [ce * ca, ce * sa, se];
    this.right = [-sa, ca, 0];
    this.up = cross(this.back, this.right);
    this.eye = plus(this.target, this.back, this.distance);
    this.scale = (FIELD * height) / 2;
    this.center = [width / 2, height / 2];
    this.aspect = width / height;
  }

  // Pixels x and y, and the depth: distance from the eye along the axis of the view.
  project(p) {
    const x = p[0] - this.eye[0], y = p[1] - this.eye[1], z = p[2] - this.eye[2];
    const depth = -(x * this.back[0] + y * this.back[1] + z * this.back[2]);
    const s = this.scale / Math.max(depth, 1e-3 * this.distance);
    return [
      this.center[0] + s * (x * this.right[0] + y * this.right[1] + z * this.right[2]),
      this.center[1] - s * (x * this.up[0] + y * this.up[1] + z * this.up[2]),
      depth,
    ];
  }

  // Chooses target and distance so that the view has all points, with a margin, below the title that covers its top.
  fit(points, radius, width, height, covered) {
    const low = [0, 1, 2].map((k) => points.reduce((least, p) => Math.min(least, p[k]), Infinity));
    const high = [0, 1, 2].map((k) => points.reduce((most, p) => Math.max(most, p[k]), -Infinity));
    this.target = low.map((x, k) => (x + high[k]) / 2);
    this.radius = Math.hypot(...plus(high, low, -1)) / 2 + radius;
    this.distance = 4 * this.radius;
    for (let pass = 0; pass < 12; pass++) {
      this.aim(width, height);
      let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
      for (const p of points) {
        const [x, y, depth] = this.project(p), r = (this.scale * radius) / depth;
        left = Math.min(left, x - r), right = Math.max(right, x + r);
        top = Math.min(top, y - r), bottom = Math.max(bottom, y + r);
      }
      const per = this.distance / this.scale;
      this.target = plus(this.target, this.right, ((left + right) / 2 - this.center[0]) * per);
      this.target = plus(this.target, this.up, (this.center[1] + covered / 2 - (top + bottom) / 2) * per);
      this.distance *= Math.max((right - left) / (0.86 * width), (bottom - top) / (0.88 * (height - covered)));
    }
    this.aim(width, height);
  }

  turn(x, y) {
    this.azimuth -= x;
    this.elevation = Math.min(1.5, Math.max(-1.5, this.elevation + y));
    this.moved = true;
  }

  zoom(factor) {
    this.distance = Math.min(100 * this.radius, Math.max(0.05 * this.radius, this.distance * factor));
    this.moved = true;
  }

  shift(x, y) {
    const per = this.distance / this.scale;
    this.target = plus(plus(this.target, this.right, -x * per), this.up, y * per);
    this.moved = true;
  }
}

// Mouse and touch: one finger turns, two zoom and shift, as do the wheel and the right or shifted drag.
function handle(canvas, camera, changed, home) {
  const fingers = new Map();
  const middle = () => {
    const all = [...fingers.values()], sum = all.reduce((s, p) => [s[0] + p[0], s[1] + p[1]], [0, 0]);
    const gap = all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0;
    return [sum[0] / all.length, sum[1] / all.length, gap];
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = middle();
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = middle(), [x, y] = [after[0] - before[0], after[1] - before[1]];
    if (fingers.size > 1) {
      camera.zoom(before[2] / Math.max(1, after[2]));
      camera.shift(x, y);
    } else if (event.shiftKey || event.buttons === 2) camera.shift(x, y);
    else camera.turn(0.008 * x, 0.008 * y);
    changed();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(0.0015 * event.deltaY));
    changed();
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", home);
}
