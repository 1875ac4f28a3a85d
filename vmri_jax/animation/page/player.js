// The page: time, buttons, keys.

const data = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);
const motion = new Motion(data), camera = new Camera(data.view), painter = new Painter(find("view"), data);
const seconds = (text) => parseFloat(text) || 0;
const query = new URLSearchParams(location.hash.slice(1)); // #t=3.5&theme=dark: open the page stopped at this time
const TRAIL = 1.6; // seconds of play time that a trail shows
const INSET = 9; // half the thumb of the slider: the first time of the strips lies below its middle

const state = { time: motion.first, playing: false, speed: data.speed, trails: data.trails, stale: true, before: 0 };
const colored = ["slow", "third", "rod", "fast"];
const energies = data.energy.map((text, k) => [data.energy_names[k], decoded(text, Float32Array), k && k === data.energy.length - 1 ? "fast" : colored[k]]);
const strips = [new Strip(find("energy"), find("energy-text"), data.energy_title, motion, energies, false)];
if (data.residual) {
  const [position, velocity] = data.residual.map((text) => decoded(text, Float32Array));
  strips.push(new Strip(find("residual"), find("residual-text"), "constraint residual", motion, [["position", position, "slow"], ["velocity", velocity, "third"]], true));
}

function trail() {
  if (!state.trails) return [];
  const from = Math.max(motion.first, state.time - TRAIL * state.speed), count = Math.max(8, Math.min(90, Math.round(2400 / data.bodies.length)));
  const places = [];
  for (let k = 0; k <= count; k++) places.push(motion.at(from + ((state.time - from) * k) / count));
  return places;
}

function digits() {
  return Math.max(0, 3 - Math.floor(Math.log10(motion.last - motion.first || 1)));
}

function draw() {
  camera.aim(painter.width, painter.height);
  painter.draw(camera, motion.at(state.time), trail());
  strips.forEach((strip) => strip.draw(state.time));
  const now = `t = ${state.time.toFixed(digits()).replace("-", "−")}`;
  find("now").textContent = now;
  find("time").value = state.time;
  find("time").setAttribute("aria-valuetext", `${now} of ${+motion.last.toPrecision(6)}`);
}

function frame(clock) {
  if (state.playing) {
    state.time += Math.min(0.1, (clock - state.before) / 1000) * state.speed;
    if (state.time > motion.last) state.time = motion.first; // once more from the start
    state.stale = true;
  }
  state.before = clock;
  if (state.stale) {
    state.stale = false;
    draw();
  }
  requestAnimationFrame(frame);
}

function changed() {
  state.stale = true;
}

function play(on) {
  state.playing = on && motion.last > motion.first;
  find("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
}

function seek(time) {
  state.time = Math.min(motion.last, Math.max(motion.first, time));
  changed();
}

function home() {
  camera.reset();
  fit();
  changed();
}

// Height of the view that the title covers.
function covered() {
  const header = document.querySelector("header");
  return getComputedStyle(header).position === "absolute" ? 0.7 * header.offsetHeight : 0;
}

// Adapts canvases and view to the size of the window.
function fit() {
  const { clientWidth: width, clientHeight: height } = painter.canvas;
  painter.resize(width, height);
  if (!camera.moved) camera.fit(data.fitted, data.margin, width, height, covered());
  recolor();
  draw(); // at once: a resized canvas is empty
}

function recolor() {
  const style = getComputedStyle(document.documentElement), colors = {};
  for (const name of ["ink", "faint", "slow", "third"]) colors[name] = style.getPropertyValue(`--${name}`);
  painter.recolor();
  strips.forEach((strip) => strip.resize(colors, INSET));
  drawAxis(find("axis"), motion, colors, INSET);
  changed();
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  recolor();
}

function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function toggle(id, name, target) {
  target[name] = !target[name];
  find(id).setAttribute("aria-pressed", target[name]);
  changed();
}

function speedBy(places) {
  const select = find("speed");
  select.selectedIndex = Math.min(select.length - 1, Math.max(0, select.selectedIndex + places));
  state.speed = +select.value;
  changed();
}

const press = {
  names: () => toggle("names", "names", painter),
  trails: () => toggle("trails", "trails", state),
  home,
  theme: () => theme(isDark() ? "light" : "dark"),
  play: () => play(!state.playing),
};
for (const [id, act] of Object.entries(press)) find(id).addEventListener("click", act);

const step = (motion.last - motion.first) / 100;
const keys = {
  " ": press.play, n: press.names, t: press.trails, r: home, d: press.theme,
  ArrowLeft: () => seek(state.time - step), ArrowRight: () => seek(state.time + step),
  ArrowUp: () => speedBy(1), ArrowDown: () => speedBy(-1),
  Home: () => seek(motion.first), End: () => seek(motion.last),
  "+": () => camera.zoom(0.9), "-": () => camera.zoom(1 / 0.9),
};
const turns = { ArrowLeft: [0.08, 0], ArrowRight: [-0.08, 0], ArrowUp: [0, 0.08], ArrowDown: [0, -0.08] };
document.addEventListener("keydown", (event) => {
  const focus = document.activeElement, button = focus.tagName === "BUTTON";
  if (event.ctrlKey || event.metaKey || event.altKey || focus.tagName === "SELECT" || (event.key === " " && button)) return;
  const turn = event.shiftKey && turns[event.key], act = turn ? () => camera.turn(...turn) : keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act) return;
  event.preventDefault();
  act();
  changed();
});

find("time").min = motion.first;
find("time").max = motion.last;
find("time").addEventListener("input", (event) => seek(+event.target.value));
for (const speed of data.speeds) find("speed").add(new Option(`${speed} ×`, speed, speed === data.speed, speed === data.speed));
find("speed").addEventListener("change", () => speedBy(0));
for (const strip of strips) {
  const move = (event) => {
    const share = (event.offsetX - INSET) / (strip.width - 2 * INSET);
    if (event.buttons) seek(motion.first + share * (motion.last - motion.first));
  };
  strip.canvas.addEventListener("pointerdown", move);
  strip.canvas.addEventListener("pointermove", move);
}
handle(find("view"), camera, changed, home);
new ResizeObserver(fit).observe(find("view"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);

if (query.has("theme")) document.documentElement.dataset.theme = query.get("theme");
fit();
if (query.has("t")) seek(seconds(query.get("t")));
else play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
requestAnimationFrame(frame);
