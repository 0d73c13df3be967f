"""Fit of one frame in numpy: model, covariance, prior and Levenberg-Marquardt; numba compiles it.

With K combinations, k touches, n = 1 + 3 k unknowns and a response network of h hidden units.
`implementation` gives the compiled copy where numba is wanted.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from eitskin.compiled import either
from eitskin.training.joint.mirrored_frames import SCALE

Array = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Sensor: TypeAlias = tuple[Array, Array, Array, Array, Array, Array, Array]
Frame: TypeAlias = tuple[Array, Array, Array]
Point: TypeAlias = tuple[Array, float, Array, Array, Array]
Spread: TypeAlias = tuple[Array, Array, Array, Array, Array, Array, float]

KERNELS = "eitskin.training.joint.fit_kernels"  # as `implementation` takes it
ANGLE_PRIOR_STD_DEG = 15.0  # standard deviation of the motion since the reference was taken
ANGLE_UNIT = 5.0  # deg, the unit step of the angle
TOUCH_UNITS = np.array([0.010, 0.010, 2.0])  # m, m, N, the unit steps of x, y and force
STILL_DEG = 0.01  # motion below which the uncertainty of the bend curve is negligible
OPTIMISM = 10.0
"""Most that is hoped for, in decreases of the misfit that its quadratic model promises."""
RADIUS = 1.0  # of the trust region at first: unit steps of each unknown
POOR, GOOD = 0.25, 0.75  # share of its promise below and above which a step changes the radius
SHRINKING, GROWTH = 0.5, 2.0  # the new radius, in lengths of that step
DAMPINGS = np.append(1e-6, 1e-3 * 4.0 ** np.arange(10))
"""Damping of a step: where none is needed, and those that are tried."""
BOUND_STIFFNESS = 1e9  # addition to the Hessian that holds an unknown at its bound
SCORING_STEPS, SCORING_DEG = 6, 3e-3  # of Fisher scoring, and the step [deg] at which it ends

# First layer of the response network (3, h), the others (layers - 1, h, h), biases (layers, h), the
# first layer's by the angle (h,); last layer (h, K) and its constant (K,); bend curve (powers, K).
SENSOR = "Tuple((f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[:,::1]))"
# Change plus the bend at the reference (K,); numbers: strength of a touch by its force [1/N], angle
# of the reference, least and largest angle [deg], separation of touches [m]; of x, y [m] and force
# [N] the mean, the stiffness, and the bounds (4, 3).
FRAME = "Tuple((f8[::1], f8[::1], f8[:,::1]))"
# Touches (k, 3), angle [deg], rows (1 + n, K): the residual, then the derivative of the model by a
# unit step of each unknown; changes by each touch (k, K), output of the response network (k, h).
POINT = "Tuple((f8[:,::1], f8, f8[:,::1], f8[:,::1], f8[:,::1]))"
# Covariances of noise (K, K) and of the bend curve's random effects (pairs, K^2), weights of the
# times of measurements (K, K), derivatives of the last layer by each latent variable (Q, K, h + 1),
# matrices from measurements and back (K, C), empty where they are the same; mismatch of a response.
SPREAD = "Tuple((f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[:,::1], f8))"


@either(f"{POINT}(f8[:,::1], f8, {SENSOR}, {FRAME})")
def linearise(touches: Array, angle: float, sensor: Sensor, frame: Frame) -> Point:
    """The model linearised at touches (k, 3) and an angle [deg]: a `POINT`.

    The response by forward-mode differentiation: one matrix product a layer for the values of all
    touches and their derivatives by x, y and force.
    """
    first, inner, biases, by_angle, last, constant, curve = sensor
    target, count, u = frame[0], len(touches), angle / SCALE
    rows, changes = np.empty((2 + 3 * count, len(target))), np.empty((count, len(target)))
    rows[0], rows[1] = target, 0.0
    for p in range(len(curve)):
        rows[0] -= u ** (p + 1) * curve[p]
        rows[1] += (p + 1) * u**p * (ANGLE_UNIT / SCALE) * curve[p]
    states = np.empty((4 * count, first.shape[1]))
    for t in range(count):
        states[t] = np.dot(touches[t], first) + angle * by_angle
        for a in range(3):
            states[(1 + a) * count + t] = first[a] * TOUCH_UNITS[a]
    for layer in range(len(biases) if count else 0):
        if layer:
            states = np.dot(states, inner[layer - 1])
        for t in range(count):  # SiLU, and its derivative by the chain rule
            before = states[t] + biases[layer]
            gate = 1.0 / (1.0 + np.exp(-before))
            states[t] = before * gate
            slope = (1.0 - states[t]) * gate + states[t]
            for a in range(1, 4):
                states[a * count + t] *= slope
    shapes = np.dot(states, last)
    for t in range(count):
        factor = frame[1][0] * touches[t, 2]
        shape = shapes[t] + constant
        changes[t] = factor * shape
        rows[0] -= changes[t]
        for a in range(3):
            rows[2 + 3 * t + a] = factor * shapes[(1 + a) * count + t]
        rows[4 + 3 * t] += (frame[1][0] * TOUCH_UNITS[2]) * shape
    return touches, angle, rows, changes, states[:count].copy()


@either("f8[:,::1](f8[:,::1], f8, f8)")
def curve_covariance(effects: Array, u: float, reference: float) -> Array:
    """Covariance (K, K) of a bend curve's change from one angle to another, in units of `SCALE`."""
    weights, p, q = np.empty(len(effects)), 1, 1
    for i in range(len(effects)):
        weights[i] = (u**p - reference**p) * (u**q - reference**q)
        p, q = (p, q + 1) if q < p else (p + 1, 1)
    size = round(math.sqrt(effects.shape[1]))
    total: Array = np.dot(weights, effects).reshape(size, size)
    return total


@either(f"f8[:,::1]({POINT}, {FRAME}, {SPREAD})")
def covariance(at: Point, frame: Frame, spread: Spread) -> Array:
    """Covariance (K, K) of the residual: that of the noise, of the curve, and of the response."""
    touches, angle, rows, changes, hidden = at
    noise, effects, lateness, latent_output, forward, back, mismatch = spread
    size, count, moved = len(noise), len(touches), angle - frame[1][1]
    summed, each = np.zeros(hidden.shape[1] + 1), np.dot(changes, back) if len(back) else changes
    variance = np.zeros(each.shape[1])
    for t in range(count):
        factor = frame[1][0] * touches[t, 2]
        summed[:-1] += factor * hidden[t]
        summed[-1] += factor
        variance += (mismatch * each[t]) ** 2
    latent = np.zeros((0, size))
    if count:
        latent = np.dot(latent_output.reshape(-1, len(summed)), summed).reshape(-1, size)
    errors = np.zeros((1 + len(latent) + len(forward), size))
    for q in range(len(latent)):
        errors[1 + q] = latent[q]
    for c in range(len(forward)):
        errors[1 + len(latent) + c] = math.sqrt(variance[c]) * forward[c]
    total = noise.copy()
    for c in range(0 if len(forward) else size):
        total[c, c] += variance[c]
    if abs(moved) > STILL_DEG:
        total += curve_covariance(effects, angle / SCALE, frame[1][1] / SCALE)
        errors[0] = np.dot(lateness, rows[1]) * (moved / ANGLE_UNIT)
    total += np.dot(errors.T, errors)
    return total


@either(f"Tuple((f8[:,::1], f8[:,::1]))({POINT}, f8[:,::1], {FRAME})")
def quadratic(at: Point, metric: Array, frame: Frame) -> tuple[Array, Array]:
    """Misfit, gradient and Hessian (1 + n, 1 + n), and the whitened rows (1 + n, K).

    The negative log prior is a part of the misfit.
    """
    touches, angle, (_, numbers, box) = at[0], at[1], frame
    white = np.dot(at[2], metric)
    products = np.dot(white, white.T)
    moved, turn = (numbers[1] - angle) / ANGLE_PRIOR_STD_DEG, ANGLE_UNIT / ANGLE_PRIOR_STD_DEG
    products[0, 0] += moved * moved
    products[0, 1] += turn * moved
    products[1, 1] += turn * turn
    for t in range(len(touches)):
        for a in range(3):
            i, departure = 2 + 3 * t + a, (box[0, a] - touches[t, a]) / TOUCH_UNITS[a]
            products[0, 0] += departure * departure * box[1, a]
            products[0, i] += departure * box[1, a]
            products[i, i] += box[1, a]
    separation, softness = numbers[4], 0.1 * numbers[4]
    for i in range(len(touches)):
        for j in range(i + 1, len(touches)):
            dx, dy = touches[i, 0] - touches[j, 0], touches[i, 1] - touches[j, 1]
            distance = math.sqrt(dx * dx + dy * dy)
            lacking = (separation - distance) / softness
            if lacking <= 0.0:
                continue
            if distance < 1e-9:  # two touches at one position part along x
                dx, distance = 1.0, 1.0
            scale = TOUCH_UNITS[0] / softness / distance
            towards, index = (
                (dx * scale, dy * scale, -dx * scale, -dy * scale),
                (2 + 3 * i, 3 + 3 * i, 2 + 3 * j, 3 + 3 * j),
            )
            products[0, 0] += lacking * lacking
            for p in range(4):
                products[0, index[p]] += lacking * towards[p]
                for q in range(4):
                    products[index[p], index[q]] += towards[p] * towards[q]
    return products, white


def _library_whiten(covariance: Array, vectors: Array) -> tuple[Array, float]:
    """`whiten` by the library."""
    lower, failed = lapack.dpotrf(covariance, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"minor {failed} of a covariance is not positive")
    white: Array = lapack.dtrtrs(lower, vectors.T, lower=1)[0].T
    return white, float(np.log(lower.diagonal()).sum())


@either("Tuple((f8[:,::1], f8))(f8[:,::1], f8[:,::1])", _library_whiten)
def whiten(covariance: Array, vectors: Array) -> tuple[Array, float]:
    """Vectors (m, K) whitened by a covariance (K, K), and half the log of its determinant."""
    lower, white, width = np.linalg.cholesky(covariance), vectors.copy(), 0.0
    for j in range(len(lower)):
        width += math.log(lower[j, j])
        for m in range(len(white)):
            rest = white[m, j]
            for k in range(j):
                rest -= lower[j, k] * white[m, k]
            white[m, j] = rest / lower[j, j]
    return white, width


@either("f8[::1](f8[::1], f8[:,::1], f8[:,::1], f8[:,:,::1])")
def log_densities(change: Array, values: Array, noise: Array, spreads: Array) -> Array:
    """Logarithms (n,) of normal densities of a change (K,), but for a constant.

    Their means are `values` (n, K), their covariances `noise` (K, K) and `spreads` (n, K, K) added.
    """
    logs = np.empty(len(values))
    for n in range(len(values)):
        white, width = whiten(noise + spreads[n], (change - values[n]).reshape(1, -1))
        logs[n] = -width - 0.5 * np.sum(white**2)
    return logs


@either(
    "Tuple((f8, f8, f8[:,::1], f8))(f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8, UniTuple(f8, 2))"
)
def score_angle(
    curve: Array,
    effects: Array,
    change: Array,
    noise: Array,
    angle: float,
    limits: tuple[float, float],
) -> tuple[float, float, Array, float]:
    """Angle [deg] of an untouched frame, by Fisher scoring, and its information [1/deg2].

    Every step regresses the residual on the curve's slope, in the metric of the noise and of the
    curve's own uncertainty at the present angle. Returned as well are the residual and the slope at
    the last angle, whitened (2, K), and half the log determinant of that metric's covariance.

    Args:
        curve, effects: as in `SENSOR` and `SPREAD`.
        change, noise: change from the flat sensor (K,), and its covariance (K, K) without the
            curve's uncertainty.
        angle: first angle.
        limits: least and largest angle [deg].
    """
    information, step, vectors = 0.0, math.inf, np.empty((2, len(change)))
    white, width = vectors, 0.0
    for number in range(SCORING_STEPS + 1):
        u = angle / SCALE
        vectors[0], vectors[1] = change, 0.0
        for p in range(len(curve)):
            vectors[0] -= u ** (p + 1) * curve[p]
            vectors[1] += (p + 1) * u**p / SCALE * curve[p]
        white, width = whiten(noise + curve_covariance(effects, u, 0.0), vectors)
        if number == SCORING_STEPS or abs(step) < SCORING_DEG:
            break
        information = np.dot(white[1], white[1])
        step = np.dot(white[1], white[0]) / information
        angle = min(max(angle + step, limits[0]), limits[1])
    return angle, information, white, width


@either(f"Tuple((f8[::1], f8))(f8[:,::1], f8[:,::1], {FRAME}, f8)")
def trust_step(products: Array, touches: Array, frame: Frame, radius: float) -> tuple[Array, float]:
    """Levenberg-Marquardt step (n,) to the minimum within a trust region, and its promise.

    The least of `DAMPINGS` whose step is within is chosen; it adds to the Hessian H in proportion
    to 1 + diag H. Unknowns at a bound that their gradient, downhill, would cross stay.

    Args:
        products: misfit, gradient and Hessian (1 + n, 1 + n).
        touches: unknowns that have bounds (k, 3).
        frame: frame with these bounds.
        radius: most unit steps of any unknown.

    Returns:
        the step.
        decrease of the misfit by it, if the model were linear.
    """
    box, gradient, step = frame[2], products[0, 1:].copy(), np.zeros(len(products) - 1)
    held = np.zeros(len(step))
    for t in range(len(touches)):
        for a in range(3):
            i, at = 1 + 3 * t + a, touches[t, a]
            if (at <= box[2, a] and gradient[i] < 0) or (at >= box[3, a] and gradient[i] > 0):
                gradient[i], held[i] = 0.0, BOUND_STIFFNESS
    both = np.concatenate((gradient.reshape(1, -1), np.eye(len(step))))
    for damping in DAMPINGS:
        damped = products[1:, 1:].copy()
        for i in range(len(step)):
            damped[i, i] += damping * (1.0 + damped[i, i]) + held[i]
        white, _ = whiten(damped, both)
        step = np.dot(white[1:], white[0])
        if np.abs(step).max() <= radius:
            break
    promised = 0.0
    for i in range(len(step)):
        promised += (2.0 * products[0, 1 + i] - np.dot(products[1 + i, 1:], step)) * step[i]
    return step, promised


@either(f"Tuple((f8[:,::1], f8))(f8[:,::1], f8, f8[::1], {FRAME})")
def apply_step(touches: Array, angle: float, step: Array, frame: Frame) -> tuple[Array, float]:
    """Touches (k, 3) and angle [deg] after a step (n,) in unit steps, clipped to their bounds."""
    _, numbers, box = frame
    turned = min(max(angle + ANGLE_UNIT * step[0], numbers[2]), numbers[3])
    moved = touches + step[1:].copy().reshape(-1, 3) * TOUCH_UNITS
    return np.minimum(np.maximum(moved, box[2]), box[3]), turned


@either(
    f"Tuple(({POINT}, f8[:,::1], f8[:,::1]))({POINT}, f8[:,::1], {SENSOR}, {FRAME}, i8, f8, f8)"
)
def minimise(
    at: Point,
    metric: Array,
    sensor: Sensor,
    frame: Frame,
    steps: int,
    tolerance: float,
    goal: float,
) -> tuple[Point, Array, Array]:
    """Levenberg-Marquardt from `at` in a metric, the transposed whitening (K, K)."""
    products, white = quadratic(at, metric, frame)
    radius = RADIUS
    for _ in range(steps):
        step, promised = trust_step(products, at[0], frame, radius)
        if promised < tolerance or products[0, 0] - OPTIMISM * promised > goal:
            break
        touches, angle = apply_step(at[0], at[1], step, frame)
        trial = linearise(touches, angle, sensor, frame)
        tried, tried_white = quadratic(trial, metric, frame)
        gain, length = products[0, 0] - tried[0, 0], np.abs(step).max()
        if gain < POOR * promised:
            radius = SHRINKING * length
        elif gain > GOOD * promised:
            radius = max(radius, GROWTH * length)
        if gain > 0.0:
            at, products, white = trial, tried, tried_white
    return at, products, white
