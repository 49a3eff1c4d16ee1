// The road: both cars from the side of the lane, the gap between them, and a scale.

import { colour, fresh, line, text } from "./paint.js";

// An acceleration below this lights the brake lights [m/s²].
const BRAKES = -0.5;
let view = 60; // how much of the road is shown [m]; follows what is needed

export function drawRoad(canvas, run) {
  const { pen, width, height } = fresh(canvas);
  const motion = run.motion;
  if (!motion) return;
  const length = run.start.car_length;
  const behind = motion.gap_behind === null ? 0 : motion.gap_behind + length;
  const needed = Math.max(45, behind + 2 * length + Math.max(motion.gap, 0) * 1.12 + 16);
  view += (needed - view) * 0.06;
  const scale = width / view;
  const front = (behind + length + 6) * scale; // where the follower's front bumper is
  const lane = { top: 46, bottom: height - 24 };
  const middle = (lane.top + lane.bottom) / 2;

  pen.fillStyle = colour.asphalt;
  pen.fillRect(0, lane.top, width, lane.bottom - lane.top);
  for (const y of [lane.top + 2, lane.bottom - 2]) {
    const dash = 6 * scale;
    pen.lineDashOffset = (motion.x_follower * scale) % (2 * dash);
    line(pen, 0, y, width, y, { ink: colour.paint, width: 2, dash: [dash, dash] });
    pen.lineDashOffset = 0;
  }
  drawScale(pen, motion.x_follower, front, scale, width, lane.bottom, height);

  const carHeight = (lane.bottom - lane.top) * 0.52;
  const car = (x, ink, brakes) => drawCar(pen, x, middle, length * scale, carHeight, ink, brakes);
  if (motion.gap_behind !== null) {
    car(front - (length + motion.gap_behind) * scale, colour.line, false);
  }
  const tail = front + motion.gap * scale; // the leader's rear bumper
  car(front, colour.follower, motion.a_follower < BRAKES);
  car(tail + length * scale, colour.leader, motion.a_leader < BRAKES);
  drawGap(pen, front, tail, middle, lane.top, motion.gap);

  const isNarrow = width < 560;
  const left = label("Follower", motion.v_follower, motion.a_follower, isNarrow);
  const right = label("Leader", motion.v_leader, motion.a_leader, isNarrow);
  const size = isNarrow ? 11.5 : 13.5;
  text(pen, left, 10, 14, { size, bold: true, ink: colour.follower });
  // Over its car, but clear of the other label.
  const clear = 10 + pen.measureText(left).width + 30 + pen.measureText(right).width;
  text(pen, right, Math.min(width - 10, Math.max(clear, tail + length * scale)), 14, {
    size, bold: true, align: "right", ink: colour.leader,
  });
  const frame = run.frame;
  if (frame.failed && frame.told.headline.startsWith("Collision")) drawCollision(pen, front, middle, carHeight);
  if (frame.cars.rear_ended) drawCollision(pen, front - length * scale, middle, carHeight);
  canvas.setAttribute("aria-label", `${left}. ${right}. Gap ${Math.max(0, motion.gap).toFixed(1)} metres.`);
}

function label(who, speed, acceleration, isNarrow) {
  const moves = acceleration < BRAKES ? " – braking" : "";
  const does = speed < 0.05 ? " – stands" : moves;
  const kmh = isNarrow ? "" : ` (${(speed * 3.6).toFixed(0)} km/h)`;
  return `${who} ${speed.toFixed(1)} m/s${kmh}${does}`;
}

function drawCar(pen, front, middle, length, height, ink, brakes) {
  const rear = front - length, top = middle - height / 2;
  pen.fillStyle = ink;
  pen.strokeStyle = colour.paint;
  pen.lineWidth = 1;
  pen.beginPath();
  pen.roundRect(rear, top, length, height, Math.min(6, length / 4));
  pen.fill();
  pen.stroke();
  pen.fillStyle = "rgb(255 255 255 / 0.45)"; // windscreen and rear window, seen from above
  pen.fillRect(rear + length * 0.66, top + height * 0.14, length * 0.12, height * 0.72);
  pen.fillRect(rear + length * 0.14, top + height * 0.18, length * 0.08, height * 0.64);
  const lamp = Math.max(3, length * 0.07);
  for (const y of [top + 1, top + height * 0.72]) {
    if (brakes) {
      pen.shadowColor = "#ff3b30";
      pen.shadowBlur = 12;
    }
    pen.fillStyle = brakes ? "#ff3b30" : "#6b2020";
    pen.fillRect(rear - lamp / 2, y, lamp, height * 0.28 - 1);
    pen.shadowBlur = 0;
  }
}

function drawGap(pen, from, to, y, top, gap) {
  if (to - from > 6) {
    line(pen, from + 2, y, to - 2, y, { ink: colour.paint, width: 1.5 });
    for (const x of [from + 2, to - 2]) line(pen, x, y - 5, x, y + 5, { ink: colour.paint, width: 1.5 });
  }
  const middle = (from + to) / 2;
  line(pen, middle, top - 7, middle, y, { ink: colour.soft });
  const words = gap > 0 ? `gap ${gap.toFixed(1)} m` : "collision";
  text(pen, words, middle, top - 14, { size: 12.5, bold: true, align: "center", ink: gap > 0 ? colour.ink : colour.danger });
}

function drawScale(pen, position, front, scale, width, top, height) {
  const step = [5, 10, 20, 50, 100].find((metres) => metres * scale > 58) ?? 200;
  const first = Math.ceil((position - front / scale) / step) * step;
  for (let at = first; ; at += step) {
    const x = front + (at - position) * scale;
    if (x > width) break;
    line(pen, x, top, x, top + 5, { ink: colour.soft });
    if (at >= 0) text(pen, `${at} m`, x, (top + height) / 2 + 2, { size: 11, align: "center", ink: colour.soft });
  }
}

function drawCollision(pen, x, y, size) {
  pen.beginPath();
  for (let k = 0; k < 18; k++) {
    const radius = size * (k % 2 ? 0.55 : 1.15);
    const angle = (k * Math.PI) / 9;
    pen.lineTo(x + radius * Math.cos(angle), y + radius * Math.sin(angle));
  }
  pen.closePath();
  pen.fillStyle = "#ffd23f";
  pen.strokeStyle = "#8a1c00";
  pen.lineWidth = 2;
  pen.fill();
  pen.stroke();
  text(pen, "✕", x, y + 1, { size: 18, bold: true, align: "center", ink: "#8a1c00" });
}
