/* What is the same for every judge: guard.py and reviser.py in C, in three files.

   `evofsm export` (export.py) puts what was learnt before it. Whoever changes a rule in Python
   changes it here; tests/guard/test_export.py holds the two together. */
/* ==== evofsm.h ==== */
#ifdef __cplusplus
extern "C" {
#endif

/* What evofsm_decide returns. But for EVOFSM_OK nothing has changed, and nothing was written. */
enum {
  EVOFSM_OK = 0,
  EVOFSM_UNUSABLE = 1, /* an entry of the observation is infinite, or beyond 1e30 */
  EVOFSM_MISSING = 2   /* one is NaN, and the guard rejects that */
};

/* Why something is executed. */
enum {
  EVOFSM_KEPT = 0,           /* the proposal passes */
  EVOFSM_CHANGED = 1,        /* it does not; this is the closest that passes */
  EVOFSM_CUT_SHORT = 2,      /* none passed within the bound of the search */
  EVOFSM_NOTHING_PASSES = 3, /* the one that lasts longest, or is least risky */
  EVOFSM_NOTHING_SEEN = 4,   /* nothing of this episode was observed yet: the proposal */
  EVOFSM_TRIED = 5,          /* cars: own brakes are not known yet, so it brakes in full */
  EVOFSM_TRYING = 6          /* and goes on with it for a while */
};

/* What had to be done to a proposal. */
enum { EVOFSM_AS_PROPOSED = 0, EVOFSM_OUTSIDE = 1, EVOFSM_NO_PROPOSAL = 2 };

/* What was wrong with an observation: a sum. */
enum {
  EVOFSM_PARTIAL = 1,  /* entries are NaN */
  EVOFSM_HELD = 2,     /* the same, where the guard holds values */
  EVOFSM_GAP = 4,      /* it came long after the one before */
  EVOFSM_REPEATED = 8, /* as old as the one before: that one stands */
  EVOFSM_LATE = 16     /* older than that */
};

typedef struct {
  double executed[EVOFSM_ACTIONS]; /* to be executed */
  double advised[EVOFSM_ACTIONS];  /* what would be, if the guard may not act (mode shadow) */
  double risk_proposed, risk_executed; /* probability of failure; NaN: not judged */
  double risk_low, risk_high;          /* 90 % interval of risk_executed */
  double evidence;                     /* number of disturbances that this rests on */
  double seen;                         /* time spent in such states [s]; NaN: not known */
  double left; /* learnt: what is left of the distance to failure, if it passes [ordinary changes];
                  cars: the hardest braking of the leader that the proposal survives [m/s²] */
  int reason, remark, intake, is_new;  /* codes as above; 1: never seen before */
  int state;                           /* from 0; -1: none is known */
  int backup;                          /* learnt: after which it passes, or lasts; -1: none */
  int unsurvived; /* learnt: disturbances not survived after the proposal; -1: not even none */
  int dead_end, backup_near; /* learnt: the dead end, from 0, to which it would come too near, and
                                after which backup, where the proposal would else pass; -1: none */
} evofsm_decision;

/* Of one stream of observations. Whoever calls owns it, and leaves what is in it alone; its size is
   all the memory that there is. */
typedef struct {
  double held[EVOFSM_VARIABLES], observation[EVOFSM_VARIABLES];
  double time, decisions, seen;
  double belief[EVOFSM_STATES > 0 ? EVOFSM_STATES : 1]; /* distribution over states */
  double proposal[EVOFSM_ACTIONS], best[EVOFSM_ACTIONS];
  int state;
  EVOFSM_JUDGE
} evofsm_state;

/* An episode begins with the next decision. To be called before the first one, too. */
void evofsm_reset(evofsm_state *state);

/* Decide on an observation, EVOFSM_INTERVAL seconds after the one before; NaN: not seen. */
int evofsm_decide(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                  const double proposal[EVOFSM_ACTIONS], evofsm_decision *out);

/* The same of an observation at a time [s] since the episode began. */
int evofsm_decide_at(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                     const double proposal[EVOFSM_ACTIONS], double time, evofsm_decision *out);

#ifdef __cplusplus
}
#endif
/* ==== evofsm.hpp ==== */
#ifndef EVOFSM_HPP
#define EVOFSM_HPP

#include <array>
#include <optional>

#include "evofsm.h"

namespace evofsm {

using Observation = std::array<double, EVOFSM_VARIABLES>;  // NaN where not seen
using Action = std::array<double, EVOFSM_ACTIONS>;
using Decision = evofsm_decision;

// A guard of one stream of observations. It asks for no memory and throws nothing.
class Guard {
 public:
  Guard() noexcept { reset(); }

  // An episode begins.
  void reset() noexcept { evofsm_reset(&state_); }

  // What to execute; empty where the observation cannot be used: then nothing has changed.
  std::optional<Decision> decide(const Observation& observation, const Action& proposal) noexcept {
    Decision decision;
    const int rc = evofsm_decide(&state_, observation.data(), proposal.data(), &decision);
    return rc == EVOFSM_OK ? std::optional<Decision>(decision) : std::nullopt;
  }

  // The same of an observation at a time [s] since the episode began.
  std::optional<Decision> decide_at(const Observation& observation, const Action& proposal,
                                    double time) noexcept {
    Decision decision;
    const int rc = evofsm_decide_at(&state_, observation.data(), proposal.data(), time, &decision);
    return rc == EVOFSM_OK ? std::optional<Decision>(decision) : std::nullopt;
  }

 private:
  evofsm_state state_;
};

}  // namespace evofsm

#endif
/* ==== helpers ==== */
/* As Python has them: of equals, and beside NaN, the first. */
static double lesser(double one, double other) { return other < one ? other : one; }
static double greater(double one, double other) { return other > one ? other : one; }

/* ==== loop ==== */
/* -- States: recognise of clusters.py --------------------------------------------------------- */

/* Where it is by all that is held, if that is whole. At most EVOFSM_STATES exponentials. */
static void recognise(evofsm_state *s) {
  s->state = -1;
  s->seen = NAN;
#if EVOFSM_STATES > 0
  double *belief = s->belief, smallest, total = 0.0;
  int i, j, nearest = 0;
  for (j = 0; j < EVOFSM_VARIABLES; j++) {
    if (isnan(s->held[j])) {
      return;
    }
  }
  for (i = 0; i < EVOFSM_STATES; i++) {
    belief[i] = 0.0;
  }
  for (j = 0; j < EVOFSM_VARIABLES; j++) {
    for (i = 0; i < EVOFSM_STATES; i++) {
      const double offset = (s->held[j] - centers[j][i]) * centre_weights[j];
      belief[i] += offset * offset;
    }
  }
  for (i = 1; i < EVOFSM_STATES; i++) {
    nearest = belief[i] < belief[nearest] ? i : nearest;
  }
  smallest = belief[nearest];
  for (i = 0; i < EVOFSM_STATES; i++) {
    const double exponent = (smallest - belief[i]) * SHARPNESS;
    belief[i] = exponent > -690.0 ? exp(exponent) : 0.0;
    total += belief[i];
  }
  s->state = 0;
  for (i = 0; i < EVOFSM_STATES; i++) {
    belief[i] /= total;
    s->state = belief[i] > belief[s->state] ? i : s->state;
  }
  s->seen = time_seen[s->state];
#endif
}

/* -- Input: InputMonitor of guard.py, make_usable of reviser.py ------------------------------- */

/* What is wrong with an observation; a negative number: it is refused. */
static int take(evofsm_state *s, const double observation[EVOFSM_VARIABLES], double time) {
  int j, found = 0, lacks = 0;
  if (time <= s->time) {
    return time < s->time ? EVOFSM_LATE : EVOFSM_REPEATED;
  }
  for (j = 0; j < EVOFSM_VARIABLES; j++) {
    lacks |= isnan(observation[j]);
  }
  if (lacks) {
    if (LACKING == 0) {
      return -1;
    }
    found = LACKING;
  }
  if (time - s->time > LONGEST_GAP) {
    found |= EVOFSM_GAP;
  }
  for (j = 0; j < EVOFSM_VARIABLES; j++) {
    s->held[j] = isnan(observation[j]) ? s->held[j] : observation[j];
    s->observation[j] = observation[j];
  }
  s->time = time;
  return found;
}

/* An action of the set, whatever was proposed, into s->proposal; what had to be done to it. */
static int make_usable(evofsm_state *s, const double proposal[EVOFSM_ACTIONS]) {
  int i, is_usable = 1, remark = EVOFSM_AS_PROPOSED;
  for (i = 0; i < EVOFSM_ACTIONS; i++) {
    is_usable &= isfinite(proposal[i]) != 0;
    if (EVOFSM_CHOICES > 0) {
      is_usable &= proposal[i] >= 0.0 && proposal[i] <= EVOFSM_CHOICES - 1.0;
      is_usable &= floor(proposal[i]) == proposal[i];
    }
  }
  for (i = 0; i < EVOFSM_ACTIONS; i++) {
    const double within = lesser(greater(proposal[i], action_low[i]), action_high[i]);
    s->proposal[i] = is_usable ? within : fallback[i];
    if (is_usable && within != proposal[i]) {
      remark = EVOFSM_OUTSIDE;
    }
  }
  return is_usable ? remark : EVOFSM_NO_PROPOSAL;
}

/* -- The loop: Guard.decide -------------------------------------------------------------------- */

static void begin(evofsm_state *s) {
  int j;
  for (j = 0; j < EVOFSM_VARIABLES; j++) {
    s->held[j] = NAN;
  }
  s->time = NAN;
  s->decisions = 0.0;
  forget(s);
  start_revising(s);
}

void evofsm_reset(evofsm_state *state) { begin(state); }

int evofsm_decide(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                  const double proposal[EVOFSM_ACTIONS], evofsm_decision *out) {
  const double time = state->decisions * EVOFSM_INTERVAL;
  return evofsm_decide_at(state, observation, proposal, time, out);
}

int evofsm_decide_at(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                     const double proposal[EVOFSM_ACTIONS], double time, evofsm_decision *out) {
  int i, intake;
  for (i = 0; i < EVOFSM_VARIABLES; i++) {
    if (!isnan(observation[i]) && !(fabs(observation[i]) <= 1e30)) {
      return EVOFSM_UNUSABLE;
    }
  }
  intake = take(state, observation, time);
  if (intake < 0) {
    return EVOFSM_MISSING;
  }
  if ((intake & (EVOFSM_REPEATED | EVOFSM_LATE)) == 0) {
    if ((intake & EVOFSM_GAP) != 0) {
      forget(state); /* what comes does not follow from what was */
    }
    recognise(state);
  }
  out->remark = make_usable(state, proposal);
  out->intake = intake;
  out->state = state->state;
  out->seen = state->seen;
  out->left = NAN;
  out->backup = out->dead_end = out->backup_near = -1;
  out->unsurvived = 0;
  revise(state, out);
  out->is_new = out->seen < NEW;
  for (i = 0; i < EVOFSM_ACTIONS; i++) {
    out->advised[i] = state->best[i];
    out->executed[i] = ACTS ? state->best[i] : state->proposal[i];
  }
  state->decisions += 1.0;
  if ((intake & (EVOFSM_REPEATED | EVOFSM_LATE)) == 0) {
    follow(state, out->executed);
  }
  return EVOFSM_OK;
}
