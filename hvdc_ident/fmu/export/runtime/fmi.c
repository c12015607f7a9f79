/* The functions that FMI 2.0 and 3.0 have alike. Names after the standards' text; FMI(f) is fmi2f or fmi3f. */
#include "fmi.h"

#if FMI_VERSION == 2
#define STATE(before, after) FMI(before##FMUstate##after)
#define DESERIALIZE FMI(DeSerializeFMUstate)
#define GET_DERIVATIVES FMI(GetDerivatives)
#define GET_DERIVATIVES_TEXT "GetDerivatives"
#else
#define STATE(before, after) FMI(before##FMUState##after)
#define DESERIALIZE FMI(DeserializeFMUState)
#define GET_DERIVATIVES FMI(GetContinuousStateDerivatives)
#define GET_DERIVATIVES_TEXT "GetContinuousStateDerivatives"
#endif

static void log_error(Instance *i); /* as the version of the standard says */

static Status report(Instance *i, int good) {
    if (good) return fmiOK;
    if (i->logger) log_error(i);
    return fmiError;
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

static Status no_variables(Instance *i, size_t n) {
    if (!i) return fmiError;
    if (n == 0) return fmiOK;
    say(i, "all variables of this FMU are of type " REAL_TYPE);
    return report(i, 0);
}

/* --- instances --- */

EXPORT Status FMI(SetDebugLogging)(void *c, Flag on, size_t n, const Text categories[]) {
    (void)n, (void)categories;
    if (!c) return fmiError;
    ((Instance *)c)->logging = on;
    return fmiOK;
}

EXPORT void FMI(FreeInstance)(void *c) { discard(c); }

EXPORT Status FMI(ExitInitializationMode)(void *c) {
    CHECK(IN(INITIALIZATION), "ExitInitializationMode");
    return report(i, finish_start(i));
}

EXPORT Status FMI(Terminate)(void *c) {
    CHECK(RUNNING, "Terminate");
    i->s.phase = TERMINATED;
    return fmiOK;
}

EXPORT Status FMI(Reset)(void *c) {
    if (!c) return fmiError;
    reset(c);
    return fmiOK;
}

/* --- copies of the state --- */

EXPORT Status STATE(Get, )(void *c, void **state) {
    Instance *i = c;
    if (!i || !state) return fmiError;
    void *copy = snapshot(i);
    if (!copy) {
        say(i, "not enough memory for a copy of the state");
    } else {
        free(*state);
        *state = copy;
    }
    return report(i, copy != NULL);
}

EXPORT Status STATE(Set, )(void *c, void *state) {
    Instance *i = c;
    if (!i || !state) return fmiError;
    int good = restore(i, state);
    if (!good) say(i, "not enough memory to take a state back");
    return report(i, good);
}

EXPORT Status STATE(Free, )(void *c, void **state) {
    (void)c;
    if (state) {
        free(*state);
        *state = NULL;
    }
    return fmiOK;
}

EXPORT Status STATE(Serialized, Size)(void *c, void *state, size_t *size) {
    if (!c || !state || !size) return fmiError;
    *size = snapshot_size(state);
    return fmiOK;
}

EXPORT Status STATE(Serialize, )(void *c, void *state, Byte bytes[], size_t size) {
    Instance *i = c;
    if (!i || !state) return fmiError;
    int good = snapshot_write(state, (char *)bytes, size) > 0;
    if (!good) say(i, "the room for the serialised state is too small");
    return report(i, good);
}

EXPORT Status DESERIALIZE(void *c, const Byte bytes[], size_t size, void **state) {
    Instance *i = c;
    if (!i || !state) return fmiError;
    void *copy = snapshot_read(c, (const char *)bytes, size);
    if (!copy) {
        say(i, "the bytes are no state of this FMU");
    } else {
        free(*state);
        *state = copy;
    }
    return report(i, copy != NULL);
}

/* --- model exchange --- */

EXPORT Status FMI(EnterEventMode)(void *c) {
    CHECK(IN(CONTINUOUS) | IN(EVENT), "EnterEventMode");
    return report(i, enter_event_mode(i));
}

EXPORT Status FMI(EnterContinuousTimeMode)(void *c) {
    CHECK(IN(EVENT), "EnterContinuousTimeMode");
    return report(i, leave_event_mode(i));
}

EXPORT Status FMI(CompletedIntegratorStep)(void *c, Flag no_return, Flag *enter_event, Flag *terminate) {
    CHECK(IN(CONTINUOUS), "CompletedIntegratorStep");
    (void)no_return;
    *enter_event = *terminate = 0;
    return report(i, complete_step(i));
}

EXPORT Status FMI(SetTime)(void *c, double t) {
    CHECK(IN(EVENT) | IN(CONTINUOUS), "SetTime");
    return report(i, set_time(i, t));
}

EXPORT Status FMI(SetContinuousStates)(void *c, const double x[], size_t n) {
    CHECK(IN(EVENT) | IN(CONTINUOUS), "SetContinuousStates");
    return report(i, as_many(i, n, NX) && set_states(i, x));
}

EXPORT Status FMI(GetContinuousStates)(void *c, double x[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "GetContinuousStates");
    Ref refs[SOME(NX)];
    for (int k = 0; k < NX; k++) refs[k] = REF_STATE + (Ref)k;
    return report(i, as_many(i, n, NX) && get_by_reference(i, refs, NX, x));
}

EXPORT Status GET_DERIVATIVES(void *c, double values[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, GET_DERIVATIVES_TEXT);
    return report(i, as_many(i, n, NX) && get_rates(i, values));
}

EXPORT Status FMI(GetEventIndicators)(void *c, double values[], size_t n) {
    CHECK(IN(INITIALIZATION) | RUNNING, "GetEventIndicators");
    return report(i, as_many(i, n, NS) && get_indicators(i, values));
}

EXPORT Status FMI(GetNominalsOfContinuousStates)(void *c, double values[], size_t n) {
    CHECK(~0, "GetNominalsOfContinuousStates");
    if (n == NX) memcpy(values, model_nominals, NX * sizeof(double));
    return report(i, as_many(i, n, NX));
}
