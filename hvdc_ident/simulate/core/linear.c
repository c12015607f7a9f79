/* Dense linear algebra of small systems, in place. Matrices are stored by rows. */

#include "core.h"

static void exchange(double *a, double *b)
{
    double kept = *a;
    *a = *b;
    *b = kept;
}

/* Factor a (n, n) with row exchanges (n,); the diagonal holds the pivots' inverses. False where it is singular. */
static bool lu(double *a, integer *pivots, integer n)
{
    for (integer k = 0; k < n; k++) {
        integer row = k;
        double best = fabs(a[k * n + k]);
        for (integer i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > best) {
                best = fabs(a[i * n + k]);
                row = i;
            }
        pivots[k] = row;
        if (!(best > 0.0))
            return false;
        if (row != k)
            for (integer j = 0; j < n; j++)
                exchange(&a[k * n + j], &a[row * n + j]);
        double inverse = 1.0 / a[k * n + k];
        const double *restrict pivot_row = a + k * n;
        a[k * n + k] = inverse;
        for (integer i = k + 1; i < n; i++) {
            double *restrict own = a + i * n;
            if (own[k] == 0.0)
                continue;
            double share = own[k] * inverse;
            own[k] = share;
            INDEPENDENT for (integer j = k + 1; j < n; j++)
                own[j] -= share * pivot_row[j];
        }
    }
    return true;
}

/* Sign of the determinant, from the factors of `lu`. */
static double orientation(const double *a, const integer *pivots, integer n)
{
    double sign = 1.0;
    for (integer k = 0; k < n; k++)
        if ((a[k * n + k] < 0.0) != (pivots[k] != k))
            sign = -sign;
    return sign;
}

/* Solve for b (n,) with the factors of `lu`. */
static void solve(const double *a, const integer *pivots, double *b, integer n)
{
    for (integer k = 0; k < n; k++)
        if (pivots[k] != k)
            exchange(&b[k], &b[pivots[k]]);
    for (integer i = 1; i < n; i++) {
        double total = b[i];
        for (integer j = 0; j < i; j++)
            total -= a[i * n + j] * b[j];
        b[i] = total;
    }
    for (integer i = n - 1; i >= 0; i--) {
        double total = b[i];
        for (integer j = i + 1; j < n; j++)
            total -= a[i * n + j] * b[j];
        b[i] = total * a[i * n + i];
    }
}

static void subtract(double *restrict from, const double *restrict row, double share, integer width)
{
    if (share != 0.0)
        EACH(c, width)
            from[c] -= share * row[c];
}

/* Solve for b (n, width): right-hand sides side by side, so that the inner loop runs along memory. */
static void solve_rows(const double *a, const integer *pivots, double *b, integer n, integer width)
{
    for (integer k = 0; k < n; k++)
        if (pivots[k] != k)
            for (integer c = 0; c < width; c++)
                exchange(&b[k * width + c], &b[pivots[k] * width + c]);
    for (integer i = 1; i < n; i++)
        for (integer j = 0; j < i; j++)
            subtract(b + i * width, b + j * width, a[i * n + j], width);
    for (integer i = n - 1; i >= 0; i--) {
        for (integer j = i + 1; j < n; j++)
            subtract(b + i * width, b + j * width, a[i * n + j], width);
        for (integer c = 0; c < width; c++)
            b[i * width + c] *= a[i * n + i];
    }
}
