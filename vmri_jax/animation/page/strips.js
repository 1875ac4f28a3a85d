// Curves against time under the view, with a cursor at the time of the picture.

// A power of ten as the page shows it: 1.2 × 10 with a raised exponent.
function shown(x) {
  if (!Number.isFinite(x)) return "not finite";
  if (x === 0) return "0";
  if (Math.abs(x) >= 0.01 && Math.abs(x) < 1000) return x.toPrecision(3).replace("-", "−");
  const [digits, power] = x.toExponential(1).split("e"), raised = power.replace("+", "").replace(/./g, (c) => "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"["0123456789-".indexOf(c)]);
  return `${digits.replace("-", "−")} × 10${raised}`;
}

// Round-off of numbers of order one: the lowest value of logarithmic curves.
const FLOOR = 1e-17;

class Strip {
  // curves: [name, values at the nodes, colour]; logarithmic: zeros are drawn at FLOOR.
  constructor(canvas, text, title, motion, curves, logarithmic) {
    Object.assign(this, { canvas, text, title, motion, curves, logarithmic, still: document.createElement("canvas") });
    this.largest = curves.map(([, values]) => values.reduce((most, x) => Math.max(most, Math.abs(x)), 0));
  }

  // Draws the curves once for each size and theme, on a second canvas.
  resize(colors, inset) {
    const { canvas, still, curves, motion } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const [ratio] = [canvas, still].map((surface) => sharpen(surface, width, height));
    Object.assign(this, { width, height, inset, colors, ratio });
    const context = still.getContext("2d"), scaled = this.range();
    context.lineJoin = "round";
    if (!this.logarithmic) this.line(context, [[inset, scaled(0)], [width - inset, scaled(0)]], "faint", 1);
    for (const [, values, color] of curves) {
      const dense = values.length > 2 * width;
      let piece = [];
      for (let i = 0; i <= values.length; i++) {
        const y = i < values.length ? scaled(values[i]) : NaN;
        if (Number.isFinite(y)) piece.push([this.x(motion.t[i]), y]);
        else this.line(context, piece, color, dense ? 0.8 : 1.3), (piece = []);
      }
    }
  }

  // From a value to its height in pixels.
  range() {
    const size = (x) => (this.logarithmic ? Math.log10(Math.max(x, FLOOR)) : x);
    let low = this.logarithmic ? Infinity : 0, high = this.logarithmic ? -Infinity : 0;
    for (const [, values] of this.curves) {
      for (const x of values) {
        const y = size(x);
        if (Number.isFinite(y)) (low = Math.min(low, y)), (high = Math.max(high, y));
      }
    }
    if (!(high > low)) [low, high] = Number.isFinite(low) ? [low - 1, low + 1] : [-1, 1];
    return (x) => 5 + ((high - size(x)) / (high - low)) * (this.height - 10);
  }

  line(context, points, color, width) {
    if (points.length < 2) return;
    context.strokeStyle = this.colors[color];
    context.lineWidth = width;
    stroke(context, points);
  }

  x(time) {
    const { first, last } = this.motion;
    return this.inset + ((time - first) / (last - first || 1)) * (this.width - 2 * this.inset);
  }

  draw(time) {
    const context = this.canvas.getContext("2d"), x = this.x(time);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.drawImage(this.still, 0, 0);
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    this.line(context, [[x, 0], [x, this.height]], "ink", 1);
    const i = this.motion.nearest(time), parts = this.curves.map(([name, values, color], k) => {
      const key = name ? `<i style="background: var(--${color})"></i>${name} ` : "";
      return `<span>${key}<b>${shown(values[i])}</b>, largest ${shown(this.largest[k])}</span>`;
    });
    this.text.innerHTML = `<span>${this.title}</span>${parts.join("")}`;
  }
}

// Ticks of time under the strips.
function drawAxis(canvas, motion, colors, inset) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight], span = motion.last - motion.first;
  const context = canvas.getContext("2d");
  sharpen(canvas, width, height);
  context.fillStyle = context.strokeStyle = colors.ink;
  context.globalAlpha = 0.74;
  context.font = "12px system-ui, sans-serif";
  if (!span) return;
  const rough = (span / width) * 90, power = 10 ** Math.floor(Math.log10(rough)), step = power * [1, 2, 5, 10].find((k) => k * power >= rough);
  for (let k = Math.ceil(motion.first / step - 1e-9); k * step <= motion.last + 1e-9 * span; k++) {
    const x = inset + ((k * step - motion.first) / span) * (width - 2 * inset), text = `${k ? "" : "t = "}${+(k * step).toPrecision(8)}`;
    context.fillRect(x - 0.5, 0, 1, 4);
    const half = context.measureText(text).width / 2;
    context.fillText(text, Math.min(width - 2 * half, Math.max(0, x - half)), 15);
  }
}
