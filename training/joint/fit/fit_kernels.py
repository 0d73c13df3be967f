"""Compiled loops of the fit of one frame; plain twins: `TouchObjective` and `levenberg_marquardt`.

Arrays are told there, too: K combinations, k touches, n = 1 + 3 k unknowns.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernel
from eitskin.training.joint.bent_frames import SCALE
from eitskin.training.joint.fit.objective import OPTIMISM, STILL_DEG
from eitskin.training.joint.fit.quadratic_model import (
    FIRST_DAMPING,
    GOOD,
    GROWTH,
    HELD,
    LEAST_DAMPING,
    MOST_DAMPING,
    POOR,
    RADIUS,
    RAISED,
    SHRINKING,
)
from eitskin.training.joint.prior import ANGLE_PRIOR_STD_DEG, ANGLE_UNIT, TOUCH_UNITS

Array = NDArray[np.float64]
Sensor: TypeAlias = tuple[Array, Array, Array, Array, Array, Array, Array]
Frame: TypeAlias = tuple[Array, Array, Array]
Flags: TypeAlias = NDArray[np.bool_]
Point: TypeAlias = tuple[Array, float, Array, Array, Array]
Spread: TypeAlias = tuple[Array, Array, Array, Array, Array, Array, float]

# First layer of the response network (3, h), the others (layers - 1, h, h), biases (layers, h), the
# first layer's by the angle (h,); last layer (h, K) and its constant (K,); bend curve (powers, K).
SENSOR = "Tuple((f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[:,::1]))"
# Change plus the bend at the reference (K,); numbers: strength of a touch by its force [1/N], angle
# of the reference, least and largest angle [deg], separation of touches [m]; of x, y [m] and force
# [N] the mean, the stiffness, and the bounds (4, 3).
FRAME = "Tuple((f8[::1], f8[::1], f8[:,::1]))"
# Touches (k, 3), angle [deg], rows (1 + n, K), changes (k, K), hidden (k, h).
POINT = "Tuple((f8[:,::1], f8, f8[:,::1], f8[:,::1], f8[:,::1]))"
# Covariances of noise (K, K) and of the bend curve's random effects (powers^2, K^2), weights of the
# times of measurements (K, K), derivatives of the last layer by each latent variable (Q, K, h + 1),
# matrices from measurements and back (K, C), empty where they are the same; mismatch of a response.
SPREAD = "Tuple((f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[:,::1], f8))"


@kernel("void(f8[:,::1], i8)")
def activate(rows: Array, count: int) -> None:
    """Apply SiLU to the first `count` rows, and its derivative to the three times as many below."""
    for t in range(count):
        for j in range(rows.shape[1]):
            value = rows[t, j]
            gate = 1.0 / (1.0 + math.exp(-value))
            active = value * gate
            slope = (1.0 - active) * gate + active
            rows[t, j] = active
            for a in range(1, 4):
                rows[a * count + t, j] *= slope


@kernel(f"{POINT}(f8[:,::1], f8, {SENSOR}, {FRAME})")
def linearise(touches: Array, angle: float, sensor: Sensor, frame: Frame) -> Point:
    """The model linearised at touches (k, 3) and an angle [deg]."""
    first, inner, biases, by_angle, last, constant, curve = sensor
    target, numbers, _ = frame
    unit, count, size = numbers[0], len(touches), first.shape[1]
    rows = np.empty((2 + 3 * count, len(target)))
    u = angle / SCALE
    for c in range(len(target)):
        value, slope = 0.0, 0.0
        for p in range(len(curve) - 1, -1, -1):
            slope = slope * u + (p + 1) * curve[p, c]
            value = (value + curve[p, c]) * u
        rows[0, c] = target[c] - value
        rows[1, c] = slope / SCALE * ANGLE_UNIT
    hidden, changes = np.empty((count, size)), np.empty((count, len(target)))
    if count == 0:
        return touches, angle, rows, changes, hidden
    states = np.empty((4 * count, size))
    for t in range(count):
        for j in range(size):
            value = biases[0, j] + angle * by_angle[j]
            for a in range(3):
                value += touches[t, a] * first[a, j]
                states[(1 + a) * count + t, j] = first[a, j] * TOUCH_UNITS[a]
            states[t, j] = value
    activate(states, count)
    for layer in range(len(inner)):
        states = np.dot(states, inner[layer])
        for t in range(count):
            for j in range(size):
                states[t, j] += biases[1 + layer, j]
        activate(states, count)
    for t in range(count):
        for j in range(size):
            hidden[t, j] = states[t, j]
    shapes = np.dot(states, last)
    for t in range(count):
        factor = unit * touches[t, 2]
        for c in range(len(target)):
            shape = shapes[t, c] + constant[c]
            changes[t, c] = factor * shape
            rows[0, c] -= factor * shape
            rows[2 + 3 * t, c] = factor * shapes[count + t, c]
            rows[3 + 3 * t, c] = factor * shapes[2 * count + t, c]
            by_force = unit * TOUCH_UNITS[2] * shape
            rows[4 + 3 * t, c] = factor * shapes[3 * count + t, c] + by_force
    return touches, angle, rows, changes, hidden


@kernel(f"f8[:,::1]({POINT}, {FRAME}, {SPREAD})")
def covariance(at: Point, frame: Frame, spread: Spread) -> Array:
    """Covariance (K, K) of the residual at a point; plain twin: `TouchObjective.covariance`."""
    touches, angle, rows, changes, hidden = at
    noise, effects, lateness, latent_output, forward, back, mismatch = spread
    total, size, moved = noise.copy(), len(noise), angle - frame[1][1]
    if abs(moved) > STILL_DEG:
        powers = round(math.sqrt(len(effects)))
        u, reference, weights = angle / SCALE, frame[1][1] / SCALE, np.empty(len(effects))
        for p in range(powers):
            for q in range(powers):
                weight = u ** (p + 1) - reference ** (p + 1)
                weights[p * powers + q] = weight * (u ** (q + 1) - reference ** (q + 1))
        total += np.dot(weights, effects).reshape(size, size)
        late = np.dot(lateness, rows[1]) * (moved / ANGLE_UNIT)
        for i in range(size):
            for j in range(size):
                total[i, j] += late[i] * late[j]
    if len(touches) == 0:
        return total
    width, factor = hidden.shape[1], frame[1][0] * touches[:, 2]
    summed = np.empty(width + 1)
    summed[:width], summed[width] = np.dot(factor, hidden), factor.sum()
    flat = latent_output.reshape(len(latent_output) * size, width + 1)
    latent = np.dot(flat, summed).reshape(len(latent_output), size)
    total += np.dot(latent.T, latent)
    if len(forward) == 0:
        for t in range(len(touches)):
            for i in range(size):
                total[i, i] += (mismatch * changes[t, i]) ** 2
        return total
    each, weighted = np.dot(changes, back), forward.copy()
    for c in range(forward.shape[1]):
        variance = 0.0
        for t in range(len(touches)):
            variance += (mismatch * each[t, c]) ** 2
        for i in range(size):
            weighted[i, c] *= variance
    total += np.dot(weighted, forward.T)
    return total


@kernel(f"void(f8[:,::1], f8[:,::1], f8, {FRAME})")
def add_prior(products: Array, touches: Array, angle: float, frame: Frame) -> None:
    """Add the negative log prior to misfit, gradient and Hessian, `products` (1 + n, 1 + n)."""
    _, numbers, box = frame
    moved, turn = (numbers[1] - angle) / ANGLE_PRIOR_STD_DEG, ANGLE_UNIT / ANGLE_PRIOR_STD_DEG
    products[0, 0] += moved * moved
    products[0, 1] += turn * moved
    products[1, 1] += turn * turn
    for t in range(len(touches)):
        for a in range(3):
            departure = (box[0, a] - touches[t, a]) / TOUCH_UNITS[a]
            products[0, 0] += departure * departure * box[1, a]
            products[0, 2 + 3 * t + a] += departure * box[1, a]
            products[2 + 3 * t + a, 2 + 3 * t + a] += box[1, a]
    separation, softness = numbers[4], 0.1 * numbers[4]
    towards = np.empty(2)
    for i in range(len(touches)):
        for j in range(i + 1, len(touches)):
            dx, dy = touches[i, 0] - touches[j, 0], touches[i, 1] - touches[j, 1]
            distance = math.hypot(dx, dy)
            lacking = (separation - distance) / softness
            if lacking <= 0.0:
                continue
            towards[0], towards[1] = 1.0, 0.0
            if distance > 1e-9:
                towards[0], towards[1] = dx / distance, dy / distance
            products[0, 0] += lacking * lacking
            for p in range(2):
                at, other = 2 + 3 * i + p, 2 + 3 * j + p
                pull = towards[p] * TOUCH_UNITS[0] / softness
                products[0, at] += lacking * pull
                products[0, other] -= lacking * pull
                for q in range(2):
                    square = pull * towards[q] * TOUCH_UNITS[0] / softness
                    products[at, 2 + 3 * i + q] += square
                    products[other, 2 + 3 * j + q] += square
                    products[at, 2 + 3 * j + q] -= square
                    products[other, 2 + 3 * i + q] -= square


@kernel("f8(f8[:,::1], f8, boolean[::1], f8[::1])")
def damped_step(products: Array, damping: float, held: Flags, step: Array) -> float:
    """Set a step (n,) with `damping` of the Hessian's diagonal; the most of any unknown."""
    n, most = len(step), 0.0
    root = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = products[1 + i, 1 + j]
            if i == j:
                total += damping * (1.0 + total) + (HELD if held[i] else 0.0)
            for m in range(j):
                total -= root[i, m] * root[j, m]
            root[i, j] = math.sqrt(total) if i == j else total / root[j, j]
    for i in range(n):
        total = 0.0 if held[i] else products[0, 1 + i]
        for m in range(i):
            total -= root[i, m] * step[m]
        step[i] = total / root[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for m in range(i + 1, n):
            total -= root[m, i] * step[m]
        step[i] = total / root[i, i]
        most = max(most, abs(step[i]))
    return most


@kernel(f"Tuple((f8, f8))(f8[:,::1], f8[:,::1], {FRAME}, f8, boolean[::1], f8[::1])")
def choose_step(
    products: Array, touches: Array, frame: Frame, radius: float, held: Flags, step: Array
) -> tuple[float, float]:
    """Set the step (n,) within a trust region; the most of any unknown, and the promise."""
    box = frame[2]
    for t in range(len(touches)):
        for a in range(3):
            i, at, gradient = 1 + 3 * t + a, touches[t, a], products[0, 2 + 3 * t + a]
            held[i] = (at <= box[2, a] and gradient < 0.0) or (at >= box[3, a] and gradient > 0.0)
    length = damped_step(products, LEAST_DAMPING, held, step)
    damping = FIRST_DAMPING
    while length > radius and damping <= MOST_DAMPING:
        length = damped_step(products, damping, held, step)
        damping *= RAISED
    promised = 0.0
    for i in range(len(step)):
        rate = 2.0 * products[0, 1 + i]
        for j in range(len(step)):
            rate -= products[1 + i, 1 + j] * step[j]
        promised += rate * step[i]
    return length, promised


@kernel(f"Tuple((f8[:,::1], f8[:,::1]))({POINT}, f8[:,::1], {FRAME})")
def quadratic(at: Point, metric: Array, frame: Frame) -> tuple[Array, Array]:
    """Misfit, gradient and Hessian (1 + n, 1 + n), and the whitened rows (1 + n, K)."""
    touches, angle, rows, _, _ = at
    white = np.dot(rows, metric)
    products = np.dot(white, white.T)
    add_prior(products, touches, angle, frame)
    return products, white


@kernel(
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
    _, numbers, box = frame
    products, white = quadratic(at, metric, frame)
    step, held, radius = np.empty(len(products) - 1), np.zeros(len(products) - 1, np.bool_), RADIUS
    for _ in range(steps):
        length, promised = choose_step(products, at[0], frame, radius, held, step)
        if promised < tolerance or products[0, 0] - OPTIMISM * promised > goal:
            break
        angle = min(max(at[1] + ANGLE_UNIT * step[0], numbers[2]), numbers[3])
        touches = np.empty_like(at[0])
        for t in range(len(touches)):
            for a in range(3):
                moved = at[0][t, a] + step[1 + 3 * t + a] * TOUCH_UNITS[a]
                touches[t, a] = min(max(moved, box[2, a]), box[3, a])
        trial = linearise(touches, angle, sensor, frame)
        tried, tried_white = quadratic(trial, metric, frame)
        gain = products[0, 0] - tried[0, 0]
        if gain < POOR * promised:
            radius = SHRINKING * length
        elif gain > GOOD * promised:
            radius = max(radius, GROWTH * length)
        if gain > 0.0:
            at, products, white = trial, tried, tried_white
    return at, products, white


@kernel(
    "Tuple((f8, Tuple((i8, f8)), Tuple((i8, f8))))"
    "(f8[:,::1], f8[::1], boolean[:,::1], boolean[::1], f8, f8)"
)
def best_pair(
    gram: Array,
    projections: Array,
    apart: Flags,
    free: Flags,
    least: float,
    most: float,
) -> tuple[float, tuple[int, float], tuple[int, float]]:
    """Gain of the best pair of shapes, number and strength of each; plain twin: `touch_search`."""
    highest, a, b, strength_a, strength_b = 0.0, 0, 0, 0.0, 0.0
    for i in range(len(projections)):
        if not free[i]:
            continue
        for j in range(i + 1, len(projections)):
            sizes = gram[i, i] * gram[j, j]
            determinant = max(sizes - gram[i, j] * gram[i, j], 1e-9 * sizes)
            first = (projections[i] * gram[j, j] - gram[i, j] * projections[j]) / determinant
            second = (projections[j] * gram[i, i] - gram[i, j] * projections[i]) / determinant
            gain = first * projections[i] + second * projections[j]
            if gain <= highest or not (free[j] and apart[i, j]):
                continue
            if min(first, second) > least and max(first, second) < most:
                highest, a, b, strength_a, strength_b = gain, i, j, first, second
    return highest, (a, strength_a), (b, strength_b)
