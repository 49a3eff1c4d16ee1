// Risk, the classic warnings and accelerations, one above the other on one time axis.

import { colour, fresh, line, text } from "./paint.js";

const LEFT = 40, RIGHT = 12;
const MOST_BAND = 0.3; // a wider interval says little, and would fill the panel

/** What is drawn in each panel; `name` answers a frame's value, null where there is none. */
function panels(start) {
  const percent = (value) => `${Math.round(100 * value)} %`;
  const plain = (value) => `${value}`.replace("-", "−");
  const { follower, leader, danger, third, soft } = colour;
  return [
    {
      title: "Risk", about: start.judge === "learnt" ? "that something begins which nothing it knows survives" : "of collision if the leader brakes now",
      low: 0, high: 1, ticks: [0, 0.5, 1], show: percent,
      lines: [
        { label: "driver's wish", ink: danger, width: 2.5, dash: [], value: (f) => f.proposed_risk.risk, band: (f) => f.proposed_risk },
        { label: "executed", ink: follower, width: 2, dash: [5, 3], value: (f) => f.executed_risk.risk },
      ],
      limits: [{ at: start.tolerance, label: `accepted ${percent(start.tolerance)}`, ink: soft }],
    },
    {
      title: "Classic warnings", about: "seconds; they warn below their dotted line",
      low: 0, high: 6, ticks: [0, 2, 4, 6], show: (value) => (value === 6 ? "≥ 6" : plain(value)),
      lines: [
        { label: "time to collision", ink: leader, width: 2, dash: [8, 3], value: (f) => f.time_to_collision ?? Infinity },
        { label: "time headway", ink: third, width: 2, dash: [2, 2], value: (f) => f.time_headway ?? Infinity },
      ],
      limits: [
        { at: start.ttc_threshold, ink: leader },
        { at: start.headway_threshold, ink: third },
      ],
    },
    {
      title: "Acceleration", about: "m/s²",
      low: Math.floor(start.actions[0] - 0.5), high: Math.ceil(start.actions[1] + 0.5),
      ticks: [Math.ceil(start.actions[0]), 0, Math.floor(start.actions[1])], show: plain,
      lines: [
        { label: "driver's wish", ink: danger, width: 2, dash: [], value: (f) => f.proposed },
        { label: "executed", ink: follower, width: 2.5, dash: [5, 3], value: (f) => f.executed },
      ],
      limits: [{ at: 0, ink: soft }],
    },
  ];
}

/** Seconds on the axis: a round number that leaves some room. */
export function span(run) {
  const latest = run.latest ? run.latest.time : 0;
  return Math.max(20, Math.ceil((latest + 1) / 10) * 10);
}

export function timeAt(canvas, run, x) {
  return ((x - LEFT) / (canvas.clientWidth - LEFT - RIGHT)) * span(run);
}

export function placeOf(canvas, run, time) {
  return LEFT + (time / span(run)) * (canvas.clientWidth - LEFT - RIGHT);
}

/** Draw all panels; answers where they begin, below the marks' labels. */
export function drawPlots(canvas, run) {
  const { pen, width, height } = fresh(canvas);
  if (!run.latest) return 0;
  const most = span(run);
  const x = (time) => placeOf(canvas, run, time);
  const visible = run.frames.slice(0, run.index(run.shown + 1e-6) + 1);
  const marks = marksOf(run.frame);
  const top = 4 + 16 * place(pen, marks, x, width), bottom = height - 32;
  const all = panels(run.start), heading = width < 480 ? 33 : 20;
  const each = (bottom - top) / all.length;

  all.forEach((panel, number) => {
    const box = { top: top + number * each + heading, bottom: top + (number + 1) * each - 5 };
    const y = (value) => {
      const inside = Math.max(panel.low, Math.min(panel.high, value));
      return box.bottom - ((inside - panel.low) / (panel.high - panel.low)) * (box.bottom - box.top);
    };
    drawDanger(pen, visible, x, box);
    drawFrame(pen, panel, box, y, width);
    for (const one of panel.lines) if (one.band) drawBand(pen, visible, one.band, x, y);
    for (const one of panel.lines) drawLine(pen, visible, one, x, y);
  });
  drawTimes(pen, x, most, bottom);
  drawMarks(pen, marks, x, top, bottom);
  // Words come last, on ground of their own, so that no mark strikes them through.
  all.forEach((panel, number) => {
    drawHeading(pen, panel, top + number * each, width, heading > 20);
  });
  return top;
}

function marksOf(frame) {
  const story = frame.story;
  return [
    { at: story.first, label: "▲ danger began", ink: colour.danger },
    { at: story.time_headway, label: "time headway warns", ink: colour.third },
    { at: story.dead_end, label: "⬢ dead end", ink: colour.danger },
    { at: story.leader_brakes, label: "leader brakes", ink: colour.ink },
    { at: story.time_to_collision, label: "time to collision warns", ink: colour.leader },
    { at: story.collision, label: "✕ collision", ink: colour.danger },
  ].filter((mark) => mark.at !== null).map((mark) => ({ ...mark, label: `${mark.label} ${mark.at.toFixed(1)} s` }));
}

/** Give each mark a row in which its label meets no other; answers how many rows there are. */
function place(pen, marks, x, width) {
  pen.font = "600 11px system-ui";
  const rows = [];
  for (const mark of marks) {
    const wide = pen.measureText(mark.label).width + 12;
    mark.wide = wide;
    mark.right = x(mark.at) + wide > width;
    const [from, to] = mark.right ? [x(mark.at) - wide, x(mark.at)] : [x(mark.at), x(mark.at) + wide];
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
    const wide = mark.wide - 7;
    pen.fillRect(x(mark.at) + (mark.right ? -wide - 2 : 2), y(mark) - 7, wide, 14);
    text(pen, mark.label, x(mark.at) + (mark.right ? -4 : 4), y(mark), {
      size: 11, bold: true, ink: mark.ink, align: mark.right ? "right" : "left",
    });
  }
}

function drawFrame(pen, panel, box, y, width) {
  for (const tick of panel.ticks) {
    line(pen, LEFT, y(tick), width - RIGHT, y(tick), { ink: colour.grid });
    text(pen, panel.show(tick), LEFT - 5, y(tick), { size: 11, align: "right", ink: colour.soft });
  }
  for (const limit of panel.limits) {
    line(pen, LEFT, y(limit.at), width - RIGHT, y(limit.at), { ink: limit.ink, dash: [1, 3], width: 1.4 });
    if (limit.label) {
      text(pen, limit.label, width - RIGHT, y(limit.at) - 7, { size: 10.5, align: "right", ink: limit.ink });
    }
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

function drawBand(pen, frames, band, x, y) {
  pen.fillStyle = colour.band;
  let stretch = [];
  const fill = () => {
    pen.beginPath();
    for (const frame of stretch) pen.lineTo(x(frame.time), y(band(frame).high));
    for (const frame of stretch.reverse()) pen.lineTo(x(frame.time), y(band(frame).low));
    pen.fill();
    stretch = [];
  };
  for (const frame of frames) {
    const { low, high } = band(frame);
    if (high === null || high - low > MOST_BAND) fill();
    else stretch.push(frame);
  }
  fill();
}

function drawLine(pen, frames, one, x, y) {
  pen.strokeStyle = one.ink;
  pen.lineWidth = one.width;
  pen.lineJoin = "round";
  pen.setLineDash(one.dash);
  pen.beginPath();
  let isDown = false;
  for (const frame of frames) {
    const value = one.value(frame);
    if (value === null || value === undefined) {
      isDown = false;
      continue;
    }
    if (isDown) pen.lineTo(x(frame.time), y(value));
    else pen.moveTo(x(frame.time), y(value));
    isDown = true;
  }
  pen.stroke();
  pen.setLineDash([]);
}

function drawTimes(pen, x, most, bottom) {
  const step = most > 60 ? 20 : most > 30 ? 10 : 5;
  for (let time = 0; time <= most; time += step) {
    line(pen, x(time), bottom, x(time), bottom + 4, { ink: colour.soft });
    text(pen, `${time}`, x(time), bottom + 12, { size: 11, align: "center", ink: colour.soft });
  }
  text(pen, "time [s]", x(most), bottom + 25, { size: 11, align: "right", ink: colour.soft });
}
