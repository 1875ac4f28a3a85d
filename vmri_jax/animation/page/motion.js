// Positions of all bodies at a time: cubic Hermite interpolation between nodes.

function decoded(text, type) {
  return new type(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
}

class Motion {
  constructor(data) {
    this.t = decoded(data.t, Float64Array);
    this.points = decoded(data.points, Float32Array);
    this.velocities = decoded(data.velocities, Float32Array);
    this.size = 3 * data.bodies.length;
    this.first = this.t[0];
    this.last = this.t[this.t.length - 1];
  }

  // Index i of the interval [t_i, t_i+1] that contains a time.
  interval(time) {
    let low = 0, high = this.t.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.t[middle] <= time) low = middle; else high = middle;
    }
    return low;
  }

  // Index of the node that is nearest to a time.
  nearest(time) {
    const i = this.interval(time);
    return i + 1 < this.t.length && this.t[i + 1] - time < time - this.t[i] ? i + 1 : i;
  }

  // Positions of all bodies: x, y, z of the first body, then of the second ...
  at(time, out = new Float32Array(this.size)) {
    const { points, velocities, size } = this;
    if (this.t.length === 1) return out.set(points), out;
    const i = this.interval(time), h = this.t[i + 1] - this.t[i];
    const u = Math.min(1, Math.max(0, (time - this.t[i]) / h));
    for (let k = 0, a = i * size, b = a + size; k < size; k++, a++, b++) {
      const left = h * velocities[a], right = h * velocities[b], d = points[b] - points[a];
      out[k] = points[a] + u * (left + u * (3 * d - 2 * left - right + u * (left + right - 2 * d)));
    }
    return out;
  }
}
