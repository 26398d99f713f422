"""Eigenvalues and powers of many symmetric 3 x 3 tensors at once.

LAPACK takes a microsecond a matrix. Here a tensor is six arrays (xx, yy, zz, xy, xz, yz), and each line is
arithmetic on whole arrays (a sixth of the time). Powers need no eigenvectors: Newton's interpolation through the
eigenvalues a, b, c,

    f(C) = f(a) I + f[a, b] (C - a I) + f[a, b, c] (C - a I)(C - b I),

is the function itself. Close eigenvalues do no harm: an error of a divided difference is multiplied by a factor as
small as the differences that it was divided by.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]

EPS = float(np.finfo(float).eps)


def eigenvalues(C: Values) -> Values:
    """(3, n) eigenvalues of positive (6, n) tensors in descending order, by the cosine formula on the deviator.

    None is below round-off of the greatest, which hides the small ones of a nearly flat cell.
    """
    mean = (C[0] + C[1] + C[2]) / 3
    x, y, z = C[0] - mean, C[1] - mean, C[2] - mean
    xy, xz, yz = C[3], C[4], C[5]
    J2 = (x * x + y * y + z * z) / 2 + xy * xy + xz * xz + yz * yz
    J3 = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
    radius = np.sqrt(J2 / 3)
    cosine = np.divide(J3, 2 * radius * radius * radius, out=np.zeros_like(J3), where=radius > 0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) / 3
    first, last = 2 * np.cos(angle), 2 * np.cos(angle + 2 * np.pi / 3)
    values = mean + radius * np.stack([first, -first - last, last])
    return np.maximum(values, EPS * values[0])


def deviatoric_power(C: Values, values: Values, logs: Values, exponent: Values) -> Values:
    """(6, n) tensors (C / det(C)^(1/3))^exponent.

    Args:
        C: (6, n) positive tensors.
        values: (3, n) their eigenvalues.
        logs: (3, n) logarithms of the eigenvalues minus their mean.
        exponent: (n,).
    """
    (a, b, c), (log_a, log_b, log_c) = values, logs
    f_a, f_b, f_c = np.exp(exponent * logs)
    ab = _divided_difference(a - b, exponent * (log_a - log_b), f_b, exponent / b)
    bc = _divided_difference(b - c, exponent * (log_b - log_c), f_c, exponent / c)
    abc = np.divide(ab - bc, a - c, out=np.zeros_like(a), where=a > c)
    x, y, z, xy, xz, yz = C
    square = [  # (C - a I)(C - b I)
        (x - a) * (x - b) + xy * xy + xz * xz,
        (y - a) * (y - b) + xy * xy + yz * yz,
        (z - a) * (z - b) + xz * xz + yz * yz,
        xy * ((x - a) + (y - b)) + xz * yz,
        xz * ((x - a) + (z - b)) + xy * yz,
        yz * ((y - a) + (z - b)) + xy * xz,
    ]
    result = np.empty_like(C)
    for k in range(6):
        result[k] = ab * (C[k] - a) + f_a if k < 3 else ab * C[k]
        result[k] += abc * square[k]
    return result


def _divided_difference(gap: Values, log_ratio: Values, f_b: Values, derivative: Values) -> Values:
    """f[a, b] of a power, f(b) expm1(log f(a)/f(b)) / (a - b), or its limit where a = b."""
    return np.divide(f_b * np.expm1(log_ratio), gap, out=f_b * derivative, where=gap > 0)


def multiply_unimodular(A: Values, S: Values) -> Values:
    """(9, n) products A S of row-wise (9, n) and symmetric (6, n) tensors, scaled to a determinant of 1.

    Products whose determinant is round-off are not scaled.
    """
    x, y, z, xy, xz, yz = S
    columns = ((x, xy, xz), (xy, y, yz), (xz, yz, z))
    P = np.stack([A[3 * i] * u + A[3 * i + 1] * v + A[3 * i + 2] * w for i in range(3) for u, v, w in columns])
    det = P[0] * (P[4] * P[8] - P[5] * P[7]) - P[1] * (P[3] * P[8] - P[5] * P[6]) + P[2] * (P[3] * P[7] - P[4] * P[6])
    lengths = np.sqrt(np.prod((P * P).reshape(3, 3, -1).sum(axis=1), axis=0))
    # A determinant below 100 EPS times the product of the rows' lengths is round-off.
    P /= np.cbrt(np.where(det > 100 * EPS * lengths, det, 1.0))
    return P
