/* The learnt judge: rollout.py, and of judge.py what a frozen guard asks of it, in C.

   Rollouts of all disturbances lie side by side: loops over them (l) have EVOFSM_LANES turns. Sums
   are in the order of Python, so that a compiler that contracts nothing comes to the same bits. */
/* ==== state ==== */
  /* Observation, its change, and the action before; the observation that is expected next. */
  double here[2 * EVOFSM_VARIABLES + EVOFSM_NUMBERS], next[EVOFSM_VARIABLES];
  /* Observations of the last step, the oldest first, and what was done there. */
  double past[EVOFSM_STRIDE][EVOFSM_VARIABLES], acted[EVOFSM_STRIDE][EVOFSM_NUMBERS];
  int n_past, is_placed;         /* how many there are; and whether one knows where one is now */
  int n_blind, lacks, is_new;    /* rows on end that lack something; whether this one does, or is far */
  int ranks[EVOFSM_BACKUPS], done; /* backups, those first that passed last; steps of a search */
  /* Room of a rollout. */
  double z[EVOFSM_VARIABLES][EVOFSM_LANES], change[EVOFSM_VARIABLES][EVOFSM_LANES];
  double move[EVOFSM_VARIABLES][EVOFSM_LANES];
  double before[EVOFSM_NUMBERS][EVOFSM_LANES], now[EVOFSM_NUMBERS][EVOFSM_LANES];
  double found[EVOFSM_FEATURES][EVOFSM_LANES];
  double near[EVOFSM_LANES], far[EVOFSM_LANES], value[EVOFSM_LANES];
  double over[EVOFSM_LANES], last[EVOFSM_LANES], square[EVOFSM_LANES];
  double worth; /* mean of how well it ended */
  int survived[EVOFSM_LANES];
  double aside[EVOFSM_DEAD_ENDS + 1]; /* infinite of dead ends that do not count */
/* ==== source ==== */
#define M EVOFSM_VARIABLES
#define A EVOFSM_NUMBERS
#define P EVOFSM_FEATURES
#define L EVOFSM_LANES
#define K DISTURBANCES

/* -- Actions: encode and decode of judge.py ---------------------------------------------------- */

static void encode(const double action[EVOFSM_ACTIONS], double inner[A]) {
  int i;
  for (i = 0; i < A; i++) {
#if EVOFSM_CHOICES > 0
    inner[i] = action[0] == (double)i ? 1.0 : 0.0;
#else
    inner[i] = (action[i] - middle[i]) / half[i];
#endif
  }
}

static void decode(const double inner[A], double action[EVOFSM_ACTIONS]) {
  int i;
#if EVOFSM_CHOICES > 0
  int best = 0;
  for (i = 1; i < A; i++) {
    best = inner[i] > inner[best] ? i : best;
  }
  action[0] = best;
#else
  for (i = 0; i < A; i++) {
    action[i] = lesser(greater(middle[i] + half[i] * inner[i], action_low[i]), action_high[i]);
  }
#endif
}

/* -- A rollout ---------------------------------------------------------------------------------- */

/* _fill_features: those of situations and actions side by side, into s->found. */
static void fill_features(evofsm_state *s, double harder) {
  static const double knots[3] = {-0.5, 0.0, 0.5};
  int i, j, k, l;
  fill(s->found[0], L, 1.0);
  for (j = 0; j < M; j++) {
    const double largest = harder * reach[j];
    for (l = 0; l < L; l++) {
      s->found[1 + j][l] = s->z[j][l] - origin[j];
      s->found[1 + M + j][l] = fabs(s->change[j][l]) <= largest ? s->change[j][l] : 0.0;
    }
  }
  k = 1 + 2 * M;
  for (i = 0; i < A; i++) {
    memcpy(s->found[k + i], s->now[i], sizeof s->now[i]);
    memcpy(s->found[k + A + i], s->before[i], sizeof s->before[i]);
  }
  k += 2 * A;
  for (i = 0; i < (EVOFSM_CHOICES > 0 ? 0 : A); i++) {
    for (j = 0; j < 3; j++) {
      for (l = 0; l < L; l++) {
        s->found[k][l] = fabs(s->now[i][l] - knots[j]);
      }
      k++;
    }
  }
  for (i = 0; i < CROSSED; i++) {
    for (j = 0; j < M; j++) {
      for (l = 0; l < L; l++) {
        s->found[k][l] = s->now[i][l] * s->found[1 + j][l];
      }
      k++;
    }
  }
  for (i = 0; i < PAIRED; i++) {
    for (j = i; j < M; j++) {
      for (l = 0; l < L; l++) {
        s->found[k][l] = s->found[1 + i][l] * s->found[1 + j][l];
      }
      k++;
    }
  }
}

/* _expect: the changes that are expected of features, into s->move. */
static void expect(evofsm_state *s) {
  int j, k, l;
  for (k = 0; k < P; k++) {
    for (j = 0; j < M; j++) {
      const double weight = weights[k][j];
      for (l = 0; l < L; l++) {
        s->move[j][l] = (k > 0 ? s->move[j][l] : 0.0) + s->found[k][l] * weight;
      }
    }
  }
}

/* _follow: actions of a backup, saturated at end, or the largest of few. */
static void follow_policy(evofsm_state *s, const double policy[A][1 + M], double end) {
  int i, j, l;
  for (i = 0; i < A; i++) {
    double *now = s->now[i];
    fill(now, L, policy[i][0]);
    for (j = 0; j < M; j++) {
      const double slope = policy[i][1 + j], middle_of = mean[j], over = inverse[j];
      for (l = 0; l < L; l++) {
        now[l] += slope * (s->z[j][l] - middle_of) * over;
      }
    }
    if (EVOFSM_CHOICES == 0) {
      for (l = 0; l < L; l++) {
        now[l] = lesser(end, greater(-end, now[l]));
      }
    }
  }
  if (EVOFSM_CHOICES > 0) {
    for (l = 0; l < L; l++) {
      int best = 0;
      for (i = 1; i < A; i++) {
        best = s->now[i][l] > s->now[best][l] ? i : best;
      }
      for (i = 0; i < A; i++) {
        s->now[i][l] = i == best ? 1.0 : 0.0;
      }
    }
  }
}

/* _from_centre: squared distances from the centre of a dead end, in spreads, into s->square. */
static void from_centre(evofsm_state *s, int end) {
  int j, l;
  for (j = 0; j < M; j++) {
    for (l = 0; l < L; l++) {
      const double x = (s->z[j][l] - dead_ends[end][j]) * inverse[j];
      s->square[l] = (j > 0 ? s->square[l] : 0.0) + x * x;
    }
  }
}

/* _measure: distances to the nearest failure, into s->far, and to where it ends by itself, into
   s->over. */
static void measure(evofsm_state *s) {
  int f, l;
  fill(s->far, L, INFINITY);
  fill(s->over, L, INFINITY);
  fill(s->last, L, INFINITY);
  for (f = 0; f < FORMS; f++) {
    const double says = forms[f][0], *z = s->z[(int)forms[f][1]], *other_z = s->z[(int)forms[f][2]];
    const double at = forms[f][3], to = forms[f][4], one = forms[f][5], other = forms[f][6];
    const double c = forms[f][7], b = forms[f][8], d = forms[f][9];
    const double p = forms[f][10], q = forms[f][11], r = forms[f][12];
    if (p == 0.0 && q == 0.0 && r == 0.0) {
      for (l = 0; l < L; l++) {
        s->square[l] = -(c + b * (z[l] - at) * one + d * (other_z[l] - to) * other);
      }
    } else {
      const double grown = says == FAILS ? GROWN : 0.0;
      for (l = 0; l < L; l++) {
        const double x = (z[l] - at) * one, y = (other_z[l] - to) * other;
        const double form = c + x * (b + p * x + q * y) + y * (d + r * y);
        const double u = b + 2.0 * p * x + q * y, v = d + 2.0 * r * y + q * x;
        s->square[l] = -form / sqrt(u * u + v * v + FLAT) - grown;
      }
    }
    for (l = 0; l < L; l++) {
      if (says == ENDS) { /* what crashes there follows it */
        const int is_first = f == 0 || forms[f - 1][0] != ENDS;
        s->last[l] = is_first || s->square[l] < s->last[l] ? s->square[l] : s->last[l];
        s->over[l] = s->square[l] < s->over[l] ? s->square[l] : s->over[l];
      } else {
        const double crash = greater(s->last[l] - GROWN, s->square[l]);
        const double left = says == CRASHES ? crash : s->square[l];
        s->far[l] = left < s->far[l] ? left : s->far[l];
      }
    }
  }
  for (f = 0; f < EVOFSM_DEAD_ENDS; f++) {
    from_centre(s, f);
    for (l = 0; l < L; l++) {
      const double off = sqrt(s->square[l]) - dead_ends[f][M];
      const double left = off * dead_ends[f][M + 1] + s->aside[f];
      s->far[l] = left < s->far[l] ? left : s->far[l];
    }
  }
}

/* A step of a rollout: what is expected, what disturbs it, and where that leads. */
static void step(evofsm_state *s, int t, double harder) {
  int j, l;
  fill_features(s, harder);
  expect(s);
  for (j = 0; j < M; j++) {
    const double low = harder * least[j], high = harder * most[j];
    for (l = 0; l < L; l++) {
      const double y = s->move[j][l] + harder * residuals[t][j][l];
      const double to = s->z[j][l] + lesser(greater(y, low), high);
      double after = lesser(greater(to, lowest[j]), highest[j]);
#if EVOFSM_LANDS
      after = residuals[t][M + j][l] < INFINITY ? residuals[t][M + j][l] : after;
#endif
      s->change[j][l] = after - s->z[j][l];
      s->z[j][l] = after;
    }
  }
  memcpy(s->before, s->now, sizeof s->before);
}

/* Where one is now, as all rollouts begin. */
static void place(evofsm_state *s) {
  int i, j;
  for (j = 0; j < M; j++) {
    fill(s->z[j], L, s->here[j]);
    fill(s->change[j], L, s->here[M + j]);
  }
  for (i = 0; i < A; i++) {
    fill(s->before[i], L, s->here[2 * M + i]);
  }
}

static void act(evofsm_state *s, const double action[A]) {
  int i;
  for (i = 0; i < A; i++) {
    fill(s->now[i], L, action[i]);
  }
}

/* _rollout, of one situation: an action first, if there is one, then a backup. Returns how many
   disturbances are not survived; into left the least distance of the others. At most STEPS steps. */
static int rollout(evofsm_state *s, const double *action, const double policy[A][1 + M],
                   double harder, double enough, int allowed, double *left) {
  const double end = 1.0 - RESERVE * enough;
  int l, t, lost = 0, ended = 0;
  place(s);
  fill(s->near, L, INFINITY);
  for (l = 0; l < L; l++) {
    s->survived[l] = l < K ? STEPS : -1;
  }
  for (t = 0; t < EVOFSM_DEAD_ENDS; t++) { /* those in which it begins may not count */
    int within;
    from_centre(s, t);
    within = s->square[0] < dead_ends[t][M] * dead_ends[t][M];
    s->aside[t] = within && allowed >= K ? INFINITY : 0.0;
  }
  for (t = 0; t < STEPS; t++) {
    int fails = 0;
    s->done++;
    if (t == 0 && action != NULL) {
      act(s, action);
    } else {
      follow_policy(s, policy, end);
    }
    step(s, t, harder);
    measure(s);
    for (l = 0; l < L; l++) {
      const double nearer = s->far[l] < s->near[l] ? s->far[l] : s->near[l];
      s->near[l] = s->survived[l] == STEPS ? nearer : s->near[l];
      fails += (s->survived[l] == STEPS) & (s->near[l] < enough);
    }
    for (l = 0; l < K && fails > 0; l++) {
      if (s->survived[l] == STEPS && s->near[l] < enough) {
        s->survived[l] = t;
        lost++;
        if (allowed < K && l == 0) {
          lost = K;
        }
      }
    }
    if (fails > 0 && (lost >= K || lost > allowed)) {
      break;
    }
    for (l = 0; l < K; l++) {
      if (s->survived[l] == STEPS && s->over[l] <= -SHRUNK) {
        s->survived[l] = STEPS + 1;
        ended++;
      }
    }
    if (ended > 0 && lost + ended >= K) {
      break;
    }
  }
  *left = INFINITY;
  s->worth = 0.0;
  for (l = 0; l < K; l++) {
    const int lasted = s->survived[l];
    const double share = (double)(lasted < STEPS ? lasted : STEPS) / (double)STEPS;
    const double distance = lasted == STEPS ? 0.5 * (s->near[l] + s->far[l]) : s->near[l];
    s->value[l] = lasted < STEPS ? (double)(lasted - STEPS) - 1.0 : s->near[l];
    if (s->near[l] >= enough) {
      *left = lesser(*left, s->near[l]);
    }
    s->worth += share + DISTANCE * lesser(1.0, greater(-1.0, FAR * distance));
  }
  s->worth /= (double)K;
  return lost;
}

/* -- What decides: search ----------------------------------------------------------------------- */

/* Whether a backup survives after an action, by the margin. */
static int passes(evofsm_state *s, const double action[A], int backup, double *left) {
  const int lost = rollout(s, action, policies[backup], SCALE, MARGIN, ALLOWED, left);
  return lost <= ALLOWED && *left >= MARGIN;
}

/* action_of: what a backup does here. */
static void action_of(evofsm_state *s, int backup, double action[A]) {
  int i;
  place(s);
  follow_policy(s, policies[backup], 1.0);
  for (i = 0; i < A; i++) {
    action[i] = s->now[i][0];
  }
}

static int are_same(const double one[A], const double other[A]) {
  int i, same = 1;
  for (i = 0; i < A; i++) {
    same &= one[i] == other[i];
  }
  return same;
}

/* From the proposal (inner) to the action: at most 2 ASKED + HALVINGS rollouts, or 4 ASKED. */
static int search(evofsm_state *s, const double proposal[A], double action[A], int *backup,
                  double *left) {
  double own[A], closer[A], refused = 0.0, share = 1.0, distance;
  double longest = -INFINITY, wanted = -INFINITY;
  int i, r, step_of;
  s->done = 0;
  memcpy(action, proposal, sizeof own);
  for (r = 0; r < ASKED && s->done < MOST_DONE; r++) {
    *backup = s->ranks[r];
    if (passes(s, proposal, *backup, left)) {
      return EVOFSM_KEPT;
    }
  }
  for (r = 0; r < ASKED; r++) {
    *backup = s->ranks[r];
    action_of(s, *backup, own);
    if (s->done >= MOST_DONE) {
      *backup = s->ranks[0];
      action_of(s, *backup, action);
      *left = INFINITY;
      return EVOFSM_CUT_SHORT;
    }
    if (are_same(own, proposal) || !passes(s, own, *backup, left)) {
      continue;
    }
    memcpy(action, own, sizeof own);
    for (step_of = 0; step_of < (EVOFSM_CHOICES > 0 ? 0 : HALVINGS); step_of++) {
      const double part = 0.5 * (refused + share);
      for (i = 0; i < A; i++) {
        closer[i] = proposal[i] + part * (own[i] - proposal[i]);
      }
      if (passes(s, closer, *backup, &distance)) {
        share = part;
        *left = distance;
        memcpy(action, closer, sizeof closer);
      } else {
        refused = part;
      }
    }
    return EVOFSM_CHANGED;
  }
  *backup = s->ranks[0];
  for (r = 0; r < ASKED; r++) {
    rollout(s, NULL, policies[s->ranks[r]], SCALE, 0.0, K, &distance);
    if (s->worth > longest + ROUNDING) {
      *backup = s->ranks[r];
      longest = s->worth;
    }
    rollout(s, proposal, policies[s->ranks[r]], SCALE, 0.0, K, &distance);
    wanted = greater(wanted, s->worth);
  }
  if (wanted < longest - NO_LONGER) {
    action_of(s, *backup, action);
  }
  *left = INFINITY;
  return EVOFSM_NOTHING_PASSES;
}

/* -- The judge: LearntRisk ---------------------------------------------------------------------- */

/* _foresee: disturbances not survived after an action, under the best of some backups; -1: it fails
   without any. At most JUDGED rollouts. */
static int foresee(evofsm_state *s, const double action[A]) {
  double best[L], left;
  int l, r, count = K;
  fill(best, L, -INFINITY);
  for (r = 0; r < JUDGED && count > 0; r++) {
    rollout(s, action, policies[s->ranks[r]], 1.0, 0.0, K, &left);
    count = 0;
    for (l = 0; l < K; l++) {
      best[l] = greater(best[l], s->value[l]);
      count += best[l] < 0.0;
    }
  }
  return best[0] < 0.0 ? -1 : count;
}

/* _here: where one is; what was not seen is taken to be as was expected. */
static void situate(evofsm_state *s) {
  const int n = s->n_past;
  int i, j, t;
  s->is_placed = 1;
  s->lacks = s->is_new = 0;
  for (j = 0; j < M; j++) {
    const double z = s->observation[j], times = n > 0 ? (double)EVOFSM_STRIDE / n : 0.0;
    s->lacks |= isnan(z) != 0;
    s->is_new |= z < usual[0][j] || z > usual[1][j];
    s->here[j] = isnan(z) ? s->next[j] : z; /* before one was whole: as it was last */
    s->here[M + j] = n > 0 ? (s->here[j] - s->past[0][j]) * times : 0.0;
    s->is_placed &= !isnan(s->here[j]);
  }
  for (i = 0; i < A; i++) {
    double sum = 0.0;
    for (t = 0; t < n; t++) {
      sum += s->acted[t][i];
    }
    s->here[2 * M + i] = n > 0 ? sum / n : 0.0;
  }
}

static void forget(evofsm_state *s) {
  int i;
  s->n_past = s->is_placed = s->n_blind = 0;
  fill(s->next, M, NAN);
  for (i = 0; i < EVOFSM_BACKUPS; i++) {
    s->ranks[i] = i;
  }
}

/* LearntRisk.search: what to execute of s->proposal, into s->best, and how risky that is. */
static void revise(evofsm_state *s, evofsm_decision *out) {
  double proposal[A], action[A];
  int r, is_known, unsurvived = 0;
  memcpy(s->best, s->proposal, sizeof s->best);
  situate(s);
  is_known = s->is_placed && !s->is_new && !(s->lacks && s->n_blind + 1 >= BLIND);
  out->evidence = is_known ? EVIDENCE : 0.0;
  if (!is_known) {
    out->reason = EVOFSM_NOTHING_SEEN;
    out->risk_proposed = out->risk_executed = out->risk_low = out->risk_high = out->seen = NAN;
  }
  if (!s->is_placed) {
    return;
  }
  out->seen = s->is_new ? 0.0 : out->seen;
  encode(s->proposal, proposal);
  out->reason = search(s, proposal, action, &out->backup, &out->left);
  for (r = 0; s->ranks[r] != out->backup; r++) { /* at most EVOFSM_BACKUPS: it is one of them */
  }
  memmove(s->ranks + 1, s->ranks, (size_t)r * sizeof *s->ranks);
  s->ranks[0] = out->backup; /* what passed now is asked first the next time */
  if (out->reason != EVOFSM_KEPT) {
    out->unsurvived = foresee(s, proposal);
    if (out->reason > EVOFSM_CHANGED || ALLOWED > 0) {
      unsurvived = foresee(s, action);
    }
    if (!are_same(action, proposal)) {
      decode(action, s->best);
    }
  } else if (ALLOWED > 0) {
    out->unsurvived = unsurvived = foresee(s, proposal);
  }
  out->evidence *= ENDS_SEEN || out->unsurvived >= 0;
  unsurvived = ACTS ? unsurvived : out->unsurvived;
  if (is_known) {
    out->risk_proposed = risks[1 + out->unsurvived][0];
    out->risk_executed = risks[1 + unsurvived][0];
    out->risk_low = risks[1 + unsurvived][1];
    out->risk_high = risks[1 + unsurvived][2];
  }
}

/* LearntRisk.follow: keep up with what is executed, and what is expected then, undisturbed. */
static void follow(evofsm_state *s, const double executed[EVOFSM_ACTIONS]) {
  int j;
  s->n_blind = s->lacks ? s->n_blind + 1 : 0;
  if (!s->is_placed) {
    memcpy(s->next, s->here, sizeof s->next);
  } else {
    if (s->n_past == EVOFSM_STRIDE) {
      memmove(s->past, s->past + 1, sizeof s->past - sizeof s->past[0]);
      memmove(s->acted, s->acted + 1, sizeof s->acted - sizeof s->acted[0]);
    }
    s->n_past += s->n_past < EVOFSM_STRIDE;
    memcpy(s->past[s->n_past - 1], s->here, sizeof s->past[0]);
    encode(executed, s->acted[s->n_past - 1]);
    place(s);
    act(s, s->acted[s->n_past - 1]);
    step(s, 0, 1.0);
    for (j = 0; j < M; j++) {
      s->next[j] = s->here[j] + (s->z[j][0] - s->here[j]) / EVOFSM_STRIDE;
    }
  }
}
