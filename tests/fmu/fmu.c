/* The calls of FMI 2.0 or 3.0 around a small model. The model defines, before this file is included:
   NR values r; start(r); equations(r, t); and may define INDICATORS(r, t, z), EVENT(r, t, next), DIRECTIONAL and the
   faults AT_INSTANTIATE, AT_SETUP, AT_ENTER(r) into the initialization mode, AT_STEP, AT_SLOPES, AT_TERMINATE, AT_RESET, AT_GET(r),
   AT_SET(r, reference, value), BEGIN(t, has_end, end). Of co-simulation: INTERNAL, the length of the FMU's own steps, s;
   STOPS_AT(t, h), the instant that a step reaches; SAYS(reached), what FMI 3.0 says of it; SLOPE(r, reference, slope); ENDS(r, t) asks for the end.
   STRICT: calls of model exchange in the wrong mode are errors. STEP_EVENT(r): whether an event is wanted after a completed step. States are r[0 .. NX-1], their derivatives
   r[NX .. 2NX-1]. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

typedef void *Instance;
typedef struct { double r[NR]; double t, next, point, inner; int timed, mode; void (*log)(); void *env; } Model;
enum { EVENT_MODE, CONTINUOUS_TIME_MODE };
#ifdef STRICT
#define NEEDS(wanted) if (M->mode != wanted) return 3
#else
#define NEEDS(wanted)
#endif
#define M ((Model *)c)
#define N (NX > 0 ? NX : 1)
#ifndef AT_ENTER
#define AT_ENTER(r)
#endif
#ifndef AT_TERMINATE
#define AT_TERMINATE
#endif
#ifndef AT_RESET
#define AT_RESET
#endif
#ifndef STEP_EVENT
#define STEP_EVENT(r) 0
#endif
#ifndef SAYS
#define SAYS(reached) reached
#endif
#ifndef ENDS
#define ENDS(r, t) 0
#endif

static void fresh(Model *m) {
    m->t = 0; m->timed = 0; m->mode = EVENT_MODE; m->next = 0; m->point = 0; m->inner = 0;
    memset(m->r, 0, sizeof m->r);
    start(m->r);
}
static void slopes(Model *m) { equations(m->r, m->t); }
static int get(Model *m, const unsigned *v, size_t n, double *x) {
#ifdef AT_GET
    AT_GET(m->r);
#endif
    slopes(m);
    for (size_t i = 0; i < n; i++) x[i] = m->r[v[i]];
    return 0;
}
static int set(Model *m, const unsigned *v, size_t n, const double *x) {
    for (size_t i = 0; i < n; i++) {
#ifdef AT_SET
        AT_SET(m->r, v[i], x[i]);
#endif
        m->r[v[i]] = x[i];
    }
    return 0;
}
static int begin(Model *m, double t, int has_end, double end) {
    m->t = m->point = m->inner = t;
#ifdef BEGIN
    BEGIN(t, has_end, end);
#endif
    return 0;
}
static int update(Model *m, int *changed, int *timed, double *next) {
    *changed = 0;
#ifdef EVENT
    slopes(m);
    *changed = EVENT(m->r, m->t, &m->next, &m->timed);
#endif
    *timed = m->timed; *next = m->next;
    return 0;
}
/* Directional derivatives by complex-free central differences of exact code: tiny models, so h can be generous. */
static int directional(Model *m, const unsigned *un, size_t nu, const unsigned *kn, size_t nk, const double *seed, double *out) {
#ifdef DIRECTIONAL
    return DIRECTIONAL(m, un, nu, kn, nk, seed, out);
#else
    return 3;
#endif
}
static int substeps(Model *m, double h) { /* classical Runge-Kutta, 20 substeps; a crossing is settled at its end */
    double x[N], k[4][N]; int n = 20; double d = h / n;
#ifdef AT_STEP
    AT_STEP(m->r);
#endif
    for (int s = 0; s < n; s++) {
        memcpy(x, m->r, sizeof(double) * NX);
        for (int j = 0; j < 4; j++) {
            slopes(m);
            for (int i = 0; i < NX; i++) k[j][i] = m->r[NX + i];
            double w = j < 2 ? d / 2 : d;
            if (j < 3) { for (int i = 0; i < NX; i++) m->r[i] = x[i] + w * k[j][i]; if (j != 1) m->t += d / 2; }
        }
        for (int i = 0; i < NX; i++) m->r[i] = x[i] + d / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
#ifdef EVENT
        int timed, changed; double next; update(m, &changed, &timed, &next);
#endif
    }
    return 0;
}
/* One communication step; early: whether it ended before t + h, at m->point; m->inner: where the outputs belong. */
static int advance(Model *m, double t, double h, int *early) {
    double goal = t + h;
    *early = 0;
    if (fabs(t - m->point) > 1e-9) return 3;
#ifdef STOPS_AT
    goal = STOPS_AT(t, h);
    *early = goal < t + h - 1e-12;
#endif
#ifdef INTERNAL
    while (m->inner + INTERNAL <= goal + 1e-9) {
        m->t = m->inner;
        int s = substeps(m, INTERNAL);
        if (s) return s;
        m->inner += INTERNAL;
    }
    m->t = m->inner; m->point = goal;
    return 0;
#else
    m->t = t;
    if (goal > t) { int s = substeps(m, goal - t); if (s) return s; }
    m->t = m->point = m->inner = goal;
    return 0;
#endif
}

#if FMI == 2
typedef struct { void (*logger)(); void *(*allocate)(); void (*release)(); void *finished; void *env; } Calls;
typedef struct { int again, end, nominals, values, defined; double next; } Info;
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
int fmi2SetDebugLogging(Instance c, int on, size_t n, const char *const *k) { return 0; }
Instance fmi2Instantiate(const char *name, int type, const char *guid, const char *where, const Calls *f, int visible, int log) {
    if (strcmp(guid, "{token}")) { f->logger(f->env, name, 3, "error", "the GUID is not that of this model"); return 0; }
#ifdef AT_INSTANTIATE
    AT_INSTANTIATE;
#endif
    Model *m = malloc(sizeof *m); m->log = f->logger; m->env = f->env; fresh(m); return m;
}
void fmi2FreeInstance(Instance c) { free(c); }
int fmi2SetupExperiment(Instance c, int d, double tol, double t, int e, double end) {
#ifdef AT_SETUP
    AT_SETUP(M->r, t, e, end);
#endif
    return begin(M, t, e, end);
}
int fmi2EnterInitializationMode(Instance c) { AT_ENTER(M->r); return 0; }
int fmi2ExitInitializationMode(Instance c) { INITIALIZE(M->r); return 0; }
int fmi2Terminate(Instance c) { AT_TERMINATE; return 0; }
int fmi2Reset(Instance c) { AT_RESET; fresh(M); return 0; }
int fmi2GetReal(Instance c, const unsigned *v, size_t n, double *x) { return get(M, v, n, x); }
int fmi2SetReal(Instance c, const unsigned *v, size_t n, const double *x) { return set(M, v, n, x); }
int fmi2GetInteger(Instance c, const unsigned *v, size_t n, int *x) { for (size_t i = 0; i < n; i++) x[i] = (int)M->r[v[i]]; return 0; }
int fmi2SetInteger(Instance c, const unsigned *v, size_t n, const int *x) { for (size_t i = 0; i < n; i++) M->r[v[i]] = x[i]; return 0; }
int fmi2GetBoolean(Instance c, const unsigned *v, size_t n, int *x) { return fmi2GetInteger(c, v, n, x); }
int fmi2SetBoolean(Instance c, const unsigned *v, size_t n, const int *x) { return fmi2SetInteger(c, v, n, x); }
int fmi2EnterEventMode(Instance c) { NEEDS(CONTINUOUS_TIME_MODE); M->mode = EVENT_MODE; return 0; }
int fmi2NewDiscreteStates(Instance c, Info *e) {
    NEEDS(EVENT_MODE);
    memset(e, 0, sizeof *e);
    update(M, &e->values, &e->defined, &e->next);
#ifdef AGAIN
    e->again = AGAIN(M->r);
#endif
    e->end = ENDS(M->r, M->t);
    return 0;
}
int fmi2EnterContinuousTimeMode(Instance c) { NEEDS(EVENT_MODE); M->mode = CONTINUOUS_TIME_MODE; return 0; }
int fmi2CompletedIntegratorStep(Instance c, int n, int *e, int *end) { NEEDS(CONTINUOUS_TIME_MODE); *e = STEP_EVENT(M->r); *end = ENDS(M->r, M->t); return 0; }
int fmi2SetTime(Instance c, double t) { M->t = t; return 0; }
int fmi2SetContinuousStates(Instance c, const double *x, size_t n) { NEEDS(CONTINUOUS_TIME_MODE); memcpy(M->r, x, n * sizeof(double)); return 0; }
int fmi2GetContinuousStates(Instance c, double *x, size_t n) { memcpy(x, M->r, n * sizeof(double)); return 0; }
int fmi2GetDerivatives(Instance c, double *x, size_t n) {
#ifdef AT_SLOPES
    AT_SLOPES(M->r);
#endif
    slopes(M); memcpy(x, M->r + NX, n * sizeof(double)); return 0;
}
int fmi2GetEventIndicators(Instance c, double *z, size_t n) {
#ifdef INDICATORS
    slopes(M); INDICATORS(M->r, M->t, z);
#endif
    return 0;
}
int fmi2GetNominalsOfContinuousStates(Instance c, double *x, size_t n) {
    for (size_t i = 0; i < n; i++) x[i] = NOMINAL; return 0; }
int fmi2GetDirectionalDerivative(Instance c, const unsigned *u, size_t nu, const unsigned *k, size_t nk, const double *s, double *o) {
    return directional(M, u, nu, k, nk, s, o); }
int fmi2DoStep(Instance c, double t, double h, int p) { int early, s = advance(M, t, h, &early); return s ? s : early || ENDS(M->r, M->t) ? 2 : 0; }
int fmi2GetRealStatus(Instance c, int kind, double *x) { *x = M->point; return kind == 2 ? 0 : 2; }
int fmi2GetBooleanStatus(Instance c, int kind, int *x) { *x = kind == 3 && ENDS(M->r, M->t); return kind == 3 ? 0 : 2; }
int fmi2SetRealInputDerivatives(Instance c, const unsigned *v, size_t n, const int *o, const double *x) {
#ifdef SLOPE
    for (size_t i = 0; i < n; i++) SLOPE(M->r, v[i], x[i]);
    return 0;
#else
    return 3;
#endif
}
#define UNUSED(f) int f(void) { return 3; }
UNUSED(fmi2GetString) UNUSED(fmi2SetString) UNUSED(fmi2GetFMUstate) UNUSED(fmi2SetFMUstate) UNUSED(fmi2FreeFMUstate)
UNUSED(fmi2SerializedFMUstateSize) UNUSED(fmi2SerializeFMUstate) UNUSED(fmi2DeSerializeFMUstate)
UNUSED(fmi2GetRealOutputDerivatives) UNUSED(fmi2CancelStep) UNUSED(fmi2GetStatus) UNUSED(fmi2GetIntegerStatus)
UNUSED(fmi2GetStringStatus)
#else
#include <stdbool.h>
const char *fmi3GetVersion(void) { return "3.0"; }
int fmi3SetDebugLogging(Instance c, bool on, size_t n, const char *const *k) { return 0; }
static Instance made(const char *token, void *env, void (*log)()) {
    if (strcmp(token, "{token}")) { ((void (*)(void *, int, const char *, const char *))log)(env, 3, "error", "the token is not that of this model"); return 0; }
#ifdef AT_INSTANTIATE
    AT_INSTANTIATE;
#endif
    Model *m = malloc(sizeof *m); m->log = log; m->env = env; fresh(m); return m;
}
Instance fmi3InstantiateModelExchange(const char *n, const char *token, const char *p, bool v, bool l, void *env, void (*log)()) { return made(token, env, log); }
Instance fmi3InstantiateCoSimulation(const char *n, const char *token, const char *p, bool v, bool l, bool e, bool r, const unsigned *q, size_t nq, void *env, void (*log)(), void (*i)()) { return made(token, env, log); }
void fmi3FreeInstance(Instance c) { free(c); }
int fmi3EnterInitializationMode(Instance c, bool d, double tol, double t, bool e, double end) { AT_ENTER(M->r); return begin(M, t, e, end); }
int fmi3ExitInitializationMode(Instance c) { INITIALIZE(M->r); return 0; }
int fmi3EnterEventMode(Instance c) { NEEDS(CONTINUOUS_TIME_MODE); M->mode = EVENT_MODE; return 0; }
int fmi3Terminate(Instance c) { AT_TERMINATE; return 0; }
int fmi3Reset(Instance c) { AT_RESET; fresh(M); return 0; }
int fmi3GetFloat64(Instance c, const unsigned *v, size_t n, double *x, size_t m) { return get(M, v, n, x); }
int fmi3SetFloat64(Instance c, const unsigned *v, size_t n, const double *x, size_t m) { return set(M, v, n, x); }
int fmi3GetInt32(Instance c, const unsigned *v, size_t n, int *x, size_t m) { for (size_t i = 0; i < n; i++) x[i] = (int)M->r[v[i]]; return 0; }
int fmi3SetInt32(Instance c, const unsigned *v, size_t n, const int *x, size_t m) { for (size_t i = 0; i < n; i++) M->r[v[i]] = x[i]; return 0; }
int fmi3GetBoolean(Instance c, const unsigned *v, size_t n, bool *x, size_t m) { for (size_t i = 0; i < n; i++) x[i] = M->r[v[i]] != 0; return 0; }
int fmi3SetBoolean(Instance c, const unsigned *v, size_t n, const bool *x, size_t m) { for (size_t i = 0; i < n; i++) M->r[v[i]] = x[i]; return 0; }
int fmi3UpdateDiscreteStates(Instance c, bool *again, bool *end, bool *nominals, bool *values, bool *defined, double *next) {
    int changed, timed;
    NEEDS(EVENT_MODE);
    update(M, &changed, &timed, next);
    *again = *nominals = false; *end = ENDS(M->r, M->t); *values = changed; *defined = timed; return 0;
}
int fmi3EnterContinuousTimeMode(Instance c) { NEEDS(EVENT_MODE); M->mode = CONTINUOUS_TIME_MODE; return 0; }
int fmi3CompletedIntegratorStep(Instance c, bool n, bool *e, bool *end) { NEEDS(CONTINUOUS_TIME_MODE); *e = STEP_EVENT(M->r); *end = ENDS(M->r, M->t); return 0; }
int fmi3SetTime(Instance c, double t) { M->t = t; return 0; }
int fmi3SetContinuousStates(Instance c, const double *x, size_t n) { NEEDS(CONTINUOUS_TIME_MODE); memcpy(M->r, x, n * sizeof(double)); return 0; }
int fmi3GetContinuousStates(Instance c, double *x, size_t n) { memcpy(x, M->r, n * sizeof(double)); return 0; }
int fmi3GetContinuousStateDerivatives(Instance c, double *x, size_t n) {
#ifdef AT_SLOPES
    AT_SLOPES(M->r);
#endif
    slopes(M); memcpy(x, M->r + NX, n * sizeof(double)); return 0;
}
int fmi3GetEventIndicators(Instance c, double *z, size_t n) {
#ifdef INDICATORS
    slopes(M); INDICATORS(M->r, M->t, z);
#endif
    return 0;
}
int fmi3GetNominalsOfContinuousStates(Instance c, double *x, size_t n) { for (size_t i = 0; i < n; i++) x[i] = NOMINAL; return 0; }
int fmi3GetNumberOfEventIndicators(Instance c, size_t *n) { *n = NZ; return 0; }
int fmi3GetNumberOfContinuousStates(Instance c, size_t *n) { *n = NX; return 0; }
int fmi3GetDirectionalDerivative(Instance c, const unsigned *u, size_t nu, const unsigned *k, size_t nk, const double *s, size_t ns, double *o, size_t no) {
    return directional(M, u, nu, k, nk, s, o); }
int fmi3EnterStepMode(Instance c) { return 0; }
int fmi3DoStep(Instance c, double t, double h, bool p, bool *event, bool *end, bool *early, double *reached) {
    int left, s = advance(M, t, h, &left); *event = false; *end = ENDS(M->r, M->t); *early = left; *reached = left ? M->point : SAYS(M->inner); return s; }
#define UNUSED(f) int f(void) { return 3; }
UNUSED(fmi3InstantiateScheduledExecution) UNUSED(fmi3GetFloat32) UNUSED(fmi3GetInt8) UNUSED(fmi3GetUInt8)
UNUSED(fmi3GetInt16) UNUSED(fmi3GetUInt16) UNUSED(fmi3GetUInt32) UNUSED(fmi3GetInt64) UNUSED(fmi3GetUInt64)
UNUSED(fmi3GetString) UNUSED(fmi3GetBinary) UNUSED(fmi3GetClock) UNUSED(fmi3SetFloat32) UNUSED(fmi3SetInt8)
UNUSED(fmi3SetUInt8) UNUSED(fmi3SetInt16) UNUSED(fmi3SetUInt16) UNUSED(fmi3SetUInt32) UNUSED(fmi3SetInt64)
UNUSED(fmi3SetUInt64) UNUSED(fmi3SetString) UNUSED(fmi3SetBinary) UNUSED(fmi3SetClock)
UNUSED(fmi3GetNumberOfVariableDependencies) UNUSED(fmi3GetVariableDependencies) UNUSED(fmi3GetFMUState)
UNUSED(fmi3SetFMUState) UNUSED(fmi3FreeFMUState) UNUSED(fmi3SerializedFMUStateSize) UNUSED(fmi3SerializeFMUState)
UNUSED(fmi3DeserializeFMUState) UNUSED(fmi3GetAdjointDerivative) UNUSED(fmi3EnterConfigurationMode)
UNUSED(fmi3ExitConfigurationMode) UNUSED(fmi3GetIntervalDecimal) UNUSED(fmi3GetIntervalFraction)
UNUSED(fmi3GetShiftDecimal) UNUSED(fmi3GetShiftFraction) UNUSED(fmi3SetIntervalDecimal) UNUSED(fmi3SetIntervalFraction)
UNUSED(fmi3SetShiftDecimal) UNUSED(fmi3SetShiftFraction) UNUSED(fmi3EvaluateDiscreteStates)
UNUSED(fmi3GetOutputDerivatives) UNUSED(fmi3ActivateModelPartition)
#endif
