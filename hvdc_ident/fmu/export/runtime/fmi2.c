/* The functions of FMI 2.0, model exchange and co-simulation. Types and names after the standard's text. */
#include "internal.h"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
/* Where sources are linked statically, the builder defines FMI2_FUNCTION_PREFIX as the model identifier and _. */
#define PASTE2(a, b) a##b
#define PASTE(a, b) PASTE2(a, b)
#ifdef FMI2_FUNCTION_PREFIX
#define NAME(f) PASTE(FMI2_FUNCTION_PREFIX, f)
#else
#define NAME(f) f
#endif

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef unsigned int Ref;
typedef const char *Text;
typedef void (*Logger)(void *, Text, fmi2Status, Text, Text, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*step_finished)(void *, fmi2Status);
    void *environment;
} Callbacks;
typedef struct {
    int newDiscreteStatesNeeded, terminateSimulation, nominalsOfContinuousStatesChanged, valuesOfContinuousStatesChanged;
    int nextEventTimeDefined;
    double nextEventTime;
} EventInfo;

#define IN(phase) (1 << (phase))
#define RUNNING (IN(EVENT) | IN(CONTINUOUS) | IN(STEP) | IN(TERMINATED))

static fmi2Status report(Instance *i, int good) {
    if (good) return fmi2OK;
    if (i->logger) ((Logger)i->logger)(i->environment, i->name, fmi2Error, "logStatusError", "%s", i->message);
    return fmi2Error;
}

static int allowed(Instance *i, int phases, Text function) {
    if (IN(i->s.phase) & phases) return 1;
    say(i, "%s is not allowed in this state of the FMU", function);
    return 0;
}

#define CHECK(phases, function) \
    Instance *i = c;            \
    if (!i) return fmi2Error;   \
    if (!allowed(i, phases, function)) return report(i, 0)

EXPORT Text NAME(fmi2GetTypesPlatform)(void) { return "default"; }
EXPORT Text NAME(fmi2GetVersion)(void) { return "2.0"; }

EXPORT fmi2Status NAME(fmi2SetDebugLogging)(void *c, int on, size_t n, const Text categories[]) {
    (void)n, (void)categories;
    if (!c) return fmi2Error;
    ((Instance *)c)->logging = on;
    return fmi2OK;
}

EXPORT void *NAME(fmi2Instantiate)(Text name, fmi2Type type, Text guid, Text resources, const Callbacks *functions, int visible, int logging) {
    (void)resources, (void)visible;
    Instance *i = make(name, guid, type == fmi2CoSimulation);
    if (!i) {
        if (functions && functions->logger)
            functions->logger(functions->environment, name, fmi2Error, "logStatusError",
                              "no instance: the GUID is not this FMU's, or there is not enough memory");
        return NULL;
    }
    i->logging = logging;
    if (functions) {
        i->logger = (void (*)(void))functions->logger;
        i->environment = functions->environment;
    }
    return i;
}

EXPORT void NAME(fmi2FreeInstance)(void *c) { discard(c); }

EXPORT fmi2Status NAME(fmi2SetupExperiment)(void *c, int has_tolerance, double tolerance, double start, int has_stop, double stop) {
    CHECK(IN(INSTANTIATED), "fmi2SetupExperiment");
    begin(i, start, has_stop, stop, has_tolerance, tolerance);
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2EnterInitializationMode)(void *c) {
    CHECK(IN(INSTANTIATED), "fmi2EnterInitializationMode");
    i->s.phase = INITIALIZATION;
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2ExitInitializationMode)(void *c) {
    CHECK(IN(INITIALIZATION), "fmi2ExitInitializationMode");
    return report(i, finish_start(i));
}

EXPORT fmi2Status NAME(fmi2Terminate)(void *c) {
    CHECK(RUNNING, "fmi2Terminate");
    i->s.phase = TERMINATED;
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2Reset)(void *c) {
    if (!c) return fmi2Error;
    reset(c);
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2GetReal)(void *c, const Ref refs[], size_t n, double values[]) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | RUNNING, "fmi2GetReal");
    return report(i, get_values(i, refs, n, values));
}

EXPORT fmi2Status NAME(fmi2SetReal)(void *c, const Ref refs[], size_t n, const double values[]) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | IN(EVENT) | IN(CONTINUOUS) | IN(STEP), "fmi2SetReal");
    return report(i, set_values(i, refs, n, values));
}

/* There are no variables of the other types. */
static fmi2Status none(Instance *i, size_t n) {
    if (!i) return fmi2Error;
    if (n == 0) return fmi2OK;
    say(i, "all variables of this FMU are of type Real");
    return report(i, 0);
}

#define WITHOUT(type, kind)                                                                     \
    EXPORT fmi2Status NAME(fmi2Get##kind)(void *c, const Ref refs[], size_t n, type values[]) { \
        (void)refs, (void)values;                                                               \
        return none(c, n);                                                                      \
    }                                                                                           \
    EXPORT fmi2Status NAME(fmi2Set##kind)(void *c, const Ref refs[], size_t n, const type values[]) { \
        (void)refs, (void)values;                                                               \
        return none(c, n);                                                                      \
    }
WITHOUT(int, Integer)
WITHOUT(int, Boolean)
WITHOUT(Text, String)

EXPORT fmi2Status NAME(fmi2GetFMUstate)(void *c, void **state) {
    Instance *i = c;
    if (!i || !state) return fmi2Error;
    void *copy = snapshot(i);
    if (!copy) say(i, "not enough memory for a copy of the state");
    else {
        free(*state);
        *state = copy;
    }
    return report(i, copy != NULL);
}

EXPORT fmi2Status NAME(fmi2SetFMUstate)(void *c, void *state) {
    Instance *i = c;
    if (!i || !state) return fmi2Error;
    int good = restore(i, state);
    if (!good) say(i, "not enough memory to take a state back");
    return report(i, good);
}

EXPORT fmi2Status NAME(fmi2FreeFMUstate)(void *c, void **state) {
    (void)c;
    if (state) {
        free(*state);
        *state = NULL;
    }
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2SerializedFMUstateSize)(void *c, void *state, size_t *size) {
    if (!c || !state || !size) return fmi2Error;
    *size = snapshot_size(state);
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2SerializeFMUstate)(void *c, void *state, char bytes[], size_t size) {
    Instance *i = c;
    if (!i || !state) return fmi2Error;
    int good = snapshot_write(state, bytes, size) > 0;
    if (!good) say(i, "the room for the serialised state is too small");
    return report(i, good);
}

EXPORT fmi2Status NAME(fmi2DeSerializeFMUstate)(void *c, const char bytes[], size_t size, void **state) {
    Instance *i = c;
    if (!i || !state) return fmi2Error;
    void *copy = snapshot_read(bytes, size);
    if (!copy) say(i, "the bytes are no state of this FMU");
    else {
        free(*state);
        *state = copy;
    }
    return report(i, copy != NULL);
}

EXPORT fmi2Status NAME(fmi2GetDirectionalDerivative)(void *c, const Ref unknown[], size_t nu, const Ref known[], size_t nk, const double seed[], double result[]) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi2GetDirectionalDerivative");
    return report(i, directional_by_reference(i, unknown, nu, known, nk, seed, result));
}

/* --- model exchange --- */

EXPORT fmi2Status NAME(fmi2EnterEventMode)(void *c) {
    CHECK(IN(CONTINUOUS) | IN(EVENT), "fmi2EnterEventMode");
    int good = complete_step(i);
    i->s.phase = EVENT;
    i->s.stale = 1;
    return report(i, good);
}

EXPORT fmi2Status NAME(fmi2NewDiscreteStates)(void *c, EventInfo *info) {
    CHECK(IN(EVENT), "fmi2NewDiscreteStates");
    memset(info, 0, sizeof *info);
    return report(i, update_events(i, &info->nextEventTimeDefined, &info->nextEventTime));
}

EXPORT fmi2Status NAME(fmi2EnterContinuousTimeMode)(void *c) {
    CHECK(IN(EVENT), "fmi2EnterContinuousTimeMode");
    return report(i, leave_event_mode(i));
}

EXPORT fmi2Status NAME(fmi2CompletedIntegratorStep)(void *c, int no_return, int *enter_event, int *terminate) {
    CHECK(IN(CONTINUOUS), "fmi2CompletedIntegratorStep");
    (void)no_return;
    *enter_event = *terminate = 0;
    return report(i, complete_step(i));
}

EXPORT fmi2Status NAME(fmi2SetTime)(void *c, double t) {
    CHECK(IN(EVENT) | IN(CONTINUOUS), "fmi2SetTime");
    return report(i, set_time(i, t));
}

static int as_many(Instance *i, size_t n, size_t expected) {
    if (n == expected) return 1;
    say(i, "%u values were given or asked for where there are %u", (unsigned)n, (unsigned)expected);
    return 0;
}

EXPORT fmi2Status NAME(fmi2SetContinuousStates)(void *c, const double x[], size_t n) {
    CHECK(IN(EVENT) | IN(CONTINUOUS), "fmi2SetContinuousStates");
    return report(i, as_many(i, n, NX) && set_states(i, x));
}

EXPORT fmi2Status NAME(fmi2GetDerivatives)(void *c, double values[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi2GetDerivatives");
    return report(i, as_many(i, n, NX) && get_rates(i, values));
}

EXPORT fmi2Status NAME(fmi2GetEventIndicators)(void *c, double values[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi2GetEventIndicators");
    return report(i, as_many(i, n, NS) && get_indicators(i, values));
}

EXPORT fmi2Status NAME(fmi2GetContinuousStates)(void *c, double x[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi2GetContinuousStates");
    Ref refs[SOME(NX)];
    for (int k = 0; k < NX; k++) refs[k] = REF_STATE + (Ref)k;
    return report(i, as_many(i, n, NX) && get_values(i, refs, NX, x));
}

EXPORT fmi2Status NAME(fmi2GetNominalsOfContinuousStates)(void *c, double values[], size_t n) {
    CHECK(~0, "fmi2GetNominalsOfContinuousStates");
    if (n == NX) memcpy(values, model_nominals, NX * sizeof(double));
    return report(i, as_many(i, n, NX));
}

/* --- co-simulation --- */

EXPORT fmi2Status NAME(fmi2SetRealInputDerivatives)(void *c, const Ref refs[], size_t n, const int orders[], const double values[]) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | IN(STEP), "fmi2SetRealInputDerivatives");
    for (size_t k = 0; k < n; k++) {
        if (orders[k] != 1) {
            say(i, "inputs have a slope and no derivative of order %d", orders[k]);
            return report(i, 0);
        }
        if (!set_slope(i, refs[k], values[k])) return report(i, 0);
    }
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2GetRealOutputDerivatives)(void *c, const Ref refs[], size_t n, const int orders[], double values[]) {
    CHECK(~0, "fmi2GetRealOutputDerivatives");
    (void)refs, (void)orders, (void)values;
    if (n) say(i, "derivatives of outputs are not offered (maxOutputDerivativeOrder is 0)");
    return report(i, n == 0);
}

EXPORT fmi2Status NAME(fmi2DoStep)(void *c, double t, double h, int no_return) {
    CHECK(IN(STEP), "fmi2DoStep");
    (void)no_return;
    return report(i, do_step(i, t, h));
}

EXPORT fmi2Status NAME(fmi2CancelStep)(void *c) {
    CHECK(0, "fmi2CancelStep");
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2GetStatus)(void *c, const fmi2StatusKind kind, fmi2Status *value) {
    if (!c || kind != fmi2DoStepStatus) return fmi2Discard;
    *value = fmi2OK;
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2GetRealStatus)(void *c, const fmi2StatusKind kind, double *value) {
    if (!c || kind != fmi2LastSuccessfulTime) return fmi2Discard;
    *value = ((Instance *)c)->s.t;
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2GetIntegerStatus)(void *c, const fmi2StatusKind kind, int *value) {
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

EXPORT fmi2Status NAME(fmi2GetBooleanStatus)(void *c, const fmi2StatusKind kind, int *value) {
    if (!c || kind != fmi2Terminated) return fmi2Discard;
    *value = 0;
    return fmi2OK;
}

EXPORT fmi2Status NAME(fmi2GetStringStatus)(void *c, const fmi2StatusKind kind, Text *value) {
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
