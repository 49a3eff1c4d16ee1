// Risk, the classic warnings and accelerations, one above the other on one time axis.

import { clock, colour, fresh, limitsOf, line, nearOnes, niceStep, shown, text } from "./paint.js";

const LEFT = 40, RIGHT = 12;
const MOST_BAND = 0.3; // a wider interval says little, and would fill the panel
const MOST_COMPONENTS = 4; // of an action
const MOST_VARIABLES = 4; // of a log
const STEPS = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 21600, 43200, 86400]; // of a clock [s]
const LEAST_HEIGHT = 104; // of a panel [px]

/** What is drawn in each panel; `value` answers a frame's value, null where there is none. */
function panels(run) {
  const { start } = run, cars = start.cars, acts = start.live;
  const percent = (value) => `${Math.round(100 * value)} %`;
  const { follower, leader, danger, third, soft } = colour;
  const wish = (value) => ({ label: cars ? "driver's wish" : "proposed", ink: danger, width: 2.5, dash: [], value });
  const executed = (value) => ({ label: "executed", ink: follower, width: 2, dash: [5, 3], value });
  const advised = (k) => (acts ? executed((f) => f.executed[k]) : { ...executed((f) => f.advised[k]), label: "advised" });
  const changed = (k) => ({ ...wish((f) => (f.revised ? f.proposed[k] : null)), label: "proposed, where changed", dots: true });
  const byLeaders = start.judge !== "learnt", fails = cars ? "collision" : "failure";
  const risk = {
    title: "Risk", about: !start.acts ? "share of such alarms that were right; 0 while none is on" : `${byLeaders ? "of collision if the leader brakes now" : `that ${fails} can't be avoided any more`}; ${percent(start.tolerance)} is accepted`,
    low: 0, high: 1, ticks: [0, 0.5, 1], show: percent,
    lines: [wish((f) => f.proposed_risk.risk), ...(acts ? [executed((f) => f.executed_risk.risk)] : [])],
    bands: [{ ink: colour.band, ends: ({ proposed_risk: { low, high } }) => (high === null || high - low > MOST_BAND ? null : [low, high]) }],
    limits: start.acts ? [{ at: start.tolerance, ink: soft }] : [],
  };
  const most = byLeaders ? 12 : 10;
  const margin = {
    title: byLeaders ? "Braking of the leader that is survived" : "Margin of the best backup",
    about: byLeaders ? "m/s²; shaded: what leaders are expected to do" : "typical steps; shaded: what has to be left",
    low: byLeaders ? 0 : -2, high: most, ticks: byLeaders ? [0, 4, 8, 12] : [0, 5, 10], show: (value) => (value === most ? `≥ ${most}` : shown(value)),
    lines: [wish((f) => f.proposed_risk.critical), executed((f) => f.executed_risk.critical)],
    bands: [{ ink: colour.grid, ends: ({ needed, usual }) => (needed === null ? null : [usual ?? 0, needed]) }],
    limits: byLeaders ? [] : [{ at: 0, ink: soft }],
  };
  const classic = {
    title: "Classic warnings", about: "seconds; they warn below their dotted line",
    low: 0, high: 6, ticks: [0, 2, 4, 6], show: (value) => (value === 6 ? "≥ 6" : shown(value)),
    lines: [
      { label: "time to collision", ink: leader, width: 2, dash: [8, 3], value: (f) => f.cars.time_to_collision ?? Infinity },
      { label: "time headway", ink: third, width: 2, dash: [2, 2], value: (f) => f.cars.time_headway ?? Infinity },
    ],
    bands: [], limits: [{ at: start.ttc_threshold, ink: leader }, { at: start.headway_threshold, ink: third }],
  };
  const actions = start.low.slice(0, MOST_COMPONENTS).map((low, k) => {
    const high = start.high[k], pad = 0.1 * (high - low), several = start.low.length;
    const step = start.discrete ? Math.ceil((high + 1) / 5) : niceStep((high - low) / 4);
    const ticks = [];
    for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9; n++) ticks.push(n * step);
    return {
      title: cars ? "Acceleration" : several > 1 ? `Action ${k + 1} of ${several}` : "Action", about: cars ? "m/s²" : "",
      low: low - pad, high: high + pad, ticks, show: start.discrete ? (value) => `a(${value + 1})` : shown,
      lines: cars ? [wish((f) => f.proposed[k]), advised(k)] : [{ ...executed((f) => f.executed[k]), width: 1.4, dash: [] }, changed(k)],
      steps: !cars,
      bands: [], limits: low < 0 && high > 0 ? [{ at: 0, ink: soft }] : [],
    };
  });
  const seen = start.live || cars ? [] : start.names.slice(0, MOST_VARIABLES).map((title, k) => variable(run, title, k));
  if (!start.acts) return [...seen, { ...risk, lines: [{ ...risk.lines[0], label: "risk" }] }, states(run)];
  const hasMargin = run.frames.some((frame) => frame.proposed_risk.critical !== null);
  return [...seen, risk, ...(hasMargin ? [margin] : []), ...(cars ? [classic] : []), ...actions];
}

/** A variable over time. */
function variable(run, title, k) {
  const value = (frame) => frame.observation[k] ?? null;
  const at = limitsOf(run.known, k), all = nearOnes(run.start, k, run.frames.map(value)).concat(at);
  const low = Math.min(...all), high = Math.max(...all, low + 1e-9), step = niceStep((high - low) / 3);
  const ticks = [];
  for (let n = Math.ceil(low / step); n * step <= high; n++) ticks.push(n * step);
  return {
    title, about: "", low: low - 0.05 * (high - low), high: high + 0.05 * (high - low), ticks, show: shown,
    lines: [{ label: "observed", ink: colour.ink, width: 1.4, dash: [], value }], bands: [],
    limits: at.map((one) => ({ at: one, ink: colour.danger })),
  };
}

/** The state that it was in. */
function states(run) {
  const most = Math.max(1, ...run.frames.map((frame) => frame.state ?? 0));
  return {
    title: "State", about: "as it was recognised", low: -0.5, high: most + 0.5, ticks: [0, Math.round(most / 2), most],
    show: (value) => `#${value + 1}`, steps: true, bands: [], limits: [],
    lines: [{ label: "most probable", ink: colour.follower, width: 1.4, dash: [], value: (frame) => frame.state }],
  };
}

/** Seconds on the axis: a round number that leaves some room. */
export function span(run) {
  const latest = run.latest ? run.latest.time : 0;
  const least = Math.max(1.04 * latest, Math.min(20, 60 * run.start.interval));
  const unit = niceStep(least) / 10;
  return Math.ceil(least / unit) * unit;
}

export function timeAt(canvas, run, x) {
  return ((x - LEFT) / (canvas.clientWidth - LEFT - RIGHT)) * span(run);
}

export function placeOf(canvas, run, time) {
  return LEFT + (time / span(run)) * (canvas.clientWidth - LEFT - RIGHT);
}

/** Draw all panels; answers where they begin, below the marks' labels. */
export function drawPlots(canvas, run) {
  if (!run.latest) return 0;
  const all = panels(run);
  canvas.parentElement.style.minHeight = `${LEAST_HEIGHT * all.length + 80}px`;
  const { pen, width, height } = fresh(canvas);
  const most = span(run);
  const x = (time) => placeOf(canvas, run, time);
  const visible = run.frames.slice(0, run.index(run.shown + 1e-6) + 1);
  const marks = marksOf(run.frame, run.start);
  const top = 4 + 16 * place(pen, marks, x, width), bottom = height - 32;
  const heading = width < 560 ? 33 : 20;
  const each = (bottom - top) / all.length;

  all.forEach((panel, number) => {
    const box = { top: top + number * each + heading, bottom: top + (number + 1) * each - 5 };
    const y = (value) => {
      const inside = Math.max(panel.low, Math.min(panel.high, value));
      return box.bottom - ((inside - panel.low) / (panel.high - panel.low)) * (box.bottom - box.top);
    };
    drawDanger(pen, visible, x, box);
    drawFrame(pen, panel, box, y, width);
    for (const band of panel.bands) drawBand(pen, visible, band, x, y);
    for (const one of panel.lines) drawLine(pen, visible, one, x, y, panel.steps);
    if (!visible.some((frame) => panel.lines.some((one) => (one.value(frame) ?? null) !== null))) {
      text(pen, "nothing is judged", (LEFT + width) / 2, (box.top + box.bottom) / 2, { align: "center", ink: colour.soft });
    }
  });
  canvas.setAttribute("aria-label", `${all.map((panel) => panel.title).join(", ")} over time`);
  drawTimes(pen, x, run, bottom, width);
  drawMarks(pen, marks, x, top, bottom);
  // Words come last, on ground of their own, so that no mark strikes them through.
  all.forEach((panel, number) => {
    drawHeading(pen, panel, top + number * each, width, heading > 20);
  });
  return top;
}

function marksOf(frame, start) {
  const story = frame.story;
  return [
    { at: story.first, label: start.acts ? "▲ first danger" : "▲ first alarm", ink: colour.danger },
    { at: story.time_headway, label: "time headway warns", ink: colour.third },
    { at: story.dead_end, label: "⬢ dead end", ink: colour.danger },
    { at: story.leader_brakes, label: "leader brakes", ink: colour.ink },
    { at: story.time_to_collision, label: "time to collision warns", ink: colour.leader },
    { at: story.failure, label: `✕ ${frame.told.headline.match(/\w+/)[0].toLowerCase()}`, ink: colour.danger },
  ].filter((mark) => mark.at !== null).map((mark) => ({ ...mark, label: `${mark.label} ${clock(mark.at, start)}` }));
}

/** Give each mark a row in which its label meets no other; answers how many rows there are. */
function place(pen, marks, x, width) {
  pen.font = "600 11px system-ui";
  const rows = [];
  for (const mark of marks) {
    const wide = pen.measureText(mark.label).width + 12;
    mark.wide = wide;
    const from = Math.max(0, Math.min(x(mark.at), width - wide)), to = from + wide;
    mark.from = from;
    mark.row = rows.findIndex((taken) => taken.every(([a, b]) => to < a || from > b));
    if (mark.row < 0) mark.row = rows.push([]) - 1;
    rows[mark.row].push([from, to]);
  }
  return Math.max(2, rows.length);
}

function drawMarks(pen, marks, x, top, bottom) {
  const y = (mark) => 10 + 16 * mark.row;
  for (const mark of marks) {
    line(pen, x(mark.at), y(mark) - 7, x(mark.at), bottom, { ink: mark.ink, width: 1.2, dash: [3, 3] });
  }
  for (const mark of marks) {
    pen.fillStyle = colour.panel;
    pen.fillRect(mark.from + 2, y(mark) - 7, mark.wide - 7, 14);
    text(pen, mark.label, mark.from + 4, y(mark), { size: 11, bold: true, ink: mark.ink });
  }
}

function drawFrame(pen, panel, box, y, width) {
  for (const tick of panel.ticks) {
    line(pen, LEFT, y(tick), width - RIGHT, y(tick), { ink: colour.grid });
    text(pen, panel.show(tick), LEFT - 5, y(tick), { size: 11, align: "right", ink: colour.soft });
  }
  for (const limit of panel.limits) {
    line(pen, LEFT, y(limit.at), width - RIGHT, y(limit.at), { ink: limit.ink, dash: [1, 3], width: 1.4 });
  }
  line(pen, LEFT, box.top, LEFT, box.bottom, { ink: colour.line });
}

function drawHeading(pen, panel, y, width, isNarrow) {
  text(pen, panel.title, LEFT, y + 9, { bold: true, grounded: true });
  const from = LEFT + pen.measureText(panel.title).width + 7;
  let x = isNarrow ? LEFT : width - RIGHT;
  pen.font = "11px system-ui";
  const widths = panel.lines.map((one) => pen.measureText(one.label).width + 36);
  if (!isNarrow) x -= widths.reduce((sum, one) => sum + one, 0);
  const room = (isNarrow ? width - RIGHT : x) - from;
  let about = panel.about;
  if (pen.measureText(about).width > room) about = about.split(/[;,]/)[0];
  if (pen.measureText(about).width <= room) text(pen, about, from, y + 9, { size: 11, ink: colour.soft, grounded: true });
  const level = isNarrow ? y + 23 : y + 9;
  panel.lines.forEach((one, k) => {
    text(pen, one.label, x + 26, level, { size: 11, grounded: true });
    line(pen, x, level, x + 22, level, { ink: one.ink, width: one.width, dash: one.dash });
    x += widths[k];
  });
}

/** Shade when there was danger, and hatch when not even full braking would have helped. */
function drawDanger(pen, frames, x, box) {
  const shade = (holds, fill) => {
    let from = -1;
    frames.forEach((frame, k) => {
      if (holds(frame) && from < 0) from = k;
      if (from >= 0 && (!holds(frame) || k + 1 === frames.length)) {
        fill(x(frames[from].time), x(frame.time));
        from = -1;
      }
    });
  };
  // It is known only later that danger was over; the shade ends where it was.
  const lasted = new Map();
  for (const { danger } of frames) if (danger) lasted.set(danger.since, danger.last);
  const isDangerous = ({ danger, time }) => danger && time <= lasted.get(danger.since);
  shade(isDangerous, (from, to) => {
    pen.fillStyle = colour.wash;
    pen.fillRect(from, box.top, to - from, box.bottom - box.top);
  });
  shade((frame) => isDangerous(frame) && frame.danger.dead_end !== null, (from, to) => {
    pen.save();
    pen.beginPath();
    pen.rect(from, box.top, to - from, box.bottom - box.top);
    pen.clip();
    const tall = box.bottom - box.top;
    for (let at = from - tall; at < to; at += 9) {
      line(pen, at, box.bottom, at + tall, box.top, { ink: colour.wash, width: 2 });
    }
    pen.restore();
  });
}

function drawBand(pen, frames, { ink, ends }, x, y) {
  pen.fillStyle = ink;
  let stretch = [];
  const fill = () => {
    pen.beginPath();
    for (const [time, [, high]] of stretch) pen.lineTo(x(time), y(high));
    for (const [time, [low]] of stretch.reverse()) pen.lineTo(x(time), y(low));
    pen.fill();
    stretch = [];
  };
  for (const frame of frames) {
    const found = ends(frame);
    if (found === null) fill();
    else stretch.push([frame.time, found]);
  }
  fill();
}

function drawLine(pen, frames, one, x, y, steps) {
  if (one.dots) {
    for (const frame of frames) {
      const value = one.value(frame) ?? null;
      if (value !== null) line(pen, x(frame.time), y(value) - 3, x(frame.time), y(value) + 3, { ink: one.ink, width: 2 });
    }
    return;
  }
  pen.strokeStyle = one.ink;
  pen.lineWidth = one.width;
  pen.lineJoin = "round";
  pen.setLineDash(one.dash);
  pen.beginPath();
  let before = null;
  for (const frame of frames) {
    const value = one.value(frame) ?? null;
    if (before === null && value !== null) pen.moveTo(x(frame.time), y(value));
    else if (before !== null) {
      if (steps) pen.lineTo(x(frame.time), y(before)); // an action is held until the next
      if (value !== null) pen.lineTo(x(frame.time), y(value));
    }
    before = value;
  }
  pen.stroke();
  pen.setLineDash([]);
}

function drawTimes(pen, x, run, bottom, width) {
  const { start } = run, most = span(run), isClock = start.began !== null, least = most * Math.max(80 / width, 1 / 6);
  const step = isClock ? STEPS.find((one) => one >= least) ?? 86400 * Math.ceil(least / 86400) : niceStep(least);
  for (let at = (step - ((start.began ?? 0) % step)) % step; at <= most * 1.001; at += step) {
    line(pen, x(at), bottom, x(at), bottom + 4, { ink: colour.soft });
    const words = isClock ? clock(at, start) : shown(at), half = pen.measureText(words).width / 2;
    text(pen, words, Math.min(x(at), width - half - 2), bottom + 12, { size: 11, align: "center", ink: colour.soft });
  }
  const day = isClock ? new Date(1000 * start.began).toISOString().slice(0, 10) : "";
  text(pen, start.began ? day : `time [${isClock ? "h:min" : "s"}]`, x(most), bottom + 25, { size: 11, align: "right", ink: colour.soft });
}
