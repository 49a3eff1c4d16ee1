// The page: what comes from the run is shown, what is asked for is sent.

import { clock, readColours } from "./paint.js";
import { drawPlots, placeOf, span, timeAt } from "./plots.js";
import { drawRoad } from "./road.js";
import { Run } from "./run.js";
import { drawPlane, marksDeadEnds, placeHere } from "./plane.js";

const at = (id) => document.getElementById(id);
const run = new Run();
let socket = null;
let met = false; // whether a socket was ever let in
let came = performance.now(); // when something came at last
const PATIENCE = 5000; // for a decision that is due [ms]

// -- The run, as it comes ---------------------------------------------------------------------------

function connect() {
  socket = new WebSocket(new URL("socket", location.href.replace(/^http/, "ws")));
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onopen = () => { met = true; };
  socket.onclose = (event) => {
    const why = met ? `The connection to evofsm is lost${event.reason ? ` (${event.reason})` : ""}.`
      : "No connection to evofsm: it has ended, or refuses this address. It answers to http://localhost and http://127.0.0.1.";
    complain(`${why} Trying again ...`);
    at("reviser").hidden = true; // nobody knows whether it is on
    setTimeout(connect, 1500);
  };
}

function take(message) {
  came = performance.now();
  if (message.kind === "whole") message.parts.forEach(take);
  else if (message.kind === "failed") complain(`The run broke off: ${message.text}`);
  else run.take(message);
  if (["start", "frame"].includes(message.kind)) complain("");
  if (message.kind === "start") showStart(message);
  if (message.kind === "clock") showControls();
  if (message.kind === "known") showKnown(message);
  changed = true;
}

/** Why nothing is watched now; with no words it is again. */
function complain(words) {
  if (at("lost").textContent === words) return;
  at("lost").textContent = words;
  at("lost").hidden = !words;
  at("mode").textContent = words ? "lost" : "waiting";
  showStatus(run.latest);
  changed = true;
}

const send = (what, value) => {
  if (socket.readyState !== WebSocket.OPEN) return;
  socket.send(JSON.stringify(value === undefined ? { do: what } : { do: what, value }));
};

// -- What is shown as words and controls ------------------------------------------------------------

function showStart(start) {
  document.title = `${start.system}: evofsm`;
  at("intro").textContent = start.intro;
  at("about").textContent = `Here ${start.cases[start.case] ?? "a run"} of “${start.system}”: ${start.about}`;
  at("of-cases").textContent = start.live ? "Case" : "Episode";
  at("case").replaceChildren(...start.cases.map((name, k) => new Option(name, k, false, k === start.case)));
  at("speed").replaceChildren(...start.speeds.map((speed) => new Option(`${speed} ×`, speed)));
  for (const id of ["across", "up"]) at(id).replaceChildren(...start.names.map((name, k) => new Option(name, k)));
  for (const element of document.querySelectorAll("[data-live]")) element.hidden = !start.live;
  for (const element of document.querySelectorAll("[data-judge]")) element.hidden = element.dataset.judge !== start.judge;
  for (const element of document.querySelectorAll("[data-ends]")) element.hidden = element.dataset.ends !== String(marksDeadEnds(start));
  for (const element of document.querySelectorAll("[data-cars]")) element.hidden = !start.cars;
  document.body.classList.toggle("cars", start.cars);
  at("experience").textContent = "";
}

let chosen = null; // the plane that whoever looks on has chosen

function showKnown(known) {
  const plane = chosen && chosen.every((one) => one < run.start.names.length) ? chosen : known.plane;
  ["across", "up"].forEach((id, k) => { at(id).value = plane[k]; });
  at("harm").hidden = !known.harm;
  write("harm", known.harm && `${known.harm[0].toUpperCase()}${known.harm.slice(1)}.`);
  write("failure", known.told);
  at("learnt").textContent = learnt(run.start, known);
}

/** How much it knew, and what the plane shows. */
function learnt(start, known) {
  const signs = ["+ now, blue: its way", "○ state"];
  if (known.survived.length) signs.push("· survived");
  if (known.failed.length) signs.push("✕ failed");
  if (known.forms.length) signs.push(start.acts ? "shaded: expected to fail" : "shaded: it alarms");
  if (known.dead_ends.length) signs.push("dashed: dead end");
  signs.push(marksDeadEnds(start) ? "⬢ dead end" : "⬢ state in which it failed");
  return `${start.learning} ${signs.join(", ")}.`;
}

function showControls() {
  const { clock } = run;
  at("pause").textContent = clock.over ? "Again" : clock.paused ? "Go on" : "Pause";
  at("restart").hidden = clock.over; // which "Again" does then
  at("reviser").setAttribute("aria-checked", clock.revising);
  at("reviser-state").textContent = clock.revising ? "on" : "off";
  at("speed").value = clock.speed ?? "";
}

function showMode() {
  at("live").hidden = run.isLive;
  const mode = !run.isLive ? "past" : run.clock.over ? "ended" : run.clock.paused ? "paused" : run.start.live ? "live" : "shadow";
  if (at("lost").hidden) at("mode").textContent = mode;
  at("time").textContent = clock(run.shown, run.start);
  const scrub = at("scrub");
  scrub.max = span(run);
  scrub.value = run.shown;
  scrub.setAttribute("aria-valuetext", clock(run.shown, run.start));
}

let told = null;
function showStory() {
  const frame = run.frame;
  if (!frame) return;
  showStatus(frame);
  if (frame === told) return;
  told = frame;
  for (const part of ["when", "why", "done", "outcome", "alone"]) write(part, frame.told[part]);
  const decision = run.decision;
  write("decision", `${decision.here}; ${decision.reason}`);
  write("experience", decision.explanation);
}

/** What a frame was; of now nothing is known where nothing comes, but how a run ended. */
function showStatus(frame) {
  const isUnknown = !at("lost").hidden && run.isLive && !frame?.over;
  const { status, headline } = !isUnknown && frame ? frame.told
    : { status: "unjudged", headline: isUnknown ? "Not watched now" : "Waiting for the run" };
  at("status").dataset.status = status;
  write("headline", headline);
}

/** Only what is new, so that screen readers say only that. */
function write(id, words) {
  if (at(id).textContent !== words) at(id).textContent = words;
}

// -- What is asked for ------------------------------------------------------------------------------

const actions = {
  pause: () => (run.clock.over ? send("restart") : send("pause", !run.clock.paused)),
  step: () => send("step"),
  reviser: () => send("revise", !run.clock.revising),
  restart: () => send("restart"),
  live: () => run.goLive(),
  theme: () => setTheme(!document.documentElement.classList.contains("dark")),
  help: () => at("helping").showModal(),
};
for (const [id, action] of Object.entries(actions)) {
  at(id).addEventListener("click", () => { action(); changed = true; });
}
at("speed").addEventListener("change", () => send("speed", Number(at("speed").value)));
at("case").addEventListener("change", () => send("case", Number(at("case").value)));
for (const id of ["across", "up"]) {
  at(id).addEventListener("change", () => { chosen = plane(); changed = true; });
}
at("scrub").addEventListener("input", () => { run.see(Number(at("scrub").value)); changed = true; });

const plane = () => [Number(at("across").value), Number(at("up").value)];
const plots = at("plots-canvas");
const drag = (event) => {
  run.see(timeAt(plots, run, event.offsetX));
  changed = true;
};
plots.addEventListener("pointerdown", drag);
plots.addEventListener("pointermove", (event) => { if (event.buttons) drag(event); });

function back(count) {
  run.stepBy(-count);
}

/** On in the past; at its end, and where the run waits, it drives one decision. */
function on(count) {
  if (!run.isLive) run.stepBy(count);
  else send("step");
}

function faster(by) {
  const speeds = run.start.speeds;
  const wanted = speeds[speeds.indexOf(run.clock.speed) + by];
  if (wanted) send("speed", wanted);
}

const keys = {
  " ": actions.pause,
  ArrowLeft: (event) => back(event.shiftKey ? 10 : 1),
  ArrowRight: (event) => on(event.shiftKey ? 10 : 1),
  Home: () => run.see(0),
  End: actions.live, l: actions.live,
  "+": () => faster(1), "=": () => faster(1), ArrowUp: () => faster(1),
  "-": () => faster(-1), ArrowDown: () => faster(-1),
  r: () => { if (run.start.live) actions.reviser(); },
  n: actions.restart, t: actions.theme, "?": actions.help,
};
document.addEventListener("keydown", (event) => {
  const { target, key } = event;
  if (!run.start || at("helping").open || event.ctrlKey || event.metaKey || event.altKey) return;
  if (target.tagName === "SELECT" || (["BUTTON", "SUMMARY"].includes(target.tagName) && key === " ")) return;
  const action = keys[key] ?? keys[key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  action(event);
  changed = true;
});

// -- Looks ------------------------------------------------------------------------------------------

const dark = matchMedia("(prefers-color-scheme: dark)");
function setTheme(isDark) {
  document.documentElement.classList.toggle("dark", isDark);
  readColours();
  changed = true;
}
dark.addEventListener("change", () => setTheme(dark.matches));
const resized = new ResizeObserver(() => { changed = true; });
for (const canvas of document.querySelectorAll("canvas")) resized.observe(canvas);

// -- Every frame of the screen ----------------------------------------------------------------------

// The road is drawn anew for each; the rest, where nothing but a mark moves, with each decision.

let changed = true;
let before = performance.now();
let drawn = null;
function draw(now) {
  const time = run.shown;
  run.play(Math.min(0.25, (now - before) / 1000));
  before = now;
  const due = came + PATIENCE + 1000 * (run.start?.interval ?? 0) / (run.clock.speed ?? Infinity);
  if (now > due && run.start && at("lost").hidden && !run.clock.paused && !run.clock.over) complain("No decision comes: what is watched hangs, or takes long.");
  if (run.latest && (changed || run.shown !== time)) {
    if (changed || run.frame !== drawn) {
      at("playhead").style.top = `${drawPlots(plots, run)}px`;
      drawPlane(at("map-canvas"), run, plane());
      showStory();
    }
    [changed, drawn] = [false, run.frame];
    if (run.start.cars) drawRoad(at("road-canvas"), run);
    showMode();
    put("playhead", placeOf(plots, run, run.shown), 0);
    const here = placeHere(run);
    if (here) put("here", ...here);
  }
  requestAnimationFrame(draw);
}

function put(id, x, y) {
  at(id).hidden = false;
  at(id).style.transform = `translate(${x}px, ${y}px)`;
}

setTheme(dark.matches);
connect();
requestAnimationFrame(draw);
