/* Types, names and checks that the functions of FMI 2.0 and 3.0 share. FMI_VERSION is defined in model.h. */
#ifndef HVDC_FMI_H
#define HVDC_FMI_H

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

/* Where sources are linked statically, the builder defines FMI2_FUNCTION_PREFIX or FMI3_FUNCTION_PREFIX as the model
   identifier and _. Flag and Byte are the types of truth values and of serialised bytes. */
#if FMI_VERSION == 2
#ifdef FMI2_FUNCTION_PREFIX
#define FUNCTION_PREFIX FMI2_FUNCTION_PREFIX
#endif
#define VERSIONED(f) fmi2##f
#define VERSION_TEXT "fmi2"
#define REAL_TYPE "Real"
typedef int Flag;
typedef char Byte;
#else
#ifdef FMI3_FUNCTION_PREFIX
#define FUNCTION_PREFIX FMI3_FUNCTION_PREFIX
#endif
#define VERSIONED(f) fmi3##f
#define VERSION_TEXT "fmi3"
#define REAL_TYPE "Float64"
typedef bool Flag;
typedef uint8_t Byte;
#endif

#define PASTE2(a, b) a##b
#define PASTE(a, b) PASTE2(a, b)
#ifdef FUNCTION_PREFIX
#define FMI(f) PASTE(FUNCTION_PREFIX, VERSIONED(f))
#else
#define FMI(f) VERSIONED(f)
#endif

typedef enum { fmiOK, fmiWarning, fmiDiscard, fmiError, fmiFatal, fmiPending } Status;
typedef unsigned int Ref;
typedef const char *Text;

#define IN(phase) (1 << (phase))
#define RUNNING (IN(EVENT) | IN(CONTINUOUS) | IN(STEP) | IN(TERMINATED))
#define SETTABLE (IN(INSTANTIATED) | IN(INITIALIZATION) | IN(EVENT) | IN(CONTINUOUS) | IN(STEP))

#define CHECK(phases, function) \
    Instance *i = c;            \
    if (!i) return fmiError;    \
    if (!allowed(i, phases, VERSION_TEXT function)) return report(i, 0)

#endif
