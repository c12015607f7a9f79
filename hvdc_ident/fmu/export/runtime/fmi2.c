/* The functions of FMI 2.0, model exchange and co-simulation. Types and names after the standard's text. */
#include "fmi.h"

typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef void (*Logger)(void *, Text, Status, Text, Text, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*step_finished)(void *, Status);
    void *environment;
} Callbacks;
typedef struct {
    int newDiscreteStatesNeeded, terminateSimulation, nominalsOfContinuousStatesChanged, valuesOfContinuousStatesChanged;
    int nextEventTimeDefined;
    double nextEventTime;
} EventInfo;

static void log_error(Instance *i) {
    ((Logger)i->logger)(i->environment, i->name, fmiError, "logStatusError", "%s", i->message);
}

EXPORT Text FMI(GetTypesPlatform)(void) { return "default"; }
EXPORT Text FMI(GetVersion)(void) { return "2.0"; }

EXPORT void *FMI(Instantiate)(Text name, fmi2Type type, Text guid, Text resources, const Callbacks *functions, int visible, int logging) {
    (void)resources, (void)visible;
    Instance *i = make(name, guid, type == fmi2CoSimulation);
    if (!i) {
        if (functions && functions->logger)
            functions->logger(functions->environment, name, fmiError, "logStatusError",
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

EXPORT Status FMI(SetupExperiment)(void *c, int has_tolerance, double tolerance, double start, int has_stop, double stop) {
    CHECK(IN(INSTANTIATED), "SetupExperiment");
    begin(i, start, has_stop, stop, has_tolerance, tolerance);
    return fmiOK;
}

EXPORT Status FMI(EnterInitializationMode)(void *c) {
    CHECK(IN(INSTANTIATED), "EnterInitializationMode");
    i->s.phase = INITIALIZATION;
    return fmiOK;
}

EXPORT Status FMI(GetReal)(void *c, const Ref refs[], size_t n, double values[]) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | RUNNING, "GetReal");
    return report(i, get_by_reference(i, refs, n, values));
}

EXPORT Status FMI(SetReal)(void *c, const Ref refs[], size_t n, const double values[]) {
    CHECK(SETTABLE, "SetReal");
    return report(i, set_by_reference(i, refs, n, values));
}

/* There are no variables of the other types. */
#define WITHOUT(type, kind)                                                                  \
    EXPORT Status FMI(Get##kind)(void *c, const Ref refs[], size_t n, type values[]) {       \
        (void)refs, (void)values;                                                            \
        return no_variables(c, n);                                                           \
    }                                                                                        \
    EXPORT Status FMI(Set##kind)(void *c, const Ref refs[], size_t n, const type values[]) { \
        (void)refs, (void)values;                                                            \
        return no_variables(c, n);                                                           \
    }
WITHOUT(int, Integer)
WITHOUT(int, Boolean)
WITHOUT(Text, String)

EXPORT Status FMI(GetDirectionalDerivative)(void *c, const Ref unknown[], size_t nu, const Ref known[], size_t nk, const double seed[], double result[]) {
    CHECK(IN(INITIALIZATION) | RUNNING, "GetDirectionalDerivative");
    return report(i, directional_by_reference(i, unknown, nu, known, nk, seed, result));
}

/* --- model exchange --- */

EXPORT Status FMI(NewDiscreteStates)(void *c, EventInfo *info) {
    CHECK(IN(EVENT), "NewDiscreteStates");
    memset(info, 0, sizeof *info);
    return report(i, update_events(i, &info->nextEventTimeDefined, &info->nextEventTime));
}

/* --- co-simulation --- */

EXPORT Status FMI(SetRealInputDerivatives)(void *c, const Ref refs[], size_t n, const int orders[], const double values[]) {
    CHECK(IN(INSTANTIATED) | IN(INITIALIZATION) | IN(STEP), "SetRealInputDerivatives");
    for (size_t k = 0; k < n; k++) {
        if (orders[k] != 1) {
            say(i, "inputs have a slope and no derivative of order %d", orders[k]);
            return report(i, 0);
        }
        if (!set_slope(i, refs[k], values[k])) return report(i, 0);
    }
    return fmiOK;
}

EXPORT Status FMI(GetRealOutputDerivatives)(void *c, const Ref refs[], size_t n, const int orders[], double values[]) {
    CHECK(~0, "GetRealOutputDerivatives");
    (void)refs, (void)orders, (void)values;
    if (n) say(i, "derivatives of outputs are not offered (maxOutputDerivativeOrder is 0)");
    return report(i, n == 0);
}

EXPORT Status FMI(DoStep)(void *c, double t, double h, int no_return) {
    CHECK(IN(STEP), "DoStep");
    (void)no_return;
    return report(i, do_step(i, t, h));
}

EXPORT Status FMI(CancelStep)(void *c) {
    CHECK(0, "CancelStep");
    return fmiOK;
}

EXPORT Status FMI(GetStatus)(void *c, const fmi2StatusKind kind, Status *value) {
    if (!c || kind != fmi2DoStepStatus) return fmiDiscard;
    *value = fmiOK;
    return fmiOK;
}

EXPORT Status FMI(GetRealStatus)(void *c, const fmi2StatusKind kind, double *value) {
    if (!c || kind != fmi2LastSuccessfulTime) return fmiDiscard;
    *value = ((Instance *)c)->r.t;
    return fmiOK;
}

EXPORT Status FMI(GetIntegerStatus)(void *c, const fmi2StatusKind kind, int *value) {
    (void)c, (void)kind, (void)value;
    return fmiDiscard;
}

EXPORT Status FMI(GetBooleanStatus)(void *c, const fmi2StatusKind kind, int *value) {
    if (!c || kind != fmi2Terminated) return fmiDiscard;
    *value = 0;
    return fmiOK;
}

EXPORT Status FMI(GetStringStatus)(void *c, const fmi2StatusKind kind, Text *value) {
    (void)c, (void)kind, (void)value;
    return fmiDiscard;
}
