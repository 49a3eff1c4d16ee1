// What all drawings share: colours of the present theme, sharp canvases, text.

const NAMES = ["ground", "panel", "ink", "soft", "line", "grid", "asphalt", "paint", "follower",
  "leader", "danger", "third", "wash", "band"];

export const colour = {};

export function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) colour[name] = style.getPropertyValue(`--${name}`).trim();
}

/** The canvas' context in CSS pixels, sharp on every screen, and wiped. */
export function fresh(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

export function text(pen, words, x, y, { size = 12, align = "left", bold = false, grounded = false, ink = colour.ink } = {}) {
  pen.font = `${bold ? "600 " : ""}${size}px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif`;
  pen.textAlign = align;
  pen.textBaseline = "middle";
  if (grounded) {
    pen.fillStyle = colour.panel;
    pen.fillRect(x - 2, y - size / 2 - 1, pen.measureText(words).width + 4, size + 2);
  }
  pen.fillStyle = ink;
  pen.fillText(words, x, y);
}

export function line(pen, x1, y1, x2, y2, { ink = colour.soft, width = 1, dash = [] } = {}) {
  pen.strokeStyle = ink;
  pen.lineWidth = width;
  pen.setLineDash(dash);
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x2, y2);
  pen.stroke();
  pen.setLineDash([]);
}

export function hexagon(pen, x, y, radius) {
  pen.beginPath();
  for (let k = 0; k < 6; k++) {
    const angle = Math.PI / 6 + (k * Math.PI) / 3;
    pen.lineTo(x + radius * Math.cos(angle), y + radius * Math.sin(angle));
  }
  pen.closePath();
}

/** A round number, about as large: 1, 2 or 5 times a power of ten. */
export function niceStep(about) {
  const power = 10 ** Math.floor(Math.log10(about));
  return [1, 2, 5, 10].find((step) => step * power >= about * 0.999) * power;
}

export const shown = (value) => `${Number(value.toPrecision(6))}`.replace("-", "−");

/** A time as the story tells it. */
export function clock(time, { began, interval }) {
  if (began === null) return `${time > 0 && time < 1 ? Number(time.toPrecision(2)) : time.toFixed(1)} s`;
  const [then, now] = [0, time].map((one) => new Date(1000 * (began + one)).toISOString());
  return (then.slice(0, 10) === now.slice(0, 10) ? "" : `${now.slice(5, 10)} `) + now.slice(11, interval < 60 ? 19 : 16);
}

/** Values of a variable, without those that are far from all others. */
export function nearOnes({ ranges }, variable, values) {
  const [low, high] = ranges[variable] ?? [-Infinity, Infinity];
  const known = values.filter((value) => value !== null && value !== undefined);
  const near = known.filter((value) => value >= low && value <= high);
  return near.length ? near : known;
}

export const limitsOf = ({ limits }, variable) => limits.filter(([one]) => one === variable).map(([, at]) => at);
