// The run as far as it is known here: its frames, its states, and the time that is shown of it.

export class Run {
  constructor() {
    this.start = null;
    this.clock = { paused: false, speed: 1, revising: true, over: false };
    this.frames = [];
    this.graphs = [];
    this.known = { plane: [0, 1], survived: [], failed: [], forms: [], dead_ends: [], radii: [], told: "", harm: "", limits: [] };
    this.shown = 0; // the time that is shown [s]
    this.isLive = true; // or what is shown is the past
  }

  take(message) {
    switch (message.kind) {
      case "start":
        this.start = message;
        this.frames = [];
        this.graphs = [];
        this.shown = 0;
        this.isLive = true;
        break;
      case "frame": this.frames.push(message); break;
      case "graph": this.graphs.push(message); break;
      case "known": this.known = message; break;
      case "clock": this.clock = message; break;
    }
  }

  get latest() { return this.frames[this.frames.length - 1]; }

  /** Move on by so many seconds of real time: smoothly, one decision behind what has come. */
  play(seconds) {
    if (!this.isLive || !this.latest) return;
    const behind = this.latest.time - this.shown;
    const interval = this.start.interval;
    const speed = this.clock.speed ?? 1e3;
    let rate = 1;
    if (behind > 1.8 * interval) rate = behind / interval;
    else if (behind < 0.2 * interval) rate = behind / (0.2 * interval);
    if (this.clock.paused || this.clock.over) rate = Math.max(rate, 4);
    this.shown = Math.min(this.latest.time, this.shown + seconds * speed * rate);
  }

  see(time) {
    if (!this.latest) return;
    this.isLive = false;
    this.shown = Math.max(0, Math.min(time, this.latest.time));
  }

  /** So many decisions back or on; beyond the last it is now again. */
  stepBy(count) {
    const at = this.index(this.shown + 1e-6) + count;
    if (at >= this.frames.length) this.goLive();
    else this.see(this.frames[Math.max(0, at)].time);
  }

  goLive() {
    this.isLive = true;
    if (this.latest) this.shown = Math.max(this.shown, this.latest.time - this.start.interval);
  }

  /** The last frame at or before a time. */
  index(time) {
    let low = 0, high = this.frames.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.frames[middle].time <= time) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  get frame() { return this.frames[this.index(this.shown + 1e-6)]; }

  /** The last decision that is shown: a run's end decides nothing. */
  get decision() {
    const at = this.index(this.shown + 1e-6);
    const frame = this.frames[at];
    return frame && frame.over && at > 0 ? this.frames[at - 1] : frame;
  }

  get graph() {
    const now = this.frame ? this.frame.number + 1 : 0;
    let found = this.graphs[0];
    for (const graph of this.graphs) if (graph.number <= now) found = graph;
    return found;
  }

  /** The frames before and after the time that is shown, and how much of the way is done. */
  get between() {
    const at = this.index(this.shown + 1e-6);
    const [from, to] = [this.frames[at], this.frames[at + 1] ?? this.frames[at]];
    const span = to.time - from.time;
    return { from, to, span, part: span > 0 ? Math.min(1, Math.max(0, (this.shown - from.time) / span)) : 0 };
  }

  /** What is observed at that time. */
  get observation() {
    const { from, to, part } = this.between;
    return from.observation.map((value, k) => (value === null ? null : value + part * (to.observation[k] - value)));
  }

  /** Where cars are at that time, between two frames as a constant acceleration. */
  get motion() {
    const { from, to, span, part } = this.between;
    const [old, next] = [from.cars, to.cars];
    if (!old || from === to) return old;
    const between = (name) => old[name] + part * (next[name] - old[name]);
    const bend = 0.5 * part * (1 - part) * span; // of a position whose speed changes evenly
    const own = next.v_follower - old.v_follower, others = next.v_leader - old.v_leader;
    return {
      ...old,
      v_follower: between("v_follower"),
      v_leader: between("v_leader"),
      x_follower: between("x_follower") - bend * own,
      gap: between("gap") - bend * (others - own),
      gap_behind: old.gap_behind === null ? null : between("gap_behind"),
      a_follower: next.a_follower,
      a_leader: next.a_leader,
    };
  }
}
