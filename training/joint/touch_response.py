"""The learned model of touches: their prior, and the change of log V that they make.

Training estimates a `TouchPrior` from the touches of its dataset (`TouchPrior.fit`); a saved
pipeline keeps it in the arrays `bounds` and `scalars`. The response is a network of position, force
and bend.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from eitskin.compiled import implementation
from eitskin.training.joint.fit_kernels import KERNELS, TOUCH_UNITS
from eitskin.training.method.stored_fields import StoredField, StoredFields

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Weights: TypeAlias = tuple[Array, Array, Array, Array, Array, Array]

MAX_TOUCHES = 4  # in one frame
MARGIN = 0.003  # m, by which touches may lie outside of the positions trained with
FORCE_MARGINS = (0.3, 1.3)  # times the smallest and the largest force trained with
SENSITIVITY_STD = 0.15  # relative; specimens respond more or less strongly to the same force
LOG_STRENGTH_STD = 0.15  # prior of the specimens' log strength


@dataclass(frozen=True, slots=True, eq=False)
class TouchPrior:
    """Prior distribution of position, force and mutual distance of touches.

    Positions are uniform within bounds; a normal distribution of the same variance keeps them
    determined. Forces are normal within bounds. Touches closer than `separation` repel each other.

    Attributes:
        separation: smallest distance of two simultaneous touches [m].
        force: mean and standard deviation [N].
        low, high: bounds of x, y [m] and force [N], (3,).
        box: box of x, y [m] and force [N] the mean, the inverse variance in unit steps, and the
            bounds (4, 3); follows from the above.
    """

    separation: float
    force: tuple[float, float]
    low: Array
    high: Array
    box: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Derive mean and stiffness."""
        mean, deviation = 0.5 * (self.low + self.high), (self.high - self.low) / math.sqrt(12.0)
        mean[2], deviation[2] = self.force
        box = np.array([mean, (TOUCH_UNITS / deviation) ** 2, self.low, self.high])
        object.__setattr__(self, "box", box)

    @classmethod
    def fit(
        cls, touches: Floats, outline: tuple[float, float], largest_radius: float
    ) -> "TouchPrior":
        """Estimate the prior from the touches of n frames.

        Args:
            touches: x [m], y [m] and force [N] (n, k, 3); NaN where absent.
            outline: length and width of the sensor [m].
            largest_radius: largest radius of the indenters [m]; touches keep its double apart where
                no frame has two touches.
        """
        least, most = (end(touches, axis=(0, 1)) for end in (np.nanmin, np.nanmax))
        low = [*np.maximum(least[:2] - MARGIN, 0.0), FORCE_MARGINS[0] * least[2]]
        high = [*np.minimum(most[:2] + MARGIN, outline), FORCE_MARGINS[1] * most[2]]
        first, second = np.triu_indices(touches.shape[1], 1)
        distances = np.hypot(*(touches[:, first, :2] - touches[:, second, :2]).T)
        distances = distances[np.isfinite(distances)]
        separation = float(distances.min()) if len(distances) else 2 * largest_radius
        mean = float(np.nanmean(touches[..., 2]))
        deviation = float(np.hypot(np.nanstd(touches[..., 2]), SENSITIVITY_STD * mean))
        return cls(
            separation, (mean, deviation), np.array(low, dtype=float), np.array(high, dtype=float)
        )

    @classmethod
    def anywhere(cls, outline: tuple[float, float], radius: float) -> "TouchPrior":
        """Prior of unit touches anywhere on a sensor [m], for a method that never saw one."""
        low, high = (0.0, 0.0, FORCE_MARGINS[0]), (*outline, FORCE_MARGINS[1])
        return cls(2 * radius, (1.0, SENSITIVITY_STD), np.array(low), np.array(high))


@dataclass(frozen=True, slots=True, eq=False)
class InputRanges:
    """Ranges of the inputs that a response was learned for; beyond them it extrapolates.

    Attributes:
        size: length and width of the sensor [m].
        force: smallest and largest [N].
        angle_deg: smallest and largest [deg].
    """

    size: tuple[float, float]
    force: tuple[float, float]
    angle_deg: tuple[float, float]

    @property
    def middle_force(self) -> float:
        """Middle of the range of forces [N]."""
        return 0.5 * (self.force[0] + self.force[1])

    def inputs(self, touches: Array, angle_deg: ArrayLike) -> Array:
        """Network inputs (..., 4), about -1 to 1.

        Args:
            touches: x [m], y [m] and force [N] (..., 3).
            angle_deg: angle of the bend (...) [deg].
        """
        angle = np.asarray(angle_deg)[..., None] / _ANGLE_SCALE
        return np.concatenate([touches * self.input_scale - 1.0, angle], axis=-1)

    def corners(self) -> Array:
        """Least and largest network inputs (2, 4)."""
        touches = np.array([(0.0, 0.0, self.force[0]), (*self.size, self.force[1])])
        return self.inputs(touches, np.array(self.angle_deg))

    @property
    def input_scale(self) -> Array:
        """Derivatives of the first three inputs by x, y [1/m] and force [1/N]."""
        return np.array([2.0 / self.size[0], 2.0 / self.size[1], 1.0 / self.middle_force])


_ANGLE_SCALE = 30.0  # deg, unit of the network's input


@dataclass(frozen=True, slots=True, eq=False)
class TouchResponse(StoredFields):
    """Change by one touch, for any specimen; changes by several touches add up.

    The change is that of log V in K combinations of measurements (`Combinations`).

        g(x, y, F, theta; p, q) = F / F0 scale (W0 + sum_j p_j Wj + sum_l q_l Wl) [h, 1]

    with h(x, y, F, theta) a network of three layers and p the features of a specimen. The latent
    variables q ~ N(0, 1) describe differences between specimens that only touches show, such as the
    stiffness around the gel; q stays unknown and adds to the uncertainty. The factor F makes a
    touch of zero force change nothing. The model is linear in p and q, because specimens differ by
    little.

    Attributes:
        weights: weights of the three layers, (hidden, inputs) each.
        biases: biases of the three layers, (hidden,) each.
        output: last layer for the middle specimen, then its derivative by each feature
            (1 + P, K, hidden + 1).
        latent_output: derivative of the last layer by each q (Q, K, hidden + 1).
        scale: typical change of log V.
        ranges: ranges of the inputs learned from.
        mismatch: rms error of each measurement relative to its rms change, on held-out specimens,
            after fitting their strength and q.
    """

    weights: Annotated[tuple[Array, ...], StoredField("weight", single=True)]
    biases: Annotated[tuple[Array, ...], StoredField("bias", single=True)]
    output: Annotated[Array, StoredField(single=True)]
    latent_output: Annotated[Array, StoredField("hidden_output", single=True)]
    scale: Annotated[float, StoredField("scale")]
    ranges: Annotated[InputRanges, StoredField(stacked=True)]
    mismatch: Annotated[float, StoredField("scale")]
    _layers: tuple[Array, ...] = field(init=False, repr=False)  # weights (inputs, hidden), scaled
    _biases: tuple[Array, ...] = field(init=False, repr=False)
    _bias_by_angle: Array = field(init=False, repr=False)  # of the first layer [1/deg]
    _candidates: dict[tuple[bytes, float], Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Fold the input scales into the first layer."""
        first = self.weights[0]
        layers = [weight.T for weight in self.weights]
        layers[0] = (first[:, :3] * self.ranges.input_scale).T
        biases = (self.biases[0] - first[:, :3].sum(axis=1), *self.biases[1:])
        object.__setattr__(self, "_layers", tuple(map(np.ascontiguousarray, layers)))
        object.__setattr__(self, "_biases", biases)
        object.__setattr__(self, "_bias_by_angle", first[:, 3] / _ANGLE_SCALE)
        object.__setattr__(self, "_candidates", {})

    def hidden_output(self, touches: Array, angle_deg: ArrayLike) -> Array:
        """Input of the last layer, [h, 1] F / F0 scale (..., hidden + 1), for touches (..., 3)."""
        before = touches @ self._layers[0] + self._biases[0]
        before += np.asarray(angle_deg)[..., None] * self._bias_by_angle
        hidden = before * expit(before)
        for layer, bias in zip(self._layers[1:], self._biases[1:], strict=True):
            before = hidden @ layer + bias
            hidden = before * expit(before)
        factor = self.unit * touches[..., 2:]
        return np.concatenate([factor * hidden, factor], axis=-1)

    def candidate_output(self, places: Array, angle_deg: float) -> Array:
        """`hidden_output` of touches of the middle force at places (n, 2) [m].

        Kept, since it is the same for all specimens.
        """
        key = places.tobytes(), angle_deg
        if key not in self._candidates:
            touches = np.column_stack([places, np.full(len(places), self.ranges.middle_force)])
            self._candidates[key] = self.hidden_output(touches, angle_deg)
        return self._candidates[key]

    @classmethod
    def none(cls, features: int, channels: int, size: tuple[float, float]) -> "TouchResponse":
        """Response of zero for P features and K channels, for a method that never saw a touch."""
        ranges = InputRanges(size, (1.0, 1.0), (0.0, 0.0))
        output, latent = np.zeros((1 + features, channels, 2)), np.zeros((0, channels, 2))
        return cls((np.zeros((1, 4)),), (np.zeros(1),), output, latent, 1.0, ranges, 0.0)

    @property
    def unit(self) -> float:
        """Factor of a touch divided by its force [1/N]."""
        return self.scale / self.ranges.middle_force

    def for_specimen(self, features: ArrayLike) -> "SpecimenResponse":
        """The response of a specimen with features (P,)."""
        p = np.concatenate([[1.0], np.asarray(features, dtype=float)])
        return SpecimenResponse(self, np.tensordot(p, self.output, axes=1))


@dataclass(frozen=True, slots=True, eq=False)
class SpecimenResponse:
    """Change of log V by touches on one specimen.

    Attributes:
        response: response of every specimen.
        output: last layer of this specimen (K, hidden + 1).
    """

    response: TouchResponse
    output: Array
    stacked: Weights = field(init=False, repr=False)  # `SENSOR` of `fit_kernels`, less the curve

    def __post_init__(self) -> None:
        """Arrange the weights for evaluation."""
        response, last = self.response, np.ascontiguousarray(self.output[:, :-1].T)
        first, *others = response._layers
        inner = np.array(others).reshape(-1, len(last), len(last))
        start = first, inner, np.array(response._biases), response._bias_by_angle
        object.__setattr__(self, "stacked", (*start, last, self.output[:, -1].copy()))

    def __call__(self, touches: Array, angle_deg: float) -> Array:
        """Change (k, K) by each touch (k, 3) of x [m], y [m] and force [N]."""
        change: Array = self.response.hidden_output(touches, angle_deg) @ self.output.T
        return change

    def with_derivatives(self, touches: Array, angle_deg: float) -> Array:
        """Changes (4, k, K) by touches (k, 3), and derivatives by x and y [1/m] and force [1/N]."""
        channels, unit = len(self.output), np.array([self.response.unit])
        sensor = (*self.stacked, np.zeros((0, channels)))
        frame = np.zeros(channels), unit, np.zeros((4, 3))
        kernels, touches = implementation(KERNELS), np.ascontiguousarray(touches)
        _, _, rows, changes, _ = kernels.linearise(touches, angle_deg, sensor, frame)
        derivatives = rows[2:].reshape(len(touches), 3, channels) / TOUCH_UNITS[:, None]
        return np.concatenate([changes[None], derivatives.transpose(1, 0, 2)])

    def latent_changes(self, touches: Array, angle_deg: float) -> Array:
        """Derivative of the touches' summed change by each q (Q, K)."""
        hidden = self.response.hidden_output(touches, angle_deg).sum(axis=0)
        change: Array = self.response.latent_output @ hidden
        return change
