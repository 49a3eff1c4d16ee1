// A plane of two variables: what was survived and what failed, where failure is expected, the states
// that were found, and the way of the run.

import { colour, fresh, hexagon, limitsOf, line, niceStep, nearOnes, shown, text } from "./paint.js";

const APART = [20, 16]; // of two numbers, or of what a circle would cover of one [px]
const EDGE = { left: 44, right: 14, top: 18, bottom: 34 };
const CELL = 4; // of the grid on which forms are drawn [px]

/** Whether states are marked that are dead ends; else those in which it failed. */
export const marksDeadEnds = (start) => start.live && start.judge !== "learnt";

/** Of a variable: from an observation to a place on the canvas, back, and its ticks. */
function axis(run, variable, from, to) {
  const { known } = run, seen = [known.survived, known.failed].flat().map((row) => row[variable])
    .concat(run.graph.states.map((state) => state.center[variable]))
    .concat(run.frames.map((frame) => frame.observation[variable]));
  const values = nearOnes(run.start, variable, seen).concat(limitsOf(known, variable));
  const isGap = run.start.cars && variable === 0; // its root: where cars are close, it matters
  const [bend, back] = isGap ? [(value) => Math.sqrt(Math.max(0, value)), (value) => value * value] : [(value) => value, (value) => value];
  let low = values.reduce((a, b) => Math.min(a, b), Infinity), high = values.reduce((a, b) => Math.max(a, b), -Infinity);
  const pad = 0.05 * (high - low) || 1;
  if (run.start.cars) [low, high] = [isGap ? 0 : -pad, Math.max(high + pad, 10)];
  else [low, high] = [low - pad, high + pad];
  const [first, last] = [bend(low), bend(high)];
  const place = (value) => from + ((bend(value) - first) / (last - first)) * (to - from);
  const held = (value) => place(Math.max(low, Math.min(high, value))); // at the edge, where it is beyond
  const value = (at) => back(first + ((at - from) / (to - from)) * (last - first));
  const step = niceStep((high - low) / Math.max(2, Math.abs(to - from) / 70));
  const ticks = isGap ? [2, 5, 10, 20, 40, 80, 160, 320].filter((gap) => gap <= high) : [];
  for (let k = Math.ceil(low / step); !isGap && k * step <= high; k++) ticks.push(k * step);
  const apart = ticks.filter((tick, k) => k === 0 || Math.abs(place(tick) - place(ticks[k - 1])) > 18);
  return { variable, place, held, value, ticks: apart, name: run.start.names[variable] };
}

let axes = null; // of the plane as it was drawn

/** Where it is now on the plane. */
export function placeHere(run) {
  const now = run.observation;
  const [a, b] = axes ? axes.map((one) => now[one.variable]) : [null, null];
  return a === null || b === null ? null : [axes[0].held(a), axes[1].held(b)];
}

export function drawPlane(canvas, run, [across, up]) {
  const { pen, width, height } = fresh(canvas);
  const graph = run.graph, decision = run.decision;
  if (!graph || !decision) return;
  const box = { left: EDGE.left, right: width - EDGE.right, top: EDGE.top, bottom: height - EDGE.bottom };
  axes = [axis(run, across, box.left, box.right), axis(run, up, box.bottom, box.top)];
  const [x, y] = axes;
  const at = (row) => [x.place(row[across]), y.place(row[up])];
  drawAxes(pen, x, y, box, width, height);

  pen.save();
  pen.beginPath();
  pen.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
  pen.clip();
  const { known } = run;
  for (const form of known.forms) drawForm(pen, x, y, box, form, run.start.acts ? 0 : form[13]);
  pen.fillStyle = colour.soft;
  pen.globalAlpha = 0.45;
  for (const row of known.survived) pen.fillRect(at(row)[0] - 1, at(row)[1] - 1, 2, 2);
  pen.globalAlpha = 1;
  for (const [k, row] of known.dead_ends.entries()) drawDeadEnd(pen, x, y, row, known.radii[k]);
  for (const row of known.failed) drawFailed(pen, ...at(row));
  const places = graph.states.map(({ center }) => [x.held(center[across]), y.held(center[up])]);
  const inView = graph.states.map(({ center }, k) => `${at(center)}` === `${places[k]}`);
  for (const [origin, target, share] of graph.transitions) {
    if (inView[origin] && inView[target]) drawWay(pen, places[origin], places[target], share);
  }
  drawTrail(pen, run, at);
  drawStates(pen, graph.states, places, decision.state);
  pen.restore();
  const present = graph.states[decision.state];
  canvas.setAttribute("aria-label", `${x.name} and ${y.name}. ` + (present
    ? `${graph.states.length} states; now in number ${present.state + 1}: ${decision.here}`
    : `${graph.states.length} states`));
}

function drawAxes(pen, x, y, box, width, height) {
  for (const tick of x.ticks) {
    line(pen, x.place(tick), box.top, x.place(tick), box.bottom, { ink: colour.grid });
    text(pen, shown(tick), x.place(tick), box.bottom + 11, { size: 11, align: "center", ink: colour.soft });
  }
  for (const tick of y.ticks) {
    line(pen, box.left, y.place(tick), box.right, y.place(tick), { ink: colour.grid });
    text(pen, shown(tick), box.left - 6, y.place(tick), { size: 11, align: "right", ink: colour.soft });
  }
  text(pen, x.name, width - EDGE.right, height - 8, { size: 11, align: "right", ink: colour.soft });
  text(pen, y.name, 2, 7, { size: 11, ink: colour.soft });
}

/** Where it fails, if that is of no other variables: its inside, and its outline by marching squares. */
function drawForm(pen, x, y, box, [, i, j, at, to, one, other, c, b, d, p, q, r], near) {
  const shows = (variable) => variable === x.variable || variable === y.variable;
  if (!shows(i) || !shows(j)) return;
  const form = (px, py) => {
    const of = (variable) => (variable === x.variable ? x.value(px) : y.value(py));
    const u = (of(i) - at) * one, v = (of(j) - to) * other;
    return c + u * (b + p * u + q * v) + v * (d + r * v) - near * Math.hypot(b + 2 * p * u + q * v, d + 2 * r * v + q * u);
  };
  pen.fillStyle = colour.wash;
  pen.strokeStyle = colour.danger;
  pen.lineWidth = 1.8;
  pen.beginPath();
  for (let left = box.left; left < box.right; left += CELL) {
    for (let top = box.top; top < box.bottom; top += CELL) {
      const corners = [[left, top], [left + CELL, top], [left + CELL, top + CELL], [left, top + CELL]];
      const values = corners.map(([px, py]) => form(px, py));
      if (values[0] > 0) pen.fillRect(left, top, CELL, CELL);
      const crossed = corners.flatMap(([px, py], k) => {
        const [next, here, there] = [corners[(k + 1) % 4], values[k], values[(k + 1) % 4]];
        const part = here / (here - there);
        return here > 0 === there > 0 ? [] : [[px + part * (next[0] - px), py + part * (next[1] - py)]];
      });
      for (let k = 0; k + 1 < crossed.length; k += 2) {
        pen.moveTo(...crossed[k]);
        pen.lineTo(...crossed[k + 1]);
      }
    }
  }
  pen.stroke();
}

function drawDeadEnd(pen, x, y, center, radii) {
  const reach = (one) => Math.abs(one.place(center[one.variable] + radii[one.variable]) - one.place(center[one.variable]));
  pen.strokeStyle = colour.third;
  pen.lineWidth = 1.4;
  pen.setLineDash([4, 3]);
  pen.beginPath();
  pen.ellipse(x.place(center[x.variable]), y.place(center[y.variable]), reach(x), reach(y), 0, 0, 7);
  pen.stroke();
  pen.setLineDash([]);
}

function drawFailed(pen, px, py) {
  line(pen, px - 3.5, py - 3.5, px + 3.5, py + 3.5, { ink: colour.danger, width: 1.8 });
  line(pen, px - 3.5, py + 3.5, px + 3.5, py - 3.5, { ink: colour.danger, width: 1.8 });
}

function drawWay(pen, [x1, y1], [x2, y2], share) {
  const bend = 0.16; // there and back must not lie on each other
  pen.strokeStyle = colour.soft;
  pen.globalAlpha = 0.08 + 0.4 * share;
  pen.lineWidth = 0.6 + 1.2 * share;
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.quadraticCurveTo((x1 + x2) / 2 - bend * (y2 - y1), (y1 + y2) / 2 + bend * (x2 - x1), x2, y2);
  pen.stroke();
  pen.globalAlpha = 1;
}

/** The way that the run took up to now. */
function drawTrail(pen, run, at) {
  pen.strokeStyle = colour.follower;
  pen.lineWidth = 2.5;
  pen.beginPath();
  const last = run.index(run.shown + 1e-6);
  for (let k = 0; k <= last; k++) pen.lineTo(...at(run.frames[k].observation));
  pen.stroke();
}

/** All states; the most usual ones are numbered first, and none over another one's number. */
function drawStates(pen, states, places, now) {
  const most = Math.max(...states.map((state) => state.visits), 1);
  const present = states[now];
  const taken = present ? [places[now]] : [];
  const free = ([a, b]) => taken.every(([c, d]) => Math.abs(a - c) > APART[0] || Math.abs(b - d) > APART[1]);
  const numbered = new Set([...states].sort((a, b) => b.visits - a.visits)
    .filter((state) => free(places[state.state]) && taken.push(places[state.state])));
  const inOrder = [...states].sort((a, b) => numbered.has(a) - numbered.has(b)); // circles below
  for (const state of inOrder) {
    const isNumbered = numbered.has(state), size = 4 + 6 * Math.sqrt(state.visits / most);
    if (state !== present) drawState(pen, state, places[state.state], isNumbered ? size : Math.min(size, 4), isNumbered, false);
  }
  if (present) drawState(pen, present, places[now], 11, true, true);
}

function drawState(pen, state, [x, y], radius, isNumbered, isPresent) {
  if (isPresent) {
    pen.fillStyle = colour.follower;
    pen.globalAlpha = 0.28;
    pen.beginPath();
    pen.arc(x, y, radius + 9, 0, 7);
    pen.fill();
    pen.globalAlpha = 1;
  }
  if (state.is_dead_end) hexagon(pen, x, y, radius + 1);
  else {
    pen.beginPath();
    pen.arc(x, y, radius, 0, 7);
  }
  const fill = isPresent ? colour.follower : colour.panel;
  pen.fillStyle = state.is_dead_end ? colour.danger : fill;
  pen.strokeStyle = isPresent ? colour.ink : state.is_dead_end ? colour.danger : colour.soft;
  pen.lineWidth = isPresent ? 2 : 1.2;
  pen.fill();
  pen.stroke();
  if (isNumbered && radius > 2 + 3 * `${state.state + 1}`.length) {
    const ink = state.is_dead_end || isPresent ? colour.panel : colour.ink;
    text(pen, `${state.state + 1}`, x, y + 0.5, { size: isPresent ? 11 : 9, bold: true, align: "center", ink });
  }
}
