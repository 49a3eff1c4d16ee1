/* What is the same for every judge: guard.py and reviser.py in C, in three files; and an FMU.

   `evofsm export` (export.py) puts what was learnt before it. Whoever changes a rule in Python
   changes it here; tests/guard/test_export.py holds the two together. */
/* ==== evofsm.h ==== */
/* Exported by UNIT_TOOL, no certified safety function.
   UNIT_ABOUT */
#ifndef EVOFSM_H
#define EVOFSM_H

/* Of which export all files are. */
#define EVOFSM_GUARD UNIT_GUARD
UNIT_SIZES
#ifdef __cplusplus
extern "C" {
#endif

/* What evofsm_decide returns. But for EVOFSM_OK nothing has changed, and nothing was written. */
enum {
  EVOFSM_OK = 0,
  EVOFSM_UNUSABLE = 1, /* an entry of the observation, or the time, is infinite, or cannot be so:
                          ask again with NaN for it, or act safely; the counted time stands */
  EVOFSM_MISCOMPILED = 2 /* it does not compute as IEEE 754 says, rounding to nearest */
};

/* Why something is executed. */
enum {
  EVOFSM_KEPT = 0,           /* the proposal passes */
  EVOFSM_CHANGED = 1,        /* it does not; this is the closest that passes */
  EVOFSM_CUT_SHORT = 2,      /* none passed within the bound of the search */
  EVOFSM_NOTHING_PASSES = 3, /* the one that lasts longest, or is least risky */
  EVOFSM_NOTHING_SEEN = 4,   /* not each variable was observed yet in this episode */
  EVOFSM_TRIED = 5,          /* cars: own brakes are not known yet, so it brakes in full */
  EVOFSM_TRYING = 6,         /* and goes on with it for a while */
  EVOFSM_REGAINS = 7,        /* cars: the proposal regains a safe gap in time */
  EVOFSM_REGAINED = 8,       /* cars: the least braking that regains one */
  EVOFSM_AVOIDS = 9,         /* cars: it avoids a collision if the leader goes on so */
  EVOFSM_AVOIDED = 10        /* cars: braking that avoids one */
};

/* What had to be done to a proposal. One that is no action (NaN) is replaced by
   UNIT_FALLBACK, which then is judged as any is: propose a safer one of yours, if that is not. */
enum { EVOFSM_AS_PROPOSED = 0, EVOFSM_OUTSIDE = 1, EVOFSM_NO_PROPOSAL = 2 };

/* What was wrong with an observation: a sum. */
enum {
  EVOFSM_PARTIAL = 1,  /* entries are NaN */
  EVOFSM_GAP = 4,      /* it came long after the one before */
  EVOFSM_REPEATED = 8, /* as old as the one before: that one stands; after five nothing is seen */
  EVOFSM_LATE = 16     /* older than that; after five the clock was set back: EVOFSM_GAP */
};

typedef struct {
  double executed[EVOFSM_ACTIONS]; /* to be executed */
  double advised[EVOFSM_ACTIONS];  /* what would be, if the guard may not act (mode shadow) */
  double risk_proposed, risk_executed; /* probability of failure; NaN: not judged */
  double risk_low, risk_high;          /* 90 % interval of risk_executed */
  double evidence;                     /* number of disturbances that this rests on */
  double seen;                         /* time spent in such states [s]; NaN: not known */
  double left; /* learnt: what is left of the distance to failure, if it passes [typical steps];
                  cars: the hardest braking of the leader that the proposal survives [m/s²] */
  int reason, remark, intake, is_new;  /* codes as above; 1: never seen before */
  int state;                           /* from 0; -1: none is known */
  int backup;                          /* learnt: after which it passes, or lasts; -1: none */
  int unsurvived; /* learnt: disturbances not survived after the proposal; -1: not even none */
} evofsm_decision;

/* Of one stream of observations. Whoever calls owns it, and leaves what is in it alone; its size is
   all the memory that there is. */
typedef struct {
  double held[EVOFSM_VARIABLES], observation[EVOFSM_VARIABLES];
  double time, decisions, seen;
  double proposal[EVOFSM_ACTIONS], best[EVOFSM_ACTIONS];
  int state, stale;
UNIT_STATE} evofsm_state;

/* An episode begins with the next decision. To be called before the first one, too. */
void evofsm_reset(evofsm_state *state);

/* Decide on an observation, EVOFSM_INTERVAL seconds after the one before; NaN: not seen. Where the
   processor traps FE_INVALID, comparing NaN would end the program: mask it around the call. */
int evofsm_decide(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                  const double proposal[EVOFSM_ACTIONS], evofsm_decision *out);

/* The same of an observation at a time [s] since the episode began. */
int evofsm_decide_at(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                     const double proposal[EVOFSM_ACTIONS], double time, evofsm_decision *out);

#ifdef __cplusplus
}
#endif

#endif
/* ==== evofsm.hpp ==== */
#ifndef EVOFSM_HPP
#define EVOFSM_HPP

#include <array>
#include <optional>

#include "evofsm.h"

#if EVOFSM_GUARD != UNIT_GUARD
#error "evofsm.hpp and evofsm.h are of different exports: take all files of one"
#endif

// No namespace, which could not be called as a function of the C library is.
struct evofsm {

using Observation = std::array<double, EVOFSM_VARIABLES>;  // NaN where not seen
using Action = std::array<double, EVOFSM_ACTIONS>;
using Decision = evofsm_decision;

// A guard of one stream of observations. It asks for no memory and throws nothing.
class Guard {
 public:
  Guard() noexcept { reset(); }

  // An episode begins.
  void reset() noexcept { evofsm_reset(&state_); }

  // What to execute; empty where evofsm_decide_at does not return EVOFSM_OK.
  std::optional<Decision> decide(const Observation& observation, const Action& proposal) noexcept {
    return decide_at(observation, proposal, state_.decisions * EVOFSM_INTERVAL);
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

};

#endif
/* ==== evofsm.c ==== */
#include "evofsm.h"

#include <float.h>
#include <math.h>
#include <string.h>

#if EVOFSM_GUARD != UNIT_GUARD
#error "evofsm.c and evofsm.h are of different exports: take all files of one"
#endif
/* NaN is "not seen" and "nothing proposed", and decisions are the same to the bit. */
#if defined __FAST_MATH__ || __FINITE_MATH_ONLY__ || defined __ASSOCIATIVE_MATH__ || \
    defined __RECIPROCAL_MATH__ || defined __NO_SIGNED_ZEROS__ || defined _M_FP_FAST || \
    defined __FP_FAST
#error "evofsm needs NaN and exact arithmetic: compile this file without -Ofast, -ffast-math, \
-ffinite-math-only, -funsafe-math-optimizations or /fp:fast"
#endif
#if FLT_RADIX != 2 || DBL_MANT_DIG != 53 || DBL_MAX_EXP != 1024
#error "evofsm needs a double of 64 bits (IEEE 754): compile without what shortens it"
#endif
#if FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 1
#error "evofsm needs a double that is computed as such: on x86 compile with -msse2 -mfpmath=sse"
#endif
/* Fails where constants are single, as by -fsingle-precision-constant. */
typedef char evofsm_needs_constants_that_are_double[sizeof 1.0 == 8 && sizeof(double) == 8 ? 1 : -1];

UNIT_CONSTANTS
/* As Python has them: of equals, and beside NaN, the first. */
static double lesser(double one, double other) { return other < one ? other : one; }
static double greater(double one, double other) { return other > one ? other : one; }

static void fill(double values[], int n, double value) {
  for (n--; n >= 0; n--) {
    values[n] = value;
  }
}

UNIT_SOURCE
/* -- States: nearest_center of clusters.py, the most probable one ------------------------------ */

/* Where it is by all that is held, if that is whole: NaN is not nearer. */
static void recognise(evofsm_state *s) {
  s->state = -1;
  s->seen = NAN;
#if EVOFSM_STATES > 0
  double smallest = INFINITY;
  int i, j;
  for (i = 0; i < EVOFSM_STATES; i++) {
    double square = 0.0;
    for (j = 0; j < EVOFSM_VARIABLES; j++) {
      const double offset = (s->held[j] - centers[i][j]) * centre_weights[j];
      square += offset * offset;
    }
    if (square < smallest) {
      smallest = square;
      s->state = i;
      s->seen = time_seen[i];
    }
  }
  /* As far as the states tell. */
  s->seen = s->state >= 0 && smallest > STATE_REACH * STATE_REACH ? 0.0 : s->seen;
#endif
}

/* -- Input: Guard._take of guard.py, make_usable of reviser.py ------------------------------- */

/* What is wrong with an observation. */
static int take(evofsm_state *s, const double observation[EVOFSM_VARIABLES], double time) {
  const int is_back = time < s->time, stands = time == s->time;
  int j, found = is_back || time - s->time > LONGEST_GAP ? EVOFSM_GAP : 0;
  s->stale = is_back || stands ? s->stale + 1 : 0;
  if (s->stale > 0 && s->stale <= MOST_STALE) {
    return is_back ? EVOFSM_LATE : EVOFSM_REPEATED;
  }
  for (j = 0; j < EVOFSM_VARIABLES; j++) {
    s->observation[j] = stands ? NAN : observation[j];
    found |= isnan(s->observation[j]) ? EVOFSM_PARTIAL : 0;
    s->held[j] = isnan(s->observation[j]) ? s->held[j] : observation[j];
  }
  s->time = time;
  return found;
}

/* An action of the set, whatever was proposed, into s->proposal; what had to be done to it. */
static int make_usable(evofsm_state *s, const double proposal[EVOFSM_ACTIONS]) {
  int i, is_usable = 1, remark = EVOFSM_AS_PROPOSED;
  for (i = 0; i < EVOFSM_ACTIONS; i++) {
    const int is_choice = proposal[i] <= EVOFSM_CHOICES - 1.0 && floor(proposal[i]) == proposal[i];
    is_usable &= isfinite(proposal[i]) && (EVOFSM_CHOICES == 0 || (proposal[i] >= 0.0 && is_choice));
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

/* Whether it is computed as written: not each compiler tells where it is not. */
static int is_exact(void) {
  static const volatile double given[] = {1.0, 1e-18, 49.0, 98.0, 147.0, NAN};
  const double one = given[0], small = given[1], by = given[2], none = given[5];
  const double parts = given[2] / by + given[3] / by + given[4] / by;
  const int is_rounded = (one + small) - one == 0.0 && one - small == one && parts == 6.0;
  return is_rounded && isnan(none) && !(none <= one);
}

void evofsm_reset(evofsm_state *state) {
  memset(state, 0, sizeof *state);
  fill(state->held, EVOFSM_VARIABLES, NAN);
  state->time = NAN;
  forget(state);
}

int evofsm_decide(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                  const double proposal[EVOFSM_ACTIONS], evofsm_decision *out) {
  const double time = state->decisions * EVOFSM_INTERVAL;
  return evofsm_decide_at(state, observation, proposal, time, out);
}

int evofsm_decide_at(evofsm_state *state, const double observation[EVOFSM_VARIABLES],
                     const double proposal[EVOFSM_ACTIONS], double time, evofsm_decision *out) {
  int i, intake;
  if (!is_exact()) {
    return EVOFSM_MISCOMPILED;
  }
  if (!(time < time + EVOFSM_INTERVAL)) { /* nor is it of NaN, or infinite */
    return EVOFSM_UNUSABLE;
  }
  for (i = 0; i < EVOFSM_VARIABLES; i++) {
    if (observation[i] < seen_from[i] || observation[i] > seen_to[i]) {
      return EVOFSM_UNUSABLE;
    }
  }
  intake = take(state, observation, time);
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
  out->backup = -1;
  out->unsurvived = 0;
  revise(state, out);
  out->is_new = out->seen < NEW;
  memcpy(out->advised, state->best, sizeof out->advised);
  memcpy(out->executed, ACTS ? state->best : state->proposal, sizeof out->executed);
  if (!ACTS && out->remark == EVOFSM_OUTSIDE) {
    memcpy(out->executed, proposal, sizeof out->executed); /* who does not act changes nothing */
  }
  state->decisions += 1.0;
  if ((intake & (EVOFSM_REPEATED | EVOFSM_LATE)) == 0) {
    follow(state, out->executed);
  }
  return EVOFSM_OK;
}
/* ==== modelDescription.xml ==== */
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="UNIT_NAME" guid="UNIT_GUID"
    description="A frozen guard, no certified safety function. In: observation, proposal. Out: what is
executed, its risk of failure (NaN: not judged), the reason (0: the proposal passes; else as in
sources/evofsm.h), whether it was revised." generationTool="UNIT_TOOL">
  <CoSimulation modelIdentifier="UNIT_NAME" canNotUseMemoryManagementFunctions="true">
    <SourceFiles>
      <File name="evofsm.c"/>
      <File name="fmi2.c"/>
    </SourceFiles>
  </CoSimulation>
  <LogCategories>
    <Category name="logStatusError"/>
  </LogCategories>
  <DefaultExperiment stepSize="UNIT_STEP"/>
  <ModelVariables>
UNIT_VARIABLES  </ModelVariables>
  <ModelStructure>
    <Outputs>UNIT_OUTPUTS</Outputs>
  </ModelStructure>
</fmiModelDescription>
/* ==== fmi2.c ==== */
/* The guard as a unit of FMI 2.0 for co-simulation. Types and functions are those of the standard
   (fmi2TypesPlatform.h "default", fmi2FunctionTypes.h); what does not apply here is an error. */
#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "evofsm.h"

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef struct {
  void (*logger)(void *environment, const char *instance, fmi2Status status, const char *category,
                 const char *message, ...);
  void *(*allocate)(size_t count, size_t size);
  void (*release)(void *memory);
  void (*finished)(void *environment, fmi2Status status);
  void *environment;
} fmi2CallbackFunctions;

/* Value references: an observation, a proposal; what is executed, risk, reason, whether revised. */
enum {
  PROPOSAL = EVOFSM_VARIABLES,
  EXECUTED = PROPOSAL + EVOFSM_ACTIONS,
  RISK = EXECUTED + EVOFSM_ACTIONS,
  REASON,
  REVISED,
  VALUES
};

static const double start[VALUES] = UNIT_START;

typedef struct {
  evofsm_state state;
  double values[VALUES];
  double wait; /* until the next decision [s] */
  fmi2CallbackFunctions callbacks;
  char name[128];
} unit;

static fmi2Status fail(const unit *of, const char *message, double number) {
  if (of->callbacks.logger != NULL) {
    of->callbacks.logger(of->callbacks.environment, of->name, fmi2Error, "logStatusError", message,
                         number);
  }
  return fmi2Error;
}

/* What is of no account, and what a unit without it answers. */
#define NOTHING(Name, ...) \
  EXPORT fmi2Status fmi2##Name(__VA_ARGS__) { return fmi2OK; }
#define LACKS(Name, ...) \
  EXPORT fmi2Status fmi2##Name(__VA_ARGS__) { return fmi2Error; }

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

NOTHING(SetDebugLogging, void *c, int on, size_t count, const char *const names[])

EXPORT fmi2Status fmi2Reset(void *c) {
  unit *of = c;
  evofsm_reset(&of->state);
  memcpy(of->values, start, sizeof start);
  of->wait = 0.0;
  return fmi2OK;
}

EXPORT void *fmi2Instantiate(const char *name, int kind, const char *guid, const char *resources,
                             const fmi2CallbackFunctions *callbacks, int visible, int logging) {
  unit *of = calloc(1, sizeof *of);
  if (of == NULL) {
    return NULL;
  }
  of->callbacks = *callbacks;
  snprintf(of->name, sizeof of->name, "%s", name);
  if (kind != 1 || strcmp(guid, "UNIT_GUID") != 0) {
    fail(of, kind != 1 ? "it is for co-simulation" : "modelDescription.xml is of another one", 0.0);
    free(of);
    return NULL;
  }
  fmi2Reset(of);
  return of;
}

EXPORT void fmi2FreeInstance(void *c) { free(c); }

NOTHING(SetupExperiment, void *c, int bounded, double tolerance, double start, int ends, double stop)
NOTHING(EnterInitializationMode, void *c)
NOTHING(ExitInitializationMode, void *c)
NOTHING(Terminate, void *c)

/* Decide on the inputs as they stand. Steps are as long as the guard's interval, or a whole part of
   it: then it decides at the first of them. */
EXPORT fmi2Status fmi2DoStep(void *c, double time, double step, int no_return) {
  unit *of = c;
  const double *proposal = of->values + PROPOSAL, left = of->wait / step;
  const double steps = floor(EVOFSM_INTERVAL / step + 0.5);
  static const char *const why[] = {
      "", "an observation is infinite, or cannot be so; NaN says not seen",
      "this unit was compiled to compute otherwise than IEEE 754 says"};
  evofsm_decision decision;
  int i, rc;
  if (!(steps >= 1.0) || !(fabs(steps * step / EVOFSM_INTERVAL - 1.0) <= 1e-6) ||
      fabs(left - 0.5) < 0.499) {
    return fail(of, "a step of %g s does not divide the interval of UNIT_STEP s, or ends after it", step);
  }
  if (left > 0.5) {
    of->wait -= step;
    return fmi2OK;
  }
  rc = evofsm_decide(&of->state, of->values, proposal, &decision);
  if (rc != EVOFSM_OK) {
    return fail(of, why[rc], 0.0);
  }
  of->wait = EVOFSM_INTERVAL - step;
  of->values[RISK] = decision.risk_executed;
  of->values[REASON] = decision.reason;
  of->values[REVISED] = 0.0;
  for (i = 0; i < EVOFSM_ACTIONS; i++) {
    of->values[EXECUTED + i] = decision.executed[i];
    of->values[REVISED] = decision.executed[i] == proposal[i] ? of->values[REVISED] : 1.0;
  }
  return fmi2OK;
}

#define ACCESS(Name, type, last, copy)                                                       \
  EXPORT fmi2Status fmi2##Name(void *c, const unsigned at[], size_t count, type values[]) {   \
    size_t i;                                                                                \
    for (i = 0; i < count; i++) {                                                            \
      double *const value = ((unit *)c)->values + at[i];                                     \
      if (at[i] >= (last)) {                                                                 \
        return fail(c, "there is no variable %g, or it cannot be set", at[i]);               \
      }                                                                                      \
      copy;                                                                                  \
    }                                                                                        \
    return fmi2OK;                                                                           \
  }
ACCESS(GetReal, double, VALUES, values[i] = *value)
ACCESS(GetInteger, int, VALUES, values[i] = (int)*value)
ACCESS(GetBoolean, int, VALUES, values[i] = (int)*value)
ACCESS(SetReal, const double, EXECUTED, *value = values[i])
ACCESS(SetInteger, const int, EXECUTED, *value = values[i])

LACKS(SetBoolean, void *c, const unsigned at[], size_t count, const int values[])
LACKS(SetString, void *c, const unsigned at[], size_t count, const char *const values[])
LACKS(GetString, void *c, const unsigned at[], size_t count, const char *values[])
LACKS(GetFMUstate, void *c, void **state)
LACKS(SetFMUstate, void *c, void *state)
LACKS(FreeFMUstate, void *c, void **state)
LACKS(SerializedFMUstateSize, void *c, void *state, size_t *size)
LACKS(SerializeFMUstate, void *c, void *state, char bytes[], size_t size)
LACKS(DeSerializeFMUstate, void *c, const char bytes[], size_t size, void **state)
LACKS(GetDirectionalDerivative, void *c, const unsigned of[], size_t count, const unsigned by[],
      size_t others, const double along[], double found[])
LACKS(SetRealInputDerivatives, void *c, const unsigned at[], size_t count, const int order[],
      const double values[])
LACKS(GetRealOutputDerivatives, void *c, const unsigned at[], size_t count, const int order[],
      double values[])
LACKS(CancelStep, void *c)
LACKS(GetStatus, void *c, int kind, fmi2Status *value)
LACKS(GetRealStatus, void *c, int kind, double *value)
LACKS(GetIntegerStatus, void *c, int kind, int *value)
LACKS(GetBooleanStatus, void *c, int kind, int *value)
LACKS(GetStringStatus, void *c, int kind, const char **value)
