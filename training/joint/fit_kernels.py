"""Fit of one frame in numpy: model, covariance, prior and Levenberg-Marquardt; numba compiles it.

With K combinations, k touches, n = 1 + 3 k unknowns and a response network of h hidden units.
`implementation` gives the compiled copy where numba is wanted.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import either
from eitskin.training.joint.mirrored_frames import SCALE

Array = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Sensor: TypeAlias = tuple[Array, Array, Array, Array, Array, Array, Array]
Frame: TypeAlias = tuple[Array, Array, Array]
Point: TypeAlias = tuple[Array, float, Array, Array, Array]
Spread: TypeAlias = tuple[Array, Array, Array, Array, Array, Array, float]

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
HELD = 1e9  # addition to the Hessian that holds an unknown at its bound

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
# Covariances of noise (K, K) and of the bend curve's random effects (powers^2, K^2), weights of the
# times of measurements (K, K), derivatives of the last layer by each latent variable (Q, K, h + 1),
# matrices from measurements and back (K, C), empty where they are the same; mismatch of a response.
SPREAD = "Tuple((f8[:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[:,::1], f8))"


@either("void(f8[:,::1], i8)")
def activate(states: Array, count: int) -> None:
    """Apply SiLU to the first `count` rows, and its derivative to the three times as many below."""
    gate = 1.0 / (1.0 + np.exp(-states[:count]))
    active = states[:count] * gate
    slope = (1.0 - active) * gate + active
    states[:count] = active
    others = states.reshape(4, count, -1)[1:]
    others *= slope


@either(f"Tuple((f8[:,::1], f8[:,::1]))(f8[:,::1], f8, f8, {SENSOR})")
def respond(touches: Array, angle: float, unit: float, sensor: Sensor) -> tuple[Array, Array]:
    """Changes by touches (k, 3) and their derivatives, and the output of the response network.

    By forward-mode differentiation: one matrix product a layer for values and derivatives.

    Returns:
        changes, then their derivatives by a unit step of x, of y and of the force (4 k, K).
        output h of the network for each touch (k, h).
    """
    first, inner, biases, by_angle, last, constant, _ = sensor
    count = len(touches)
    states = np.empty((4 * count, first.shape[1]))
    states[:count] = np.dot(touches, first) + (biases[0] + angle * by_angle)
    for a in range(3):
        states[(1 + a) * count : (2 + a) * count] = first[a] * TOUCH_UNITS[a]
    activate(states, count)
    for layer in range(len(inner)):
        states = np.dot(states, inner[layer])
        states[:count] += biases[1 + layer]
        activate(states, count)
    changes = np.dot(states, last)
    changes[:count] += constant
    by_force = (unit * TOUCH_UNITS[2]) * changes[:count]
    factor = unit * touches[:, 2:]
    each = changes.reshape(4, count, -1)
    each *= factor
    changes[3 * count :] += by_force
    return changes, states[:count].copy()


@either(f"{POINT}(f8[:,::1], f8, {SENSOR}, {FRAME})")
def linearise(touches: Array, angle: float, sensor: Sensor, frame: Frame) -> Point:
    """The model linearised at touches (k, 3) and an angle [deg]: a `POINT`."""
    curve, target, count = sensor[6], frame[0], len(touches)
    rows = np.empty((2 + 3 * count, len(target)))
    u, orders = angle / SCALE, np.arange(1.0, len(curve) + 1.0)
    rows[0] = target - np.dot(u**orders, curve)
    rows[1] = np.dot(orders * u ** (orders - 1.0) * (ANGLE_UNIT / SCALE), curve)
    if count == 0:
        return touches, angle, rows, np.empty((0, len(target))), np.empty((0, len(sensor[3])))
    changes, hidden = respond(touches, angle, frame[1][0], sensor)
    for t in range(count):
        rows[0] -= changes[t]
    for a in range(3):
        rows[2 + a :: 3] = changes[(1 + a) * count : (2 + a) * count]
    return touches, angle, rows, changes[:count].copy(), hidden


@either(f"f8[:,::1]({POINT}, {FRAME}, {SPREAD})")
def covariance(at: Point, frame: Frame, spread: Spread) -> Array:
    """Covariance (K, K) of the residual: that of the noise, of the curve, and of the response."""
    touches, angle, rows, changes, hidden = at
    noise, effects, lateness, latent_output, forward, back, mismatch = spread
    total, size, moved = noise.copy(), len(noise), angle - frame[1][1]
    if abs(moved) > STILL_DEG:
        orders = np.arange(1.0, round(math.sqrt(len(effects))) + 1)
        steps = (angle / SCALE) ** orders - (frame[1][1] / SCALE) ** orders
        total += np.dot(np.outer(steps, steps).reshape(-1), effects).reshape(size, size)
        late = np.dot(lateness, rows[1]) * (moved / ANGLE_UNIT)
        total += np.outer(late, late)
    if len(touches) == 0:
        return total
    factor = frame[1][0] * touches[:, 2]
    summed = np.append(np.dot(factor, hidden), factor.sum())
    latent = np.dot(latent_output.reshape(-1, len(summed)), summed).reshape(-1, size)
    total += np.dot(latent.T, latent)
    each = np.dot(changes, back) if len(back) else changes
    variance = mismatch**2 * (each * each).sum(axis=0)
    if len(forward):
        total += np.dot(forward * variance, forward.T)
    else:
        diagonal = total.reshape(-1)[:: size + 1]
        diagonal += variance
    return total


@either(f"void(f8[:,::1], f8[:,::1], f8, {FRAME})")
def add_prior(products: Array, touches: Array, angle: float, frame: Frame) -> None:
    """Add the negative log prior to misfit, gradient and Hessian, `products` (1 + n, 1 + n)."""
    _, numbers, box = frame
    moved, turn = (numbers[1] - angle) / ANGLE_PRIOR_STD_DEG, ANGLE_UNIT / ANGLE_PRIOR_STD_DEG
    products[0, 0] += moved * moved
    products[0, 1] += turn * moved
    products[1, 1] += turn * turn
    if len(touches) == 0:
        return
    size, departure = len(products), (box[0] - touches) / TOUCH_UNITS
    pull = departure * box[1]
    products[0, 0] += (departure * pull).sum()
    products[0, 2:] += pull.reshape(-1)
    diagonal = products.reshape(-1)[2 * size + 2 :: size + 1]
    diagonal += (np.zeros_like(touches) + box[1]).reshape(-1)
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
            towards = np.array([dx, dy]) * (TOUCH_UNITS[0] / softness / distance)
            square, a, b = np.outer(towards, towards), 2 + 3 * i, 2 + 3 * j
            products[0, 0] += lacking * lacking
            products[0, a : a + 2] += lacking * towards
            products[0, b : b + 2] -= lacking * towards
            products[a : a + 2, a : a + 2] += square
            products[b : b + 2, b : b + 2] += square
            products[a : a + 2, b : b + 2] -= square
            products[b : b + 2, a : a + 2] -= square


@either(f"Tuple((f8[:,::1], f8[:,::1]))({POINT}, f8[:,::1], {FRAME})")
def quadratic(at: Point, metric: Array, frame: Frame) -> tuple[Array, Array]:
    """Misfit, gradient and Hessian (1 + n, 1 + n), and the whitened rows (1 + n, K)."""
    white = np.dot(at[2], metric)
    products = np.dot(white, white.T)
    add_prior(products, at[0], at[1], frame)
    return products, white


@either("Tuple((f8[::1], f8))(f8[:,::1], f8[::1], f8)")
def trust_step(products: Array, free: Array, radius: float) -> tuple[Array, float]:
    """Levenberg-Marquardt step (n,) to the minimum within a trust region, and its promise.

    The least of `DAMPINGS` whose step is within is chosen; it adds to the Hessian H in proportion
    to 1 + diag H.

    Args:
        products: misfit, gradient and Hessian (1 + n, 1 + n).
        free: one for unknowns that may move, zero for others (n,).
        radius: most unit steps of any unknown.

    Returns:
        the step.
        decrease of the misfit by it, if the model were linear.
    """
    hessian, gradient = products[1:, 1:].copy(), products[0, 1:].copy()
    unit, step = 1.0 + np.diag(hessian), gradient
    for damping in DAMPINGS:
        damped = hessian.copy()
        diagonal = damped.reshape(-1)[:: len(damped) + 1]
        diagonal += damping * unit + HELD * (1.0 - free)
        step = np.asarray(np.linalg.solve(damped, free * gradient), np.float64)
        if np.abs(step).max() <= radius:
            break
    return step, np.dot(2.0 * gradient - np.dot(hessian, step), step)


@either(f"f8[::1](f8[:,::1], f8[:,::1], {FRAME})")
def free_unknowns(products: Array, touches: Array, frame: Frame) -> Array:
    """Zero for unknowns at a bound that their gradient, downhill, would cross; else one (n,)."""
    box, free = frame[2], np.ones(len(products) - 1)
    gradient = products[0, 2:].copy().reshape(-1, 3)
    below, above = (touches <= box[2]) & (gradient < 0.0), (touches >= box[3]) & (gradient > 0.0)
    free[1:] -= (below | above).reshape(-1)
    return free


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
        step, promised = trust_step(products, free_unknowns(products, at[0], frame), radius)
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
