"""Small dense linear algebra for compiled kernels: LU with partial pivoting, and solves over rows of right-hand sides."""

from __future__ import annotations

from hvdc_ident.simulate.kernel import kernel


@kernel(fastmath={"contract"})
def lu(a, pivots):  # type: ignore[no-untyped-def]
    """Factors a (n, n) in place; pivots (n,) are the row exchanges. Returns whether it is regular."""
    n = a.shape[0]
    for k in range(n):
        best, row = abs(a[k, k]), k
        for i in range(k + 1, n):
            if abs(a[i, k]) > best:
                best, row = abs(a[i, k]), i
        pivots[k] = row
        if not best > 0.0:
            return False
        if row != k:
            for j in range(n):
                a[k, j], a[row, j] = a[row, j], a[k, j]
        inverse = 1.0 / a[k, k]
        a[k, k] = inverse
        for i in range(k + 1, n):
            if a[i, k] != 0.0:
                factor = a[i, k] * inverse
                a[i, k] = factor
                for j in range(k + 1, n):
                    a[i, j] -= factor * a[k, j]
    return True


@kernel()
def orientation(a, pivots):  # type: ignore[no-untyped-def]
    """The sign of the determinant, from the factors of `lu`."""
    sign = 1.0
    for k in range(a.shape[0]):
        if (a[k, k] < 0.0) != (pivots[k] != k):
            sign = -sign
    return sign


@kernel(fastmath={"contract"})
def solve(a, pivots, b):  # type: ignore[no-untyped-def]
    """Solves in place for b (n,) with the factors of `lu`, which store the diagonal's inverse."""
    n = a.shape[0]
    for k in range(n):
        row = pivots[k]
        if row != k:
            b[k], b[row] = b[row], b[k]
    for i in range(1, n):
        total = b[i]
        for j in range(i):
            total -= a[i, j] * b[j]
        b[i] = total
    for i in range(n - 1, -1, -1):
        total = b[i]
        for j in range(i + 1, n):
            total -= a[i, j] * b[j]
        b[i] = total * a[i, i]


@kernel(fastmath={"contract"})
def solve_rows(a, pivots, b):  # type: ignore[no-untyped-def]
    """Solves in place for b (n, k): k right-hand sides side by side, so that the inner loop runs along memory."""
    n, width = b.shape
    for k in range(n):
        row = pivots[k]
        if row != k:
            for c in range(width):
                b[k, c], b[row, c] = b[row, c], b[k, c]
    for i in range(1, n):
        for j in range(i):
            factor = a[i, j]
            if factor != 0.0:
                for c in range(width):
                    b[i, c] -= factor * b[j, c]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = a[i, j]
            if factor != 0.0:
                for c in range(width):
                    b[i, c] -= factor * b[j, c]
        inverse = a[i, i]
        for c in range(width):
            b[i, c] *= inverse
