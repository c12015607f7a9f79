/* The functions of FMI 3.0, model exchange and co-simulation. Types and names after the standard's text. */
#include <stdbool.h>
#include <stdint.h>

#include "internal.h"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
/* Where sources are linked statically, the builder defines FMI3_FUNCTION_PREFIX as the model identifier and _. */
#define PASTE2(a, b) a##b
#define PASTE(a, b) PASTE2(a, b)
#ifdef FMI3_FUNCTION_PREFIX
#define NAME(f) PASTE(FMI3_FUNCTION_PREFIX, f)
#else
#define NAME(f) f
#endif

typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } Status;
typedef unsigned int Ref;
typedef const char *Text;
typedef const uint8_t *Binary;
typedef void (*Logger)(void *, Status, Text, Text);

#define IN(phase) (1 << (phase))
#define RUNNING (IN(EVENT) | IN(CONTINUOUS) | IN(STEP) | IN(TERMINATED))

static Status report(Instance *i, int good) {
    if (good) return fmi3OK;
    if (i->logger) ((Logger)i->logger)(i->environment, fmi3Error, "logStatusError", i->message);
    return fmi3Error;
}

static int allowed(Instance *i, int phases, Text function) {
    if (IN(i->s.phase) & phases) return 1;
    say(i, "%s is not allowed in this state of the FMU", function);
    return 0;
}

static int as_many(Instance *i, size_t n, size_t expected) {
    if (n == expected) return 1;
    say(i, "%u values were given or asked for where there are %u", (unsigned)n, (unsigned)expected);
    return 0;
}

static Status without(void *c, Text function) {
    Instance *i = c;
    if (!i) return fmi3Error;
    say(i, "%s is not offered by this FMU", function);
    return report(i, 0);
}

#define CHECK(phases, function) \
    Instance *i = c;            \
    if (!i) return fmi3Error;   \
    if (!allowed(i, phases, function)) return report(i, 0)

EXPORT Text NAME(fmi3GetVersion)(void) { return "3.0"; }

EXPORT Status NAME(fmi3SetDebugLogging)(void *c, bool on, size_t n, const Text categories[]) {
    (void)n, (void)categories;
    if (!c) return fmi3Error;
    ((Instance *)c)->logging = on;
    return fmi3OK;
}

/* --- instances --- */

static void *instance(Text name, Text token, int cosimulation, bool logging, void *environment, Logger logger) {
    Instance *i = make(name, token, cosimulation);
    if (!i) {
        if (logger)
            logger(environment, fmi3Error, "logStatusError",
                   "no instance: the token is not this FMU's, or there is not enough memory");
        return NULL;
    }
    i->logging = logging;
    i->logger = (void (*)(void))logger;
    i->environment = environment;
    return i;
}

EXPORT void *NAME(fmi3InstantiateModelExchange)(Text name, Text token, Text resources, bool visible, bool logging, void *environment,
                                                Logger logger) {
    (void)resources, (void)visible;
    return instance(name, token, 0, logging, environment, logger);
}

EXPORT void *NAME(fmi3InstantiateCoSimulation)(Text name, Text token, Text resources, bool visible, bool logging, bool event_mode,
                                               bool early_return, const Ref required[], size_t n, void *environment,
                                               Logger logger, void *intermediate_update) {
    (void)resources, (void)visible, (void)early_return, (void)required, (void)n, (void)intermediate_update;
    if (event_mode) {
        if (logger) logger(environment, fmi3Error, "logStatusError", "co-simulation with event mode is not offered");
        return NULL;
    }
    return instance(name, token, 1, logging, environment, logger);
}

EXPORT void *NAME(fmi3InstantiateScheduledExecution)(Text name, Text token, Text resources, bool visible, bool logging,
                                                     void *environment, Logger logger, void *clock_update, void *lock,
                                                     void *unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock_update, (void)lock, (void)unlock;
    if (logger) logger(environment, fmi3Error, "logStatusError", "scheduled execution is not offered");
    return NULL;
}

EXPORT void NAME(fmi3FreeInstance)(void *c) { discard(c); }

EXPORT Status NAME(fmi3EnterInitializationMode)(void *c, bool has_tolerance, double tolerance, double start, bool has_stop,
                                                double stop) {
    CHECK(IN(INSTANTIATED), "fmi3EnterInitializationMode");
    begin(i, start, has_stop, stop, has_tolerance, tolerance);
    i->s.phase = INITIALIZATION;
    return fmi3OK;
}

EXPORT Status NAME(fmi3ExitInitializationMode)(void *c) {
    CHECK(IN(INITIALIZATION), "fmi3ExitInitializationMode");
    return report(i, finish_start(i));
}

EXPORT Status NAME(fmi3EnterEventMode)(void *c) {
    CHECK(IN(CONTINUOUS) | IN(EVENT), "fmi3EnterEventMode");
    int good = complete_step(i);
    i->s.phase = EVENT;
    i->s.stale = 1;
    return report(i, good);
}

EXPORT Status NAME(fmi3Terminate)(void *c) {
    CHECK(RUNNING, "fmi3Terminate");
    i->s.phase = TERMINATED;
    return fmi3OK;
}

EXPORT Status NAME(fmi3Reset)(void *c) {
    if (!c) return fmi3Error;
    reset(c);
    return fmi3OK;
}

/* --- values --- */

EXPORT Status NAME(fmi3GetFloat64)(void *c, const Ref refs[], size_t n, double values[], size_t count) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | RUNNING, "fmi3GetFloat64");
    return report(i, as_many(i, count, n) && get_values(i, refs, n, values));
}

EXPORT Status NAME(fmi3SetFloat64)(void *c, const Ref refs[], size_t n, const double values[], size_t count) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | IN(EVENT) | IN(CONTINUOUS) | IN(STEP), "fmi3SetFloat64");
    return report(i, as_many(i, count, n) && set_values(i, refs, n, values));
}

/* There are no variables of the other types. */
static Status none(Instance *i, size_t n) {
    if (!i) return fmi3Error;
    if (n == 0) return fmi3OK;
    say(i, "all variables of this FMU are of type Float64");
    return report(i, 0);
}

#define WITHOUT(type, kind)                                                                                       \
    EXPORT Status NAME(fmi3Get##kind)(void *c, const Ref refs[], size_t n, type values[], size_t count) {         \
        (void)refs, (void)values, (void)count;                                                                    \
        return none(c, n);                                                                                        \
    }                                                                                                             \
    EXPORT Status NAME(fmi3Set##kind)(void *c, const Ref refs[], size_t n, const type values[], size_t count) {   \
        (void)refs, (void)values, (void)count;                                                                    \
        return none(c, n);                                                                                        \
    }
WITHOUT(float, Float32)
WITHOUT(int8_t, Int8)
WITHOUT(uint8_t, UInt8)
WITHOUT(int16_t, Int16)
WITHOUT(uint16_t, UInt16)
WITHOUT(int32_t, Int32)
WITHOUT(uint32_t, UInt32)
WITHOUT(int64_t, Int64)
WITHOUT(uint64_t, UInt64)
WITHOUT(bool, Boolean)
WITHOUT(Text, String)

EXPORT Status NAME(fmi3GetBinary)(void *c, const Ref refs[], size_t n, size_t sizes[], Binary values[], size_t count) {
    (void)refs, (void)sizes, (void)values, (void)count;
    return none(c, n);
}

EXPORT Status NAME(fmi3SetBinary)(void *c, const Ref refs[], size_t n, const size_t sizes[], const Binary values[], size_t count) {
    (void)refs, (void)sizes, (void)values, (void)count;
    return none(c, n);
}

EXPORT Status NAME(fmi3GetClock)(void *c, const Ref refs[], size_t n, bool values[]) {
    (void)refs, (void)values;
    return none(c, n);
}

EXPORT Status NAME(fmi3SetClock)(void *c, const Ref refs[], size_t n, const bool values[]) {
    (void)refs, (void)values;
    return none(c, n);
}

/* --- what depends on what: as the model description says --- */

EXPORT Status NAME(fmi3GetNumberOfVariableDependencies)(void *c, Ref ref, size_t *n) {
    (void)ref, (void)n;
    return without(c, "fmi3GetNumberOfVariableDependencies");
}

EXPORT Status NAME(fmi3GetVariableDependencies)(void *c, Ref dependent, size_t elements[], Ref independents[],
                                                size_t independent_elements[], int kinds[], size_t n) {
    (void)dependent, (void)elements, (void)independents, (void)independent_elements, (void)kinds, (void)n;
    return without(c, "fmi3GetVariableDependencies");
}

/* --- copies of the state --- */

EXPORT Status NAME(fmi3GetFMUState)(void *c, void **state) {
    Instance *i = c;
    if (!i || !state) return fmi3Error;
    void *copy = snapshot(i);
    if (!copy) {
        say(i, "not enough memory for a copy of the state");
    } else {
        free(*state);
        *state = copy;
    }
    return report(i, copy != NULL);
}

EXPORT Status NAME(fmi3SetFMUState)(void *c, void *state) {
    Instance *i = c;
    if (!i || !state) return fmi3Error;
    int good = restore(i, state);
    if (!good) say(i, "not enough memory to take a state back");
    return report(i, good);
}

EXPORT Status NAME(fmi3FreeFMUState)(void *c, void **state) {
    (void)c;
    if (state) {
        free(*state);
        *state = NULL;
    }
    return fmi3OK;
}

EXPORT Status NAME(fmi3SerializedFMUStateSize)(void *c, void *state, size_t *size) {
    if (!c || !state || !size) return fmi3Error;
    *size = snapshot_size(state);
    return fmi3OK;
}

EXPORT Status NAME(fmi3SerializeFMUState)(void *c, void *state, uint8_t bytes[], size_t size) {
    Instance *i = c;
    if (!i || !state) return fmi3Error;
    int good = snapshot_write(state, (char *)bytes, size) > 0;
    if (!good) say(i, "the room for the serialised state is too small");
    return report(i, good);
}

EXPORT Status NAME(fmi3DeserializeFMUState)(void *c, const uint8_t bytes[], size_t size, void **state) {
    Instance *i = c;
    if (!i || !state) return fmi3Error;
    void *copy = snapshot_read((const char *)bytes, size);
    if (!copy) {
        say(i, "the bytes are no state of this FMU");
    } else {
        free(*state);
        *state = copy;
    }
    return report(i, copy != NULL);
}

/* --- derivatives --- */

EXPORT Status NAME(fmi3GetDirectionalDerivative)(void *c, const Ref unknowns[], size_t nu, const Ref knowns[], size_t nk,
                                                 const double seed[], size_t ns, double result[], size_t nr) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi3GetDirectionalDerivative");
    return report(i, as_many(i, ns, nk) && as_many(i, nr, nu) &&
                         directional_by_reference(i, unknowns, nu, knowns, nk, seed, result));
}

EXPORT Status NAME(fmi3GetAdjointDerivative)(void *c, const Ref unknowns[], size_t nu, const Ref knowns[], size_t nk,
                                             const double seed[], size_t ns, double result[], size_t nr) {
    (void)unknowns, (void)nu, (void)knowns, (void)nk, (void)seed, (void)ns, (void)result, (void)nr;
    return without(c, "fmi3GetAdjointDerivative");
}

/* --- modes and clocks that this FMU does not have --- */

EXPORT Status NAME(fmi3EnterConfigurationMode)(void *c) { return without(c, "fmi3EnterConfigurationMode"); }
EXPORT Status NAME(fmi3ExitConfigurationMode)(void *c) { return without(c, "fmi3ExitConfigurationMode"); }

EXPORT Status NAME(fmi3GetIntervalDecimal)(void *c, const Ref refs[], size_t n, double intervals[], int qualifiers[]) {
    (void)refs, (void)intervals, (void)qualifiers;
    return none(c, n);
}

EXPORT Status NAME(fmi3GetIntervalFraction)(void *c, const Ref refs[], size_t n, uint64_t counters[], uint64_t resolutions[],
                                            int qualifiers[]) {
    (void)refs, (void)counters, (void)resolutions, (void)qualifiers;
    return none(c, n);
}

EXPORT Status NAME(fmi3GetShiftDecimal)(void *c, const Ref refs[], size_t n, double shifts[]) {
    (void)refs, (void)shifts;
    return none(c, n);
}

EXPORT Status NAME(fmi3GetShiftFraction)(void *c, const Ref refs[], size_t n, uint64_t counters[], uint64_t resolutions[]) {
    (void)refs, (void)counters, (void)resolutions;
    return none(c, n);
}

EXPORT Status NAME(fmi3SetIntervalDecimal)(void *c, const Ref refs[], size_t n, const double intervals[]) {
    (void)refs, (void)intervals;
    return none(c, n);
}

EXPORT Status NAME(fmi3SetIntervalFraction)(void *c, const Ref refs[], size_t n, const uint64_t counters[],
                                            const uint64_t resolutions[]) {
    (void)refs, (void)counters, (void)resolutions;
    return none(c, n);
}

EXPORT Status NAME(fmi3SetShiftDecimal)(void *c, const Ref refs[], size_t n, const double shifts[]) {
    (void)refs, (void)shifts;
    return none(c, n);
}

EXPORT Status NAME(fmi3SetShiftFraction)(void *c, const Ref refs[], size_t n, const uint64_t counters[],
                                         const uint64_t resolutions[]) {
    (void)refs, (void)counters, (void)resolutions;
    return none(c, n);
}

EXPORT Status NAME(fmi3ActivateModelPartition)(void *c, Ref clock, double time) {
    (void)clock, (void)time;
    return without(c, "fmi3ActivateModelPartition");
}

/* --- events --- */

EXPORT Status NAME(fmi3EvaluateDiscreteStates)(void *c) {
    CHECK(IN(INITIALIZATION) | IN(EVENT), "fmi3EvaluateDiscreteStates");
    return fmi3OK;
}

EXPORT Status NAME(fmi3UpdateDiscreteStates)(void *c, bool *needed, bool *terminate, bool *nominals, bool *values,
                                             bool *has_next, double *next) {
    CHECK(IN(EVENT), "fmi3UpdateDiscreteStates");
    int defined = 0;
    *needed = *terminate = *nominals = *values = false;
    int good = update_events(i, &defined, next);
    *has_next = defined;
    return report(i, good);
}

EXPORT Status NAME(fmi3EnterContinuousTimeMode)(void *c) {
    CHECK(IN(EVENT), "fmi3EnterContinuousTimeMode");
    return report(i, leave_event_mode(i));
}

EXPORT Status NAME(fmi3EnterStepMode)(void *c) { return without(c, "fmi3EnterStepMode"); }

/* --- model exchange --- */

EXPORT Status NAME(fmi3CompletedIntegratorStep)(void *c, bool no_return, bool *enter_event, bool *terminate) {
    CHECK(IN(CONTINUOUS), "fmi3CompletedIntegratorStep");
    (void)no_return;
    *enter_event = *terminate = false;
    return report(i, complete_step(i));
}

EXPORT Status NAME(fmi3SetTime)(void *c, double t) {
    CHECK(IN(EVENT) | IN(CONTINUOUS), "fmi3SetTime");
    return report(i, set_time(i, t));
}

EXPORT Status NAME(fmi3SetContinuousStates)(void *c, const double x[], size_t n) {
    CHECK(IN(EVENT) | IN(CONTINUOUS), "fmi3SetContinuousStates");
    return report(i, as_many(i, n, NX) && set_states(i, x));
}

EXPORT Status NAME(fmi3GetContinuousStateDerivatives)(void *c, double values[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi3GetContinuousStateDerivatives");
    return report(i, as_many(i, n, NX) && get_rates(i, values));
}

EXPORT Status NAME(fmi3GetEventIndicators)(void *c, double values[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi3GetEventIndicators");
    return report(i, as_many(i, n, NS) && get_indicators(i, values));
}

EXPORT Status NAME(fmi3GetContinuousStates)(void *c, double x[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "fmi3GetContinuousStates");
    Ref refs[SOME(NX)];
    for (int k = 0; k < NX; k++) refs[k] = REF_STATE + (Ref)k;
    return report(i, as_many(i, n, NX) && get_values(i, refs, NX, x));
}

EXPORT Status NAME(fmi3GetNominalsOfContinuousStates)(void *c, double values[], size_t n) {
    CHECK(~0, "fmi3GetNominalsOfContinuousStates");
    if (n == NX) memcpy(values, model_nominals, NX * sizeof(double));
    return report(i, as_many(i, n, NX));
}

EXPORT Status NAME(fmi3GetNumberOfEventIndicators)(void *c, size_t *n) {
    if (!c) return fmi3Error;
    *n = NS;
    return fmi3OK;
}

EXPORT Status NAME(fmi3GetNumberOfContinuousStates)(void *c, size_t *n) {
    if (!c) return fmi3Error;
    *n = NX;
    return fmi3OK;
}

/* --- co-simulation --- */

EXPORT Status NAME(fmi3GetOutputDerivatives)(void *c, const Ref refs[], size_t n, const int32_t orders[], double values[],
                                             size_t count) {
    (void)refs, (void)orders, (void)values, (void)count;
    return n ? without(c, "fmi3GetOutputDerivatives") : fmi3OK;
}

EXPORT Status NAME(fmi3DoStep)(void *c, double t, double h, bool no_return, bool *event, bool *terminate, bool *early,
                               double *last) {
    CHECK(IN(STEP), "fmi3DoStep");
    (void)no_return;
    *event = *terminate = *early = false;
    int good = do_step(i, t, h);
    *last = i->s.t;
    return report(i, good);
}
