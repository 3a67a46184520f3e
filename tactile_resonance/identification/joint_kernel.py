# SPDX-License-Identifier: Apache-2.0
"""The joint estimator of one mode for point after point, compiled by numba.

The steps are those of `one_point`, `joint_fit`, `joint_noise`, `problem`, `solver` and `covariance`, written
out; complex numbers are pairs of arrays, so that loops over bins become vector instructions. A point
that needs more than undamped steps, flat and independent noise and one stable pole in the band is
left unmarked: the plain path takes it. Only `joint_compiled` imports this, and only where it is
asked for. All in one file, for numba's cache on disk watches no other than that of `fit_points`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Sums may be reordered, NaN and infinity keep their meaning.
_FAST = {"reassoc", "contract", "nsz", "arcp"}
compiled = njit(cache=True, fastmath=_FAST, error_model="numpy")

# Columns of `figures`.
COST, EXPECTED, CONDITION, NOISE_Y, NOISE_U, F0_HZ, DAMPING, POLE, RESIDUE = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    9,
)
POLE_COVARIANCE, COVARIANCE, FIGURES = 11, 15, 19
TINY = float(np.finfo(float).tiny)


@compiled
def _evaluate(basis_re, basis_im, coefficients, re, im):
    """Add ``sum_i coefficients[i] basis[i]`` to (K,) arrays."""
    for i in range(coefficients.size):
        c = coefficients[i]
        row_re, row_im = basis_re[i], basis_im[i]
        for k in range(re.size):
            re[k] += c * row_re[k]
            im[k] += c * row_im[k]


@compiled
def _dot(x, y):
    total = 0.0
    for k in range(x.size):
        total += x[k] * y[k]
    return total


@compiled
def _scaled(out, x, weight, factor):
    """``factor weight x``."""
    for k in range(x.size):
        out[k] = factor * weight[k] * x[k]


@compiled
def _difference(out, x, y, factor):
    """``factor (x - y)``."""
    for k in range(x.size):
        out[k] = factor * (x[k] - y[k])


@compiled
def _add(out, x):
    for k in range(x.size):
        out[k] += x[k]


@compiled
def _invert(re, im, last_re, last_im):
    """``1 / (x + last)`` in place."""
    for k in range(re.size):
        p, q = re[k] + last_re[k], im[k] + last_im[k]
        scale = 1 / (p * p + q * q)
        re[k], im[k] = p * scale, -q * scale


@compiled
def _multiply(re, im, by_re, by_im, factor):
    """``factor x by`` in place."""
    for k in range(re.size):
        p, q = factor * re[k], factor * im[k]
        re[k], im[k] = p * by_re[k] - q * by_im[k], p * by_im[k] + q * by_re[k]


@compiled
def _fill(jacobian, first, basis_re, basis_im, terms, w_re, w_im):
    """Rows ``weight basis[i]``, real parts before imaginary ones."""
    size = w_re.size
    for i in range(terms):
        re, im = jacobian[first + i, :size], jacobian[first + i, size:]
        b_re, b_im = basis_re[i], basis_im[i]
        for k in range(size):
            re[k] = b_re[k] * w_re[k] - b_im[k] * w_im[k]
            im[k] = b_re[k] * w_im[k] + b_im[k] * w_re[k]


@compiled
def _products(jacobian, error, places, normal, gradient):
    """Set ``J J^T`` (n, n) of rows that stand at `places`, add ``J error``."""
    normal[:] = 0.0
    for i in range(places.size):
        gradient[places[i]] += _dot(jacobian[i], error)
        for j in range(i + 1):
            total = _dot(jacobian[i], jacobian[j])
            normal[places[i], places[j]] = total
            normal[places[j], places[i]] = total


@compiled
def _linearise_group(
    group, places, sizes, theta, variances, data, work, jacobian, normal, gradient
):
    """Cost of a group at theta; see `OnePoint.linearise`."""
    a, b, _ = sizes
    size = data.shape[1]
    d_re, d_im, n_re, n_im, t_re, t_im = group
    y_re, y_im, u_re, u_im = data[0], data[1], data[2], data[3]
    a_re, a_im, b_re, b_im, c_re, c_im = work[0], work[1], work[2], work[3], work[4], work[5]
    e_re, e_im, g_re, g_im = work[6], work[7], work[8], work[9]
    work[:6] = 0.0
    _evaluate(d_re, d_im, theta[:a], a_re, a_im)
    _evaluate(n_re, n_im, theta[a : a + n_re.shape[0]], b_re, b_im)
    _evaluate(t_re, t_im, theta[a + b :], c_re, c_im)
    variance_y, variance_u = variances
    error = work[10:12].reshape(-1)[: 2 * size]
    cost = 0.0
    for k in range(size):
        p, q = a_re[k] + d_re[a, k], a_im[k] + d_im[a, k]
        scale = 1 / (p * p + q * q)
        i_re, i_im = p * scale, -q * scale
        gr = b_re[k] * i_re - b_im[k] * i_im
        gi = b_re[k] * i_im + b_im[k] * i_re
        m_re = gr * u_re[k] - gi * u_im[k] + c_re[k] * i_re - c_im[k] * i_im
        m_im = gr * u_im[k] + gi * u_re[k] + c_re[k] * i_im + c_im[k] * i_re
        weight = 1 / (variance_y + variance_u * (gr * gr + gi * gi))
        root = np.sqrt(weight)
        er, ei = (y_re[k] - m_re) * root, (y_im[k] - m_im) * root
        squared = er * er + ei * ei
        cost += squared
        error[k], error[size + k] = er, ei
        # derivative of the weight
        h = squared * weight * variance_u
        h_re = h * (gr * i_re + gi * i_im)
        h_im = h * (gr * i_im - gi * i_re)
        e_re[k], e_im[k] = h_re, h_im
        g_re[k], g_im[k] = h_re * gr - h_im * gi, h_re * gi + h_im * gr
        w_re, w_im = i_re * root, i_im * root
        a_re[k], a_im[k] = m_re * w_re - m_im * w_im, m_re * w_im + m_im * w_re
        b_re[k], b_im[k] = u_im[k] * w_im - u_re[k] * w_re, -u_re[k] * w_im - u_im[k] * w_re
        c_re[k], c_im[k] = -w_re, -w_im
    inputs = n_re.shape[0]
    _fill(jacobian, 0, d_re, d_im, a, a_re, a_im)
    _fill(jacobian, a, n_re, n_im, inputs, b_re, b_im)
    _fill(jacobian, a + inputs, t_re, t_im, t_re.shape[0], c_re, c_im)
    _products(jacobian, error, places, normal, gradient)
    if variance_u > 0:
        for i in range(a):
            for k in range(size):
                gradient[i] += g_re[k] * d_re[i, k] - g_im[k] * d_im[i, k]
        for i in range(inputs):
            for k in range(size):
                gradient[a + i] -= e_re[k] * n_re[i, k] - e_im[k] * n_im[i, k]
    return cost


@compiled
def _linearise_others(
    group, places, sizes, theta, variance, data, work, jacobian, normal, gradient
):
    """As `_linearise_group`, without input and with one variance: loops that become vectors."""
    a, b, _ = sizes
    size = data.shape[1]
    d_re, d_im, _, _, t_re, t_im = group
    a_re, a_im, c_re, c_im = work[0], work[1], work[2], work[3]
    work[:4] = 0.0
    root = 1 / np.sqrt(variance)
    error = work[10:12].reshape(-1)[: 2 * size]
    _evaluate(d_re, d_im, theta[:a], a_re, a_im)
    _evaluate(t_re, t_im, theta[a + b :], c_re, c_im)
    _invert(a_re, a_im, d_re[a], d_im[a])
    _multiply(c_re, c_im, a_re, a_im, 1.0)
    _difference(error[:size], data[0], c_re, root)
    _difference(error[size:], data[1], c_im, root)
    _multiply(c_re, c_im, a_re, a_im, root)
    _fill(jacobian, 0, d_re, d_im, a, c_re, c_im)
    for k in range(size):
        a_re[k] *= -root
        a_im[k] *= -root
    _fill(jacobian, a, t_re, t_im, t_re.shape[0], a_re, a_im)
    _products(jacobian, error, places, normal, gradient)
    return _dot(error, error)


@compiled
def _start_group(group, places, sizes, theta, first, data, work, jacobian, normal, gradient):
    """Normal equations of a Sanathanan-Koerner iteration; see `OnePoint.start`."""
    a, _, _ = sizes
    size = data.shape[1]
    d_re, d_im, n_re, n_im, t_re, t_im = group
    y_re, y_im, u_re, u_im = data[0], data[1], data[2], data[3]
    a_re, a_im, b_re, b_im, c_re, c_im = work[0], work[1], work[2], work[3], work[4], work[5]
    work[:6] = 0.0
    if not first:
        _evaluate(d_re, d_im, theta[:a], a_re, a_im)
    error = work[10:12].reshape(-1)[: 2 * size]
    weight, right = work[6], work[7]
    weight[:] = 1.0
    if not first:
        last_re, last_im = d_re[a], d_im[a]
        for k in range(size):
            p, q = a_re[k] + last_re[k], a_im[k] + last_im[k]
            weight[k] = 1 / np.sqrt(p * p + q * q)
    _scaled(a_re, y_re, weight, 1.0)
    _scaled(a_im, y_im, weight, 1.0)
    _scaled(b_re, u_re, weight, -1.0)
    _scaled(b_im, u_im, weight, -1.0)
    c_re[:] = 0.0
    c_im[:] = 0.0
    _difference(c_re, c_im, weight, 1.0)
    for half in range(2):
        # minus y times the fixed term of A
        _scaled(error[half * size : (half + 1) * size], a_re, d_im[a] if half else d_re[a], -1.0)
        _scaled(right, a_im, d_re[a] if half else d_im[a], -1.0 if half else 1.0)
        _add(error[half * size : (half + 1) * size], right)
    inputs = n_re.shape[0]
    _fill(jacobian, 0, d_re, d_im, a, a_re, a_im)
    _fill(jacobian, a, n_re, n_im, inputs, b_re, b_im)
    _fill(jacobian, a + inputs, t_re, t_im, t_re.shape[0], c_re, c_im)
    _products(jacobian, error, places, normal, gradient)


@compiled
def _factor(normal, scale, lower, trace):
    """Cholesky factor of the normal matrix with unit diagonal; whether there is one."""
    n = scale.size
    for i in range(n):
        if not normal[i, i] > 0:
            return False
        scale[i] = 1 / np.sqrt(normal[i, i])
    for i in range(n):
        for j in range(i + 1):
            total = normal[i, j] * scale[i] * scale[j] if i != j else 1.0 + trace
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    return True


@compiled
def _solve(lower, scale, right, step):
    """Solution of the normal equations by that factor, in `step`."""
    n = scale.size
    for i in range(n):
        total = right[i] * scale[i]
        for k in range(i):
            total -= lower[i, k] * step[k]
        step[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * step[k]
        step[i] = total / lower[i, i]
    for i in range(n):
        step[i] *= scale[i]


@compiled
def _spread_of_pieces(starts, counts, re, im):
    """``log mean - mean log`` of the powers of pieces."""
    pieces = starts.size
    total, logs = 0.0, 0.0
    for p in range(pieces):
        part = 0.0
        for k in range(starts[p], starts[p] + counts[p]):
            part += re[k] * re[k] + im[k] * im[k]
        total += part / counts[p]
        logs += np.log(part / counts[p])
    return np.log(total / pieces) - logs / pieces


@compiled
def fit_points(u, y, where, groups, places, sizes, pieces, bases, limits, out):
    """Fit of points.

    Parameters
    ----------
    u, y : (batch, K) complex
    where : two (K_g,) int arrays
        Of the bins between harmonics and of the excited ones.
    groups : two tuples of (terms, K_g) float
        Denominator, numerator, transient; real and imaginary parts.
    places : two int arrays
        Where the coefficients of a group stand among all.
    sizes : (a, b, iterations)
    pieces : two int arrays
        Starts and counts of the pieces of the noise.
    bases : two (m + 1, m) float
        Hessenberg matrices of denominator and numerator.
    limits : (11,) float
        See `CompiledJointPlan`.
    out : tuple of arrays
        ordinary (batch,) bool, theta (batch, n), covariance (batch, n, n), residual (batch, K_e)
        complex, figures (batch, FIGURES).
    """
    ordinary, theta, covariance, residual, figures = out
    n = theta.shape[1]
    data = (np.zeros((4, where[0].size)), np.zeros((4, where[1].size)))
    work = (np.empty((12, where[0].size)), np.empty((12, where[1].size)))
    jacobian = (np.empty((n, 2 * where[0].size)), np.empty((n, 2 * where[1].size)))
    input_o = np.empty((2, where[0].size))
    normal = np.empty((3, n, n))
    vectors = np.empty((4, n))
    lower = np.empty((n, n))
    for point in range(y.shape[0]):
        finite = True
        for group in range(2):
            for k in range(where[group].size):
                bin_ = where[group][k]
                value, source = y[point, bin_], u[point, bin_]
                data[group][0, k], data[group][1, k] = value.real, value.imag
                if group == 0:
                    input_o[0, k], input_o[1, k] = source.real, source.imag
                else:
                    data[1][2, k], data[1][3, k] = source.real, source.imag
                finite &= np.isfinite(value.real + value.imag + source.real + source.imag)
        if not finite:
            continue
        memory = (data, work, jacobian, normal, vectors, lower)
        variances = _rough(theta[point], groups, places, sizes, pieces, limits, input_o, memory)
        if not variances[0] > 0:
            continue
        costs = _minimise(theta[point], groups, places, sizes, limits, variances, memory)
        if not costs[0] >= 0:
            continue
        if not _level(
            theta[point], groups, sizes, limits, variances, costs, memory,
            covariance[point], residual[point], figures[point],
        ):  # fmt: skip
            continue
        ordinary[point] = _pole(theta[point], covariance[point], bases, limits, figures[point])


@compiled
def _step(memory, right):
    """Undamped step in vectors[2] from the sum of the normal matrices; whether there is one."""
    _, _, _, normal, vectors, lower = memory
    n = right.size
    for i in range(n):
        for j in range(n):
            normal[2, i, j] = normal[0, i, j] + normal[1, i, j]
    if not _factor(normal[2], vectors[3], lower, 1e-15):
        return False
    _solve(lower, vectors[3], right, vectors[2])
    return True


@compiled
def _linearise(theta, groups, places, sizes, variances, memory):
    """Costs of both groups; gradient in vectors[1], normals in normal[:2]."""
    data, work, jacobian, normal, vectors, _ = memory
    vectors[1] = 0.0
    others = _linearise_others(
        groups[0], places[0], sizes, theta, variances[0], data[0], work[0], jacobian[0],
        normal[0], vectors[1],
    )  # fmt: skip
    excited = _linearise_group(
        groups[1], places[1], sizes, theta, variances, data[1], work[1], jacobian[1],
        normal[1], vectors[1],
    )  # fmt: skip
    return others, excited


@compiled
def _rough(theta, groups, places, sizes, pieces, limits, input_o, memory):
    """Start values in theta; variances of a bin of Y and U, 0 where not flat and independent."""
    data, work, jacobian, normal, vectors, _ = memory
    nothing = (0.0, 0.0)
    for iteration in range(sizes[2]):
        vectors[1] = 0.0
        for g in range(2):
            _start_group(
                groups[g], places[g], sizes, theta, iteration == 0, data[g], work[g], jacobian[g],
                normal[g], vectors[1],
            )  # fmt: skip
        if not _step(memory, vectors[1]):
            return nothing
        theta[:] = vectors[2]
    _linearise(theta, groups, places, sizes, (1.0, 0.0), memory)
    if not _step(memory, vectors[1]):
        return nothing
    a, b, _ = sizes
    theta -= vectors[2]
    # what the transient leaves of Y between harmonics
    y = data[0]
    d_re, d_im, _, _, t_re, t_im = groups[0]
    a_re, a_im, c_re, c_im = work[0][0], work[0][1], work[0][2], work[0][3]
    work[0][:4] = 0.0
    _evaluate(d_re, d_im, theta[:a], a_re, a_im)
    _evaluate(t_re, t_im, theta[a + b :], c_re, c_im)
    size = y.shape[1]
    _invert(a_re, a_im, d_re[a], d_im[a])
    _multiply(c_re, c_im, a_re, a_im, 1.0)
    _difference(c_re, y[0], c_re, 1.0)
    _difference(c_im, y[1], c_im, 1.0)
    u_re, u_im = input_o[0], input_o[1]
    power_y = _dot(c_re, c_re) + _dot(c_im, c_im)
    power_u = _dot(u_re, u_re) + _dot(u_im, u_im)
    cross_re = _dot(c_re, u_re) + _dot(c_im, u_im)
    cross_im = _dot(c_im, u_re) - _dot(c_re, u_im)
    squared = (cross_re * cross_re + cross_im * cross_im) / max(power_y * power_u, TINY)
    if not squared <= limits[0]:
        return nothing
    if limits[1] > 0 and not (
        _spread_of_pieces(pieces[0], pieces[1], c_re, c_im) <= limits[1]
        and _spread_of_pieces(pieces[0], pieces[1], input_o[0], input_o[1]) <= limits[1]
    ):
        return nothing
    variance_y = power_y / size * limits[2]
    return (variance_y, power_u / size) if variance_y > TINY else nothing


@compiled
def _minimise(theta, groups, places, sizes, limits, variances, memory):
    """Costs of both groups at the last but one theta; negative where steps need damping."""
    data, _, _, _, vectors, _ = memory
    power = 0.0
    for g in range(2):
        for k in range(data[g].shape[1]):
            power += data[g][0, k] ** 2 + data[g][1, k] ** 2
    floor = limits[3] * power / variances[0]
    others, excited = _linearise(theta, groups, places, sizes, variances, memory)
    for _ in range(int(limits[5])):
        cost = others + excited
        if not _step(memory, vectors[1]):
            break
        decrement = 0.0
        for i in range(theta.size):
            decrement += vectors[1, i] * vectors[2, i]
        theta -= vectors[2]
        if decrement <= max(limits[4] * cost, floor):
            return others, excited
        others, excited = _linearise(theta, groups, places, sizes, variances, memory)
        if not others + excited <= cost * (1 + 1e-12) + floor:
            break
    return -1.0, -1.0


@compiled
def _level(
    theta, groups, sizes, limits, variances, costs, memory, covariance, residual, figures
):  # fmt: skip
    """Covariance, residual, cost and its expectation; whether they are those of noise."""
    data, work, _, normal, vectors, lower = memory
    n = theta.size
    # the factor is that of the step just taken
    scale = vectors[3]
    before = 0.0
    for i in range(n):
        for j in range(n):
            before += (normal[2, i, j] * scale[i] * scale[j]) ** 2
    after = 0.0
    unit = vectors[0]
    for j in range(n):
        unit[:] = 0.0
        unit[j] = 1.0
        _solve(lower, scale, unit, vectors[2])
        for i in range(n):
            covariance[i, j] = vectors[2, i]
            after += (vectors[2, i] / (scale[i] * scale[j])) ** 2
    condition = (before * after) ** 0.25
    used = 0.0
    for i in range(n):
        for j in range(n):
            used += covariance[i, j] * normal[0, j, i]
    bins_o, bins_e = data[0].shape[1], data[1].shape[1]
    dof_o, dof_e = bins_o - used / 2, bins_e - (n - used) / 2
    dof = dof_o + dof_e
    level = costs[0] / dof_o
    cost = costs[1] / level
    if not (cost <= dof_e * _f_quantile(limits[6], 2 * dof_e, 2 * dof_o) and dof > 1):
        return False
    pooled = (costs[0] + costs[1]) / dof
    ratio = 0.5 * pooled * dof / (dof - 1)
    for i in range(n):
        for j in range(n):
            covariance[i, j] *= ratio
    figures[COST], figures[EXPECTED] = cost, dof_e * dof_o / (dof_o - 1)
    figures[CONDITION] = condition
    figures[NOISE_Y], figures[NOISE_U] = variances[0] * level, variances[1] * level
    a, b, _ = sizes
    d_re, d_im, n_re, n_im, t_re, t_im = groups[1]
    rows = work[1]
    rows[:6] = 0.0
    a_re, a_im, b_re, b_im, c_re, c_im = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    _evaluate(d_re, d_im, theta[:a], a_re, a_im)
    _evaluate(n_re, n_im, theta[a : a + b], b_re, b_im)
    _evaluate(t_re, t_im, theta[a + b :], c_re, c_im)
    for k in range(bins_e):
        inverse = 1 / complex(a_re[k] + d_re[a, k], a_im[k] + d_im[a, k])
        g = complex(b_re[k], b_im[k]) * inverse
        u = complex(data[1][2, k], data[1][3, k])
        error = complex(data[1][0, k], data[1][1, k]) - g * u
        error -= complex(c_re[k], c_im[k]) * inverse
        size = abs(u)
        if size > 0:
            error *= u.conjugate() / size
        variance = variances[0] + variances[1] * (g.real**2 + g.imag**2)
        error /= np.sqrt(variance * pooled)
        residual[k] = error
    return condition < limits[7]


@compiled
def _f_quantile(normal, dof_1, dof_2):
    """As `noise_level.f_quantile`, from the normal quantile."""
    a, b = 2 / (9 * dof_1), 2 / (9 * dof_2)
    bottom = (1 - b) ** 2 - normal**2 * b
    if not bottom > 0:
        return np.inf
    under = (1 - a) ** 2 * b + (1 - b) ** 2 * a - normal**2 * a * b
    return (((1 - a) * (1 - b) + normal * np.sqrt(max(under, 0.0))) / bottom) ** 3


@compiled
def _pole(theta, covariance, bases, limits, figures):
    """The pole, its residue and covariances; whether it is one stable pair near the band."""
    h, h_b = bases
    scale = limits[8]
    last_0, last_1 = h[2, 1] * theta[0], h[2, 1] * theta[1]
    first, second = h[0, 0], h[1, 1] - last_1
    under = ((first - second) / 2) ** 2 + (h[0, 1] - last_0) * h[1, 0]
    if not under < 0:
        return False
    x = complex((first + second) / 2, np.sqrt(-under))
    pole = x * scale
    size = abs(pole)
    f0_hz = size / (2 * np.pi)
    if not (pole.real < 0 and limits[9] <= f0_hz <= limits[10]):
        return False
    # A and its slope
    p_1 = (x - h[0, 0]) / h[1, 0]
    slope_1 = 1 / h[1, 0]
    slope_2 = (p_1 + (x - h[1, 1]) * slope_1) / h[2, 1]
    ratio = scale / (theta[1] * slope_1 + slope_2)
    terms = h_b.shape[0]
    values = np.empty(terms, np.complex128)
    values[0] = 1.0
    b = complex(theta[2], 0.0)
    for k in range(terms - 1):
        total = x * values[k]
        for j in range(k + 1):
            total -= h_b[j, k] * values[j]
        values[k + 1] = total / h_b[k + 1, k]
        b += theta[3 + k] * values[k + 1]
    residue = b * ratio
    s_0, s_1 = -ratio, -p_1 * ratio
    c_00, c_01, c_11 = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    # (Re, Im) of the pole
    rr = s_0.real**2 * c_00 + 2 * s_0.real * s_1.real * c_01 + s_1.real**2 * c_11
    ii = s_0.imag**2 * c_00 + 2 * s_0.imag * s_1.imag * c_01 + s_1.imag**2 * c_11
    ri = s_0.real * s_0.imag * c_00 + s_1.real * s_1.imag * c_11
    ri += (s_0.real * s_1.imag + s_0.imag * s_1.real) * c_01
    re, im = pole.real, pole.imag
    f_r, f_i = re / (2 * np.pi * size), im / (2 * np.pi * size)
    d_r, d_i = -(im**2) / size**3, re * im / size**3
    cross = f_r * d_r * rr + (f_r * d_i + f_i * d_r) * ri + f_i * d_i * ii
    figures[F0_HZ], figures[DAMPING] = f0_hz, -re / size
    figures[POLE], figures[POLE + 1] = re, im
    figures[RESIDUE], figures[RESIDUE + 1] = residue.real, residue.imag
    figures[POLE_COVARIANCE], figures[POLE_COVARIANCE + 3] = rr, ii
    figures[POLE_COVARIANCE + 1] = figures[POLE_COVARIANCE + 2] = ri
    figures[COVARIANCE] = f_r**2 * rr + 2 * f_r * f_i * ri + f_i**2 * ii
    figures[COVARIANCE + 1] = figures[COVARIANCE + 2] = cross
    figures[COVARIANCE + 3] = d_r**2 * rr + 2 * d_r * d_i * ri + d_i**2 * ii
    return True
