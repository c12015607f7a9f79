/* The functions of FMI 3.0, model exchange and co-simulation. Types and names after the standard's text. */
#include "fmi.h"

typedef const uint8_t *Binary;
typedef void (*Logger)(void *, Status, Text, Text);

static void log_error(Instance *i) { ((Logger)i->logger)(i->environment, fmiError, "logStatusError", i->message); }

static Status without(void *c, Text function) {
    Instance *i = c;
    if (!i) return fmiError;
    say(i, "%s is not offered by this FMU", function);
    return report(i, 0);
}

EXPORT Text FMI(GetVersion)(void) { return "3.0"; }

/* --- instances --- */

static void *instance(Text name, Text token, int cosimulation, bool logging, void *environment, Logger logger) {
    Instance *i = make(name, token, cosimulation);
    if (!i) {
        if (logger)
            logger(environment, fmiError, "logStatusError",
                   "no instance: the token is not this FMU's, or there is not enough memory");
        return NULL;
    }
    i->logging = logging;
    i->logger = (void (*)(void))logger;
    i->environment = environment;
    return i;
}

EXPORT void *FMI(InstantiateModelExchange)(Text name, Text token, Text resources, bool visible, bool logging, void *environment,
                                           Logger logger) {
    (void)resources, (void)visible;
    return instance(name, token, 0, logging, environment, logger);
}

EXPORT void *FMI(InstantiateCoSimulation)(Text name, Text token, Text resources, bool visible, bool logging, bool event_mode,
                                          bool early_return, const Ref required[], size_t n, void *environment,
                                          Logger logger, void *intermediate_update) {
    (void)resources, (void)visible, (void)early_return, (void)required, (void)n, (void)intermediate_update;
    if (event_mode) {
        if (logger) logger(environment, fmiError, "logStatusError", "co-simulation with event mode is not offered");
        return NULL;
    }
    return instance(name, token, 1, logging, environment, logger);
}

EXPORT void *FMI(InstantiateScheduledExecution)(Text name, Text token, Text resources, bool visible, bool logging,
                                                void *environment, Logger logger, void *clock_update, void *lock,
                                                void *unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock_update, (void)lock, (void)unlock;
    if (logger) logger(environment, fmiError, "logStatusError", "scheduled execution is not offered");
    return NULL;
}

EXPORT Status FMI(EnterInitializationMode)(void *c, bool has_tolerance, double tolerance, double start, bool has_stop,
                                           double stop) {
    CHECK(IN(INSTANTIATED), "EnterInitializationMode");
    begin(i, start, has_stop, stop, has_tolerance, tolerance);
    i->s.phase = INITIALIZATION;
    return fmiOK;
}

/* --- values --- */

EXPORT Status FMI(GetFloat64)(void *c, const Ref refs[], size_t n, double values[], size_t count) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | RUNNING, "GetFloat64");
    return report(i, as_many(i, count, n) && get_by_reference(i, refs, n, values));
}

EXPORT Status FMI(SetFloat64)(void *c, const Ref refs[], size_t n, const double values[], size_t count) {
    CHECK(SETTABLE, "SetFloat64");
    return report(i, as_many(i, count, n) && set_by_reference(i, refs, n, values));
}

/* There are no variables of the other types. */
#define WITHOUT(type, kind)                                                                                \
    EXPORT Status FMI(Get##kind)(void *c, const Ref refs[], size_t n, type values[], size_t count) {       \
        (void)refs, (void)values, (void)count;                                                             \
        return no_variables(c, n);                                                                         \
    }                                                                                                      \
    EXPORT Status FMI(Set##kind)(void *c, const Ref refs[], size_t n, const type values[], size_t count) { \
        (void)refs, (void)values, (void)count;                                                             \
        return no_variables(c, n);                                                                         \
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

EXPORT Status FMI(GetBinary)(void *c, const Ref refs[], size_t n, size_t sizes[], Binary values[], size_t count) {
    (void)refs, (void)sizes, (void)values, (void)count;
    return no_variables(c, n);
}

EXPORT Status FMI(SetBinary)(void *c, const Ref refs[], size_t n, const size_t sizes[], const Binary values[], size_t count) {
    (void)refs, (void)sizes, (void)values, (void)count;
    return no_variables(c, n);
}

EXPORT Status FMI(GetClock)(void *c, const Ref refs[], size_t n, bool values[]) {
    (void)refs, (void)values;
    return no_variables(c, n);
}

EXPORT Status FMI(SetClock)(void *c, const Ref refs[], size_t n, const bool values[]) {
    (void)refs, (void)values;
    return no_variables(c, n);
}

/* --- what depends on what: as the model description says --- */

EXPORT Status FMI(GetNumberOfVariableDependencies)(void *c, Ref ref, size_t *n) {
    (void)ref, (void)n;
    return without(c, "fmi3GetNumberOfVariableDependencies");
}

EXPORT Status FMI(GetVariableDependencies)(void *c, Ref dependent, size_t elements[], Ref independents[],
                                           size_t independent_elements[], int kinds[], size_t n) {
    (void)dependent, (void)elements, (void)independents, (void)independent_elements, (void)kinds, (void)n;
    return without(c, "fmi3GetVariableDependencies");
}

/* --- derivatives --- */

EXPORT Status FMI(GetDirectionalDerivative)(void *c, const Ref unknowns[], size_t nu, const Ref knowns[], size_t nk,
                                            const double seed[], size_t ns, double result[], size_t nr) {
    CHECK(IN(INITIALIZATION) | RUNNING, "GetDirectionalDerivative");
    return report(i, as_many(i, ns, nk) && as_many(i, nr, nu) &&
                         directional_by_reference(i, unknowns, nu, knowns, nk, seed, result));
}

EXPORT Status FMI(GetAdjointDerivative)(void *c, const Ref unknowns[], size_t nu, const Ref knowns[], size_t nk,
                                        const double seed[], size_t ns, double result[], size_t nr) {
    (void)unknowns, (void)nu, (void)knowns, (void)nk, (void)seed, (void)ns, (void)result, (void)nr;
    return without(c, "fmi3GetAdjointDerivative");
}

/* --- modes and clocks that this FMU does not have --- */

EXPORT Status FMI(EnterConfigurationMode)(void *c) { return without(c, "fmi3EnterConfigurationMode"); }
EXPORT Status FMI(ExitConfigurationMode)(void *c) { return without(c, "fmi3ExitConfigurationMode"); }

EXPORT Status FMI(GetIntervalDecimal)(void *c, const Ref refs[], size_t n, double intervals[], int qualifiers[]) {
    (void)refs, (void)intervals, (void)qualifiers;
    return no_variables(c, n);
}

EXPORT Status FMI(GetIntervalFraction)(void *c, const Ref refs[], size_t n, uint64_t counters[], uint64_t resolutions[],
                                       int qualifiers[]) {
    (void)refs, (void)counters, (void)resolutions, (void)qualifiers;
    return no_variables(c, n);
}

EXPORT Status FMI(GetShiftDecimal)(void *c, const Ref refs[], size_t n, double shifts[]) {
    (void)refs, (void)shifts;
    return no_variables(c, n);
}

EXPORT Status FMI(GetShiftFraction)(void *c, const Ref refs[], size_t n, uint64_t counters[], uint64_t resolutions[]) {
    (void)refs, (void)counters, (void)resolutions;
    return no_variables(c, n);
}

EXPORT Status FMI(SetIntervalDecimal)(void *c, const Ref refs[], size_t n, const double intervals[]) {
    (void)refs, (void)intervals;
    return no_variables(c, n);
}

EXPORT Status FMI(SetIntervalFraction)(void *c, const Ref refs[], size_t n, const uint64_t counters[],
                                       const uint64_t resolutions[]) {
    (void)refs, (void)counters, (void)resolutions;
    return no_variables(c, n);
}

EXPORT Status FMI(SetShiftDecimal)(void *c, const Ref refs[], size_t n, const double shifts[]) {
    (void)refs, (void)shifts;
    return no_variables(c, n);
}

EXPORT Status FMI(SetShiftFraction)(void *c, const Ref refs[], size_t n, const uint64_t counters[],
                                    const uint64_t resolutions[]) {
    (void)refs, (void)counters, (void)resolutions;
    return no_variables(c, n);
}

EXPORT Status FMI(ActivateModelPartition)(void *c, Ref clock, double time) {
    (void)clock, (void)time;
    return without(c, "fmi3ActivateModelPartition");
}

/* --- events --- */

EXPORT Status FMI(EvaluateDiscreteStates)(void *c) {
    CHECK(IN(INITIALIZATION) | IN(EVENT), "EvaluateDiscreteStates");
    return fmiOK;
}

EXPORT Status FMI(UpdateDiscreteStates)(void *c, bool *needed, bool *terminate, bool *nominals, bool *values,
                                        bool *has_next, double *next) {
    CHECK(IN(EVENT), "UpdateDiscreteStates");
    int defined = 0;
    *needed = *terminate = *nominals = *values = false;
    int good = update_events(i, &defined, next);
    *has_next = defined;
    return report(i, good);
}

EXPORT Status FMI(EnterStepMode)(void *c) { return without(c, "fmi3EnterStepMode"); }

/* --- model exchange --- */

EXPORT Status FMI(GetNumberOfEventIndicators)(void *c, size_t *n) {
    if (!c) return fmiError;
    *n = NS;
    return fmiOK;
}

EXPORT Status FMI(GetNumberOfContinuousStates)(void *c, size_t *n) {
    if (!c) return fmiError;
    *n = NX;
    return fmiOK;
}

/* --- co-simulation --- */

EXPORT Status FMI(GetOutputDerivatives)(void *c, const Ref refs[], size_t n, const int32_t orders[], double values[],
                                        size_t count) {
    (void)refs, (void)orders, (void)values, (void)count;
    return n ? without(c, "fmi3GetOutputDerivatives") : fmiOK;
}

EXPORT Status FMI(DoStep)(void *c, double t, double h, bool no_return, bool *event, bool *terminate, bool *early,
                          double *last) {
    CHECK(IN(STEP), "DoStep");
    (void)no_return;
    *event = *terminate = *early = false;
    int good = do_step(i, t, h);
    *last = i->r.t;
    return report(i, good);
}
