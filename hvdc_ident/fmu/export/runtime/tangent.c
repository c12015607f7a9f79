/* Directional derivatives: exact, through the algebraic unknowns and, during initialisation, through the steady start. */
#include "internal.h"

/* Derivatives along (dy: states, du: inputs, dp: parameters) of rates, outputs, switches and, at the start, of the states.
   During initialisation dy is not read: the states follow from inputs and parameters. 0 where a matrix is singular. */
int directional(Instance *i, const double *dy, const double *du, const double *dp, double *rates_out, double *outputs,
                double *indicators, double *states) {
    State *s = &i->s;
    Args a;
    double y[SOME(NY)], w[NW], out[SOME(NY + NO + NS)];
    arguments(i, &a);
    memset(y, 0, sizeof y);
    memset(w, 0, sizeof w);
    for (int k = 0; k < NU; k++) w[1 + k] = du[k];
    a.yd = y;
    a.wd = w;
    a.dp = dp;
    if (s->phase == INITIALIZATION && NV) {
        double *matrix = calloc(SOME(NV * NV), sizeof(double)), r[SOME(NV)];
        int pivots[SOME(NV)];
        if (!matrix) return 0;
        model_rest_jac(&a, matrix);
        model_rest_tangent(&a, r);
        int regular = factorise(matrix, pivots, NV);
        if (regular) back_substitute(matrix, pivots, r, NV);
        free(matrix);
        if (!regular) return 0;
        for (int k = 0; k < NY; k++) y[k] = -r[k];
        for (int k = 0; k < ND + NQ; k++) w[FIRST_DELAY + k] = -r[NY + k];
    } else {
        for (int k = 0; k < NX; k++) y[k] = dy[k];
#if NZ
        double jac[NY * NY], small[NZ * NZ];
        int pivots[NZ];
        memset(jac, 0, sizeof jac);
        model_jac(&a, jac);
        model_tangent(&a, out);
        for (int k = 0; k < NZ; k++)
            for (int j = 0; j < NZ; j++) small[k * NZ + j] = jac[(NX + k) * NY + NX + j];
        if (!factorise(small, pivots, NZ)) return 0;
        back_substitute(small, pivots, out + NX, NZ);
        for (int k = 0; k < NZ; k++) y[NX + k] = -out[NX + k];
#endif
    }
    model_tangent(&a, out);
    memcpy(rates_out, out, NX * sizeof(double));
    memcpy(outputs, out + NY, NO * sizeof(double));
    memcpy(indicators, out + NY + NO, NS * sizeof(double));
    memcpy(states, y, NX * sizeof(double));
    return 1;
}
