// What the machine recognises: its belief as bars, and its states on a map of gap and speed.

import { colour, fresh, hexagon, line, text } from "./paint.js";

const MOST_BARS = 4;
const APART = [20, 16]; // of two numbers, or of what a circle would cover of one [px]
const EDGE = { left: 36, right: 14, top: 14, bottom: 34 };

export function drawBelief(list, run) {
  const decision = run.decision, graph = run.graph;
  if (!decision || !graph) return;
  const likely = decision.belief.slice(0, MOST_BARS);
  const marked = run.start.live && run.start.judge !== "learnt" ? "dead end" : "a collision ended here";
  while (list.children.length < MOST_BARS) list.append(bar());
  [...list.children].forEach((item, k) => {
    const [state, share] = likely[k] ?? [null, 0];
    const known = graph.states[state];
    item.style.visibility = state === null ? "hidden" : "visible";
    if (state === null) return;
    item.className = known && known.is_dead_end ? "dead" : "";
    item.querySelector(".bar").style.width = `${100 * share}%`;
    item.querySelector(".share").textContent = `${Math.round(100 * share)} %`;
    const name = known ? known.name : "new";
    const words = `#${state + 1} ${known && known.is_dead_end ? `⬢ ${marked}: ` : ""}${name}`;
    item.querySelector(".name").textContent = words;
    item.title = words;
  });
}

function bar() {
  const item = document.createElement("li");
  for (const part of ["bar", "name", "share"]) {
    const span = document.createElement("span");
    span.className = part;
    item.append(span);
  }
  return item;
}

/** Where a gap and a speed lie on the map. The root of the gap: where cars are close, it matters. */
function scales(canvas, run) {
  const centers = run.graph.states.map((state) => state.center);
  const frames = run.frames; // so that the map stands still while the car moves on it
  const farthest = Math.max(20, ...frames.map((frame) => frame.gap), ...centers.map((center) => center[0]));
  const fastest = 1.05 * Math.max(10, ...frames.map((frame) => frame.v_follower), ...centers.map((center) => center[1]));
  const right = canvas.clientWidth - EDGE.right, bottom = canvas.clientHeight - EDGE.bottom;
  const x = (gap) => EDGE.left + Math.sqrt(Math.max(0, gap) / farthest) * (right - EDGE.left);
  const y = (speed) => bottom - (speed / fastest) * (bottom - EDGE.top);
  return { x, y, farthest, fastest };
}

let latest = null; // the scales of the map as it was drawn

/** Where the car is now on the map. */
export function placeHere(run) {
  return latest && [latest.x(run.motion.gap), latest.y(run.motion.v_follower)];
}

export function drawMap(canvas, run) {
  const { pen, width, height } = fresh(canvas);
  const graph = run.graph, decision = run.decision;
  if (!graph || !decision) return;
  latest = scales(canvas, run);
  const { x, y, farthest, fastest } = latest;
  drawAxes(pen, x, y, farthest, fastest, width, height);

  const where = (state) => [x(graph.states[state].center[0]), y(graph.states[state].center[1])];
  for (const [origin, target, share] of graph.transitions) {
    if (graph.states[origin] && graph.states[target]) drawWay(pen, where(origin), where(target), share);
  }
  drawTrail(pen, run, where, graph);
  const most = Math.max(...graph.states.map((state) => state.visits), 1);
  const present = graph.states[decision.state];
  // The most usual ones are numbered first, and none over another one's number.
  const taken = present ? [where(present.state)] : [];
  const free = ([a, b]) => taken.every(([c, d]) => Math.abs(a - c) > APART[0] || Math.abs(b - d) > APART[1]);
  const numbered = new Set([...graph.states].sort((a, b) => b.visits - a.visits)
    .filter((state) => free(where(state.state)) && taken.push(where(state.state))));
  const inOrder = [...graph.states].sort((a, b) => numbered.has(a) - numbered.has(b)); // circles below
  for (const state of inOrder) {
    const radius = 4 + 6 * Math.sqrt(state.visits / most);
    drawState(pen, state, where(state.state), radius, numbered.has(state), false);
  }
  if (present) drawState(pen, present, where(present.state), 11, true, true);
  canvas.setAttribute("aria-label", present
    ? `${graph.states.length} states; now in number ${present.state + 1}: ${present.name}`
    : `${graph.states.length} states`);
}

function drawAxes(pen, x, y, farthest, fastest, width, height) {
  const wanted = [2, 5, 10, 20, 40, 80, 160, 320].filter((gap) => gap <= farthest);
  for (const gap of wanted) {
    line(pen, x(gap), EDGE.top, x(gap), height - EDGE.bottom, { ink: colour.grid });
    text(pen, `${gap}`, x(gap), height - EDGE.bottom + 11, { size: 11, align: "center", ink: colour.soft });
  }
  for (let speed = 0; speed <= fastest; speed += fastest > 15 ? 10 : 5) {
    line(pen, EDGE.left, y(speed), width - EDGE.right, y(speed), { ink: colour.grid });
    text(pen, `${speed}`, EDGE.left - 6, y(speed), { size: 11, align: "right", ink: colour.soft });
  }
  text(pen, "gap [m]  –  close on the left", width - EDGE.right, height - 8, { size: 11, align: "right", ink: colour.soft });
  text(pen, "own speed [m/s]", EDGE.left + 4, 7, { size: 11, ink: colour.soft });
}

function drawWay(pen, [x1, y1], [x2, y2], share) {
  const bend = 0.16; // there and back must not lie on each other
  pen.strokeStyle = colour.soft;
  pen.globalAlpha = 0.12 + 0.5 * share;
  pen.lineWidth = 0.8 + 1.4 * share;
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.quadraticCurveTo((x1 + x2) / 2 - bend * (y2 - y1), (y1 + y2) / 2 + bend * (x2 - x1), x2, y2);
  pen.stroke();
  pen.globalAlpha = 1;
}

/** The way that the run took up to now. */
function drawTrail(pen, run, where, graph) {
  pen.strokeStyle = colour.follower;
  pen.lineWidth = 2;
  pen.globalAlpha = 0.55;
  pen.beginPath();
  const last = run.index(run.shown + 1e-6);
  for (let k = 0; k <= last; k++) {
    const state = run.frames[k].state;
    if (state !== null && graph.states[state]) pen.lineTo(...where(state));
  }
  pen.stroke();
  pen.globalAlpha = 1;
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
  if (isNumbered && radius > 5) {
    const ink = state.is_dead_end || isPresent ? colour.panel : colour.ink;
    text(pen, `${state.state + 1}`, x, y + 0.5, { size: isPresent ? 11 : 9, bold: true, align: "center", ink });
  }
}
