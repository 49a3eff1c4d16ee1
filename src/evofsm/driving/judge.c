/* The kinematic judge for cars in C: judge.py, rehearsal.py and perception.py as a frozen guard asks
   them, and of ActionReviser what decides by risks. An observation is gap [m], own speed and the
   leader's [m/s]; an action an acceleration [m/s²]. */
/* ==== state ==== */
  double before, commanded;              /* the latest two commands [m/s²] */
  double mean[3], spread[3][3];          /* where one most likely was, and how sure that is */
  double here[3], around[3][3];          /* the same now */
  int is_located, n_blind; /* whether that is known; observations on end that lack something */
  int revising, tries;
  double options[EVOFSM_OPTIONS], risk[EVOFSM_OPTIONS], critical[EVOFSM_OPTIONS];
/* ==== source ==== */
/* -- Perception: estimate and _filtered ---------------------------------------------------------- */

static int is_whole(const double three[3]) { return !isnan(three[0] + three[1] + three[2]); }

/* What the latest command brings until the next decision, most likely [m/s²]. */
static double expected(const evofsm_state *s) {
  const double last = greater(s->before, -LIKELY), asked = greater(s->commanded, -LIKELY);
  return LAG * last + (1.0 - LAG) * asked;
}

/* Where it is seen to be, and how sure that is. */
static void begin_at(evofsm_state *s, const double now[3], int is_sure) {
  int j;
  memcpy(s->here, now, sizeof s->here);
  memset(s->around, 0, sizeof s->around);
  for (j = 0; j < 3 && !is_sure; j++) {
    s->around[j][j] = noise[j] * noise[j];
  }
}

/* One step of the Kalman filter, from s->mean and s->spread. */
static void filter(evofsm_state *s, const double now[3]) {
  const double gap = s->mean[0], own = s->mean[1], leader = s->mean[2], dt = EVOFSM_INTERVAL;
  const double reached = greater(own + expected(s) * dt, 0.0), half = 0.5 * dt;
  const double vv = s->spread[1][1], vu = s->spread[1][2], uu = s->spread[2][2];
  const double v = (DOUBT * dt) * (DOUBT * dt), u = (LEADER * dt) * (LEADER * dt);
  double gv = s->spread[0][1], gu = s->spread[0][2], gg = s->spread[0][0], to_v, to_u;
  double *at = s->here, row[3];
  int i, j, k;
  to_v = gv + (vu - vv) * dt;
  to_u = gu + (uu - vu) * dt;
  gg += 2.0 * (gu - gv) * dt + (uu - 2.0 * vu + vv) * dt * dt;
  gg += half * half * (v + u) + UNEVEN * UNEVEN;
  gv = to_v - half * v;
  gu = to_u + half * u;
  at[0] = gap + (leader - 0.5 * (own + reached)) * dt;
  at[1] = reached;
  at[2] = leader;
  s->around[0][0] = gg;
  s->around[0][1] = s->around[1][0] = gv;
  s->around[0][2] = s->around[2][0] = gu;
  s->around[1][1] = vv + v;
  s->around[1][2] = s->around[2][1] = vu;
  s->around[2][2] = uu + u;
  for (i = 0; i < 3; i += 2) { /* it belongs to another leader */
    const double off = now[i] - at[i], variance = s->around[i][i] + noise[i] * noise[i];
    if (is_whole(now) && off * off > ANOTHER * ANOTHER * variance) {
      begin_at(s, now, 0);
      return;
    }
  }
  for (i = 0; i < 3; i++) {
    if (!isnan(now[i])) {
      const double total = s->around[i][i] + noise[i] * noise[i], off = (now[i] - at[i]) / total;
      memcpy(row, s->around[i], sizeof row);
      for (j = 0; j < 3; j++) {
        const double gain = row[j] / total;
        at[j] += row[j] * off;
        for (k = 0; k < 3; k++) {
          s->around[j][k] -= gain * row[k];
        }
      }
    }
  }
  at[1] = greater(at[1], 0.0);
  at[2] = at[2] < ONCOMING ? at[2] : greater(at[2], 0.0);
}

static void locate(evofsm_state *s, const double now[3]) {
  const int is_sure = EXACT && is_whole(now);
  if (s->is_located && !is_sure) {
    filter(s, now);
  } else {
    begin_at(s, now, is_sure);
  }
}

/* LatentRisk._cautious: closer by what is not sure about it. */
static void be_cautious(const evofsm_state *s, double cautious[3]) {
  const double weights[3] = {1.0, -s->here[1] / DECEL, s->here[2] / DECEL};
  double variance = 0.0;
  int i, j;
  for (i = 0; i < 3; i++) {
    cautious[i] = s->here[i];
    for (j = 0; j < 3; j++) {
      variance += weights[i] * weights[j] * s->around[i][j];
    }
  }
  cautious[0] = greater(s->here[0] - CAUTION * sqrt(greater(variance, 0.0)),
                        lesser(s->here[0], ALMOST));
}

/* -- Rehearsal: survives and critical_decelerations ---------------------------------------------- */

/* Distance covered in a time; the speed is changed. No one drives backwards. */
static double drive_on(double *speed, double acceleration, double dt) {
  const double was = *speed, reached = was + acceleration * dt;
  *speed = reached >= 0.0 ? reached : 0.0;
  return reached >= 0.0 ? 0.5 * (was + reached) * dt : -0.5 * was * was / acceleration;
}

/* Whether no collision comes of an acceleration and full braking after it, for a smallest gap; who
   comes towards oneself stands, approached faster. */
static int survives(const double here[3], double acceleration, double before, double leader_decel,
                    double clearance) {
  const double caution = -DECEL;
  double speed = greater(here[1], 0.0) - (here[2] < ONCOMING ? here[2] : 0.0);
  double gap = here[0] - clearance, leader = greater(here[2], 0.0);
  double asked = greater(acceleration, caution), last = LAG > 0.0 ? greater(before, caution) : asked;
  double left, closing;
  int t;
  if (speed <= 0.0 && greater(asked, last) <= 0.0) {
    return here[0] > 0.0;
  }
  for (t = 0; t < 2 && gap > 0.0 && !(asked == caution && last == caution); t++) {
    const double mean = LAG * last + (1.0 - LAG) * asked, gain = -leader_decel - mean;
    closing = speed - leader;
    if (closing > 0.0 && closing < gain * EVOFSM_INTERVAL &&
        leader * gain > leader_decel * closing && gap <= 0.5 * closing * closing / gain) {
      return 0;
    }
    gap += drive_on(&leader, -leader_decel, EVOFSM_INTERVAL) -
           drive_on(&speed, mean, EVOFSM_INTERVAL);
    last = asked;
    asked = caution;
  }
  if (leader_decel >= DECEL || speed * leader_decel > leader * DECEL) {
    left = 0.5 * leader * leader / leader_decel - 0.5 * speed * speed / DECEL;
    return gap + lesser(left, 0.0) > 0.0;
  }
  closing = greater(speed - leader, 0.0);
  return gap - 0.5 * closing * closing / (DECEL - leader_decel) > 0.0;
}

/* The hardest braking of the leader that is survived [m/s²]. */
static double critical_of(const double here[3], double acceleration, double before) {
  double low = 0.0, high = HARDEST;
  int i;
  if (survives(here, acceleration, before, high, CLEARANCE)) {
    return HARDEST;
  }
  for (i = 0; i < HALVINGS; i++) {
    const double between = 0.5 * (low + high);
    const int is_survived = survives(here, acceleration, before, between, CLEARANCE);
    low = is_survived ? between : low;
    high = is_survived ? high : between;
  }
  return low;
}

/* foresee: whether full braking after an acceleration avoids what is seen, and whether it, held for
   a time, has regained a safe gap. */
static int avoids(const double here[3], double acceleration, double before, double braking) {
  const double near[3] = {greater(here[0], TOUCHING), here[1], here[2]};
  return survives(near, acceleration, before, braking, lesser(CLEARANCE, 0.5 * near[0]));
}

static int regains(const double here[3], double acceleration, double braking) {
  double then[3] = {here[0], greater(here[1], 0.0), greater(here[2], 0.0)};
  then[0] += drive_on(&then[2], -braking, REGAIN);
  then[0] -= drive_on(&then[1], acceleration, REGAIN);
  return then[0] > CLEARANCE && survives(then, 0.0, acceleration, WORST, CLEARANCE);
}

/* LatentRisk._leader_braking: since the observation before, if it is the same leader. */
static double leader_braking(const evofsm_state *s) {
  const double *was = s->mean, *now = s->here, dt = EVOFSM_INTERVAL;
  const double expected_gap = was[0] + 0.5 * dt * (was[2] + now[2] - was[1] - now[1]);
  if (!s->is_located || fabs(now[2] - was[2]) > HARDEST * dt + ANOTHER_SPEED ||
      fabs(now[0] - expected_gap) > ANOTHER_GAP) {
    return 0.0;
  }
  return greater((was[2] - now[2]) / dt, 0.0);
}

/* _interpolated: how likely a leader brakes harder, by the table. At most TABLE halvings. */
static double harder_than(double x) {
  int low = 0, high = TABLE - 1;
  if (x >= harder[0][high]) {
    return harder[1][high];
  }
  while (high - low > 1) {
    const int between = (low + high) / 2;
    low = harder[0][between] <= x ? between : low;
    high = harder[0][between] <= x ? high : between;
  }
  return (harder[1][high] - harder[1][low]) / (harder[0][high] - harder[0][low]) *
             (x - harder[0][low]) + harder[1][low];
}

/* wilson_bounds */
static void bounds(double share, double *low, double *high) {
  const double spread = 1.645 * 1.645 / (EVIDENCE + 1.0);
  const double centre = (share + 0.5 * spread) / (1.0 + spread);
  const double reach = sqrt(spread * (share * (1.0 - share) + 0.25 * spread)) / (1.0 + spread);
  *low = greater(centre - reach, 0.0);
  *high = lesser(centre + reach, 1.0);
}

/* -- The reviser: ActionReviser._decide ---------------------------------------------------------- */

/* Of options whose risk is tolerated the closest to an action, of equals the first; -1: none is. */
static int closest(const evofsm_state *s, double action, double tolerated) {
  int i, best = -1;
  for (i = 0; i < EVOFSM_OPTIONS; i++) {
    const double off = fabs(s->options[i] - action);
    if (s->risk[i] <= tolerated && (best < 0 || off < fabs(s->options[best] - action))) {
      best = i;
    }
  }
  return best;
}

/* in_proportion: the closest gentle one that is tolerable or regains a safe gap, else the least
   braking beyond that avoids what is seen; -1: none. */
static int in_proportion(const evofsm_state *s, const double here[3], double limit, int *reason) {
  const double braking = lesser(leader_braking(s), WORST), wanted = s->options[0];
  int i, k, passes[3], best[3] = {-1, -1, -1};
  for (i = 0; i < EVOFSM_OPTIONS; i++) {
    const double option = s->options[i], off = fabs(option - wanted);
    const int is_gentle = option >= lesser(-COMFORT, wanted);
    const int is_lower = option <= wanted && avoids(here, option, s->commanded, braking);
    const int is_soon = is_gentle && is_lower && regains(here, option, braking);
    passes[0] = is_soon || (is_gentle && s->risk[i] <= limit);
    passes[1] = is_soon || (is_gentle && s->risk[i] <= TOLERANCE);
    passes[2] = is_lower && option <= -COMFORT;
    for (k = 0; k < 3; k++) {
      best[k] = passes[k] && (best[k] < 0 || off < fabs(s->options[best[k]] - wanted)) ? i : best[k];
    }
  }
  i = best[0] >= 0 ? best[0] : best[1] >= 0 ? best[1] : best[2];
  if (i >= 0 && !(s->risk[i] <= TOLERANCE)) {
    *reason = (regains(here, s->options[i], braking) ? EVOFSM_REGAINS : EVOFSM_AVOIDS) + (i != 0);
  }
  return i;
}

static int decide_by_risk(evofsm_state *s, const double here[3], int *reason) {
  const double limit = TOLERANCE * (s->revising ? RELEASE : 1.0);
  int i, least = 0, best;
  *reason = EVOFSM_TRIED;
  if (s->tries > 0 && !KNOWN) {
    s->tries--;
    *reason = EVOFSM_TRYING;
    return closest(s, LOWEST, INFINITY);
  }
  if (s->risk[0] <= limit) {
    s->revising = 0;
    *reason = EVOFSM_KEPT;
    return 0;
  }
  s->revising = 1;
  if (!KNOWN && ACTS) {
    s->tries = TRIAL;
    return closest(s, LOWEST, INFINITY);
  }
  *reason = EVOFSM_CHANGED;
  best = is_whole(here) && here[2] >= ONCOMING ? in_proportion(s, here, limit, reason) : -1;
  if (best >= 0) {
    s->revising = best != 0;
    return best;
  }
  best = closest(s, s->options[0], limit);
  best = best < 0 ? closest(s, s->options[0], TOLERANCE) : best;
  if (best >= 0) {
    return best;
  }
  for (i = 1; i < EVOFSM_OPTIONS; i++) {
    const int is_lower = s->risk[i] == s->risk[least] && s->options[i] < s->options[least];
    least = s->risk[i] < s->risk[least] || is_lower ? i : least;
  }
  *reason = EVOFSM_NOTHING_PASSES;
  return least;
}

static void forget(evofsm_state *s) {
  s->before = s->commanded = 0.0;
  s->is_located = s->n_blind = 0;
}

/* What to execute of s->proposal, into s->best, and how risky that is. */
static void revise(evofsm_state *s, evofsm_decision *out) {
  const int stands = !ACTS && s->observation[1] < STANDS;
  double here[3];
  int i, best;
  locate(s, s->observation);
  be_cautious(s, here);
  s->tries = ACTS ? s->tries : 0;
  for (i = 0; i < EVOFSM_OPTIONS; i++) {
    s->options[i] = lesser(greater(s->proposal[0], option_low[i]), option_high[i]);
    s->options[i] = stands ? greater(s->options[i], lesser(s->options[0], 0.0)) : s->options[i];
    s->critical[i] = is_whole(here) ? critical_of(here, s->options[i], s->commanded) : 0.0;
    s->risk[i] = is_whole(here) ? harder_than(s->critical[i]) : 1.0;
  }
  best = decide_by_risk(s, here, &out->reason);
  s->best[0] = s->options[best];
  out->evidence = EVIDENCE;
  out->risk_proposed = s->risk[0];
  best = ACTS ? best : 0;
  out->risk_executed = s->risk[best];
  out->left = s->critical[0];
  out->risk_low = 0.0;
  out->risk_high = 1.0;
  if (is_whole(here)) {
    bounds(s->risk[best], &out->risk_low, &out->risk_high);
  }
  if (s->n_blind + 1 >= BLIND && !is_whole(s->observation)) {
    out->risk_proposed = out->risk_executed = out->risk_low = out->risk_high = NAN;
    out->evidence = 0.0;
  }
}

static void follow(evofsm_state *s, const double executed[EVOFSM_ACTIONS]) {
  s->n_blind = is_whole(s->observation) ? 0 : s->n_blind + 1;
  if (is_whole(s->here)) {
    s->is_located = 1;
    memcpy(s->mean, s->here, sizeof s->mean);
    memcpy(s->spread, s->around, sizeof s->spread);
  }
  s->before = s->commanded;
  s->commanded = executed[0];
}
