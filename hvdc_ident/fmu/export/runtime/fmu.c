/* The whole FMU in one unit, this file being the one to compile: the model, the core that integrates it, the functions of FMI. */
#define INTERFACE static
#include "internal.h"

#include "core.c"
#include "model.c"

#include "instance.c"
#include "start.c"
#include "progress.c"
#include "values.c"
#include "snapshot.c"

#include "fmi.c"
#if FMI_VERSION == 2
#include "fmi2.c"
#else
#include "fmi3.c"
#endif
