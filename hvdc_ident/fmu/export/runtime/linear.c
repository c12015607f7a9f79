/* Dense linear systems: elimination with partial pivoting. */
#include "internal.h"

/* Factors a (n, n) in place; 0 where it is singular or not finite. */
int factorise(double *a, int *pivots, int n) {
    for (int k = 0; k < n; k++) {
        int best = k;
        double largest = fabs(a[k * n + k]);
        for (int r = k + 1; r < n; r++)
            if (fabs(a[r * n + k]) > largest) {
                largest = fabs(a[r * n + k]);
                best = r;
            }
        pivots[k] = best;
        if (!(largest > 0.0) || !(largest < INFINITY)) return 0;
        if (best != k)
            for (int c = 0; c < n; c++) {
                double kept = a[k * n + c];
                a[k * n + c] = a[best * n + c];
                a[best * n + c] = kept;
            }
        double inverse = 1.0 / a[k * n + k];
        for (int r = k + 1; r < n; r++) {
            double factor = a[r * n + k] * inverse;
            a[r * n + k] = factor;
            if (factor != 0.0)
                for (int c = k + 1; c < n; c++) a[r * n + c] -= factor * a[k * n + c];
        }
    }
    return 1;
}

/* Solves in place for b (n,). */
void back_substitute(const double *a, const int *pivots, double *b, int n) {
    for (int k = 0; k < n; k++) {
        double kept = b[k];
        b[k] = b[pivots[k]];
        b[pivots[k]] = kept;
    }
    for (int r = 1; r < n; r++)
        for (int c = 0; c < r; c++) b[r] -= a[r * n + c] * b[c];
    for (int r = n - 1; r >= 0; r--) {
        for (int c = r + 1; c < n; c++) b[r] -= a[r * n + c] * b[c];
        b[r] /= a[r * n + r];
    }
}
