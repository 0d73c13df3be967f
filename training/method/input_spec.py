"""Input of a pipeline: sensor, protocol, units and their symmetries; refusal of other frames."""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LARGEST_READING, LEAST_READING, require_axes
from eitskin.config import from_dict, to_dict
from eitskin.datasets import Dataset
from eitskin.extras import old_names
from eitskin.geometry import (
    ConfigurationError,
    DataError,
    FrameError,
    SensorDesign,
    Surface,
    UnusableFrameError,
)
from eitskin.simulator import Frame, Protocol

Array = NDArray[np.float64]

_GRID = 37  # points along x and along y at which an outline is compared with its image
MAX_ORDERED_ELECTRODES = 64  # electrodes, of which wrong orders are tried
_TOLERANCE = 1e-6  # m, between an electrode and the mirror image of another
Known = TypeVar("Known")
FREQUENCY_TOLERANCE = 0.01  # relative
MAX_SCALE = 5.0  # factor common to all values; gels scatter by less, wrong units by more
MAX_SPREAD = 0.10  # of log ratios; contacts that scatter by 50 % give 0.07, wrong wiring 0.15
# Readings of neighbours depend far more on the places of electrodes: between 32 on a rim they
# scatter by 0.12 where these do by 0.5 mm, and wrong wiring gives 1.
SPREAD_MARGIN = 1.5  # times the largest spread of the specimens trained with
MAX_CHANNEL_SPREAD = 0.5
# share of the scatter that another order of the electrodes leaves of a wrong one
EXCHANGE_SCATTER_SHARE = 0.5
SMALL = 0.1  # of the rms of all values, below which a channel counts less
PIXELS = 2560  # of a map; on the reference sensor 32 x 80 squares of 1.875 mm
MIN_CHANNELS = 0.5  # share of a frame that must be usable


@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """One mirror symmetry, or the identity.

    Attributes:
        flips: whether x and whether y are reversed.
        order: the mirrored sensor's measurement i has the magnitude of the sensor's order[i], (m,).
        size: length and width of the sensor [m].
    """

    flips: tuple[bool, bool]
    order: NDArray[np.int64]
    size: tuple[float, float]

    def places(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Mirror images of positions x and y (...) [m]."""
        (length, width), (flip_x, flip_y) = self.size, self.flips
        return (length - x if flip_x else x), (width - y if flip_y else y)


def mirrors(design: SensorDesign, protocol: Protocol) -> tuple[Mirror, ...]:
    """All mirror symmetries of a sensor and its protocol, the identity first.

    The hinge lies in the middle and bends about y, so it breaks none of the sensor's symmetries.
    """
    length, width = design.outline.length, design.outline.width
    places = np.array([[e.x, e.y] for e in design.electrodes])
    shapes = [replace(electrode, x=0.0, y=0.0) for electrode in design.electrodes]
    mirror_list = []
    for flips in ((False, False), (True, False), (False, True), (True, True)):
        image = np.where(flips, (length, width) - places, places)
        distance = np.linalg.norm(image[:, None] - places[None], axis=2)
        partner = distance.argmin(axis=1)
        same = (
            _same_outline(design, flips)
            and distance.min(axis=1).max() < _TOLERANCE
            and shapes == [shapes[number] for number in partner]
        )
        order = measurement_images(np.array(protocol.table), partner) if same else None
        if order is not None:
            mirror_list.append(Mirror(flips, order, (length, width)))
    return tuple(mirror_list)


def electrode_orders(protocol: Protocol) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Wrong orders of the electrodes, in words, and the measurements that these exchange.

    Two electrodes are exchanged, or all are counted from another one, in either direction; none of
    more than `MAX_ORDERED_ELECTRODES` electrodes, whose pairs are too many to try.

    Yields:
        name: of the order.
        order: number of the measurement that is in each one's place (m,).
    """
    numbers = np.arange(protocol.n_electrodes)
    if len(numbers) > MAX_ORDERED_ELECTRODES:
        return
    orders = []
    for a, b in itertools.combinations(numbers.tolist(), 2):
        exchanged = numbers.copy()
        exchanged[[a, b]] = b, a
        orders.append((f"electrodes {a} and {b} exchanged", exchanged))
    for first, way in itertools.product(numbers.tolist(), ("", "backwards ")):
        counted = (first + (-numbers if way else numbers)) % len(numbers)
        orders.append((f"electrodes counted {way}from {first} on", counted))
    table = np.array(protocol.table)
    for name, partner in orders:
        if (order := measurement_images(table, partner)) is not None:
            yield name, order


def _same_outline(design: SensorDesign, flips: tuple[bool, bool]) -> bool:
    """Whether the outline equals its mirror image, on a grid of points."""
    if isinstance(design.outline, Surface):
        return not any(flips)
    length, width = design.outline.length, design.outline.width
    steps = (np.arange(_GRID) + 0.5) / _GRID
    x, y = (axis.ravel() for axis in np.meshgrid(steps * length, steps * width))
    mirrored = np.stack([length - x if flips[0] else x, width - y if flips[1] else y], axis=1)
    here, there = (design.outline.contains(p) for p in (np.stack([x, y], axis=1), mirrored))
    return bool(np.array_equal(here, there))


def measurement_images(
    table: NDArray[np.int64], partner: NDArray[np.intp], polarity: bool = False
) -> NDArray[np.int64] | None:
    """Number of each measurement's image (m,) under partners of the electrodes.

    None where a protocol's table (m, 4) lacks one. Reversed polarities change the sign of a
    measurement, not its magnitude; with `polarity` they make another measurement, unless source
    and sink are swapped as well as both sense leads.
    """
    codes, images = (_codes(each, len(partner), polarity) for each in (table, partner[table]))
    sorter = np.argsort(codes, kind="stable")
    order = sorter[np.searchsorted(codes[sorter], images, "right") - 1]
    return order if np.array_equal(codes[order], images) else None


def _codes(table: NDArray[np.int64], count: int, polarity: bool) -> NDArray[np.int64]:
    """Numbers (m,), the same for rows whose pairs of electrodes are the same in either order."""
    pairs = table.reshape(-1, 2, 2)
    drive, sense = (pairs.min(axis=2) * count + pairs.max(axis=2)).T
    reversals = (pairs[..., 0] > pairs[..., 1]).sum(axis=1)
    codes: NDArray[np.int64] = 2 * (drive * count**2 + sense) + polarity * (reversals % 2)
    return codes


@old_names(described="complete_dataset", of="from_dataset", of_sensor="for_sensor")
@dataclass(frozen=True, slots=True, eq=False)
class InputSpec:
    """Sensor, measurements and units that a pipeline was trained for.

    Attributes:
        known_design: the nominal sensor; None where a recording of touches shows none.
        known_protocol: the table of measurements; None as above.
        frequency: frequency of the excitation [Hz]; NaN where unknown.
        reference: magnitudes of the flat, untouched sensor (measurements,) [ohm]; median over the
            specimens trained with; NaN where any sensor is taken.
        spread: largest root mean square of the logarithms of a sensor's magnitudes over
            `reference`, less a common factor, that is taken for a sensor of this design.
        extent: smallest and largest x and y of the touches trained with (2, 2) [m]; None where no
            method needs them.

    Example:
        >>> from eitskin import Pipeline
        >>> Pipeline.load("reference.eitmodel").layout.protocol.n_electrodes
        8
    """

    known_design: SensorDesign | None
    known_protocol: Protocol | None
    frequency: float
    reference: NDArray[np.float64]
    spread: float = MAX_SPREAD
    extent: NDArray[np.float64] | None = None

    @classmethod
    def from_dataset(
        cls, dataset: Dataset, design: SensorDesign, protocol: Protocol
    ) -> "InputSpec":
        """Specification for the sensors of a training set."""
        magnitudes = np.abs(dataset.reference[np.unique(dataset.specimen)]).astype(float)
        reference = np.median(magnitudes, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(magnitudes / reference)
        weights = _weights(reference)
        finite = [np.isfinite(log) for log in logs]
        spreads = [_spread(log[k], weights[k])[0] for log, k in zip(logs, finite, strict=True)]
        spread = min(max(MAX_SPREAD, SPREAD_MARGIN * max(spreads)), MAX_CHANNEL_SPREAD)
        return cls(design, protocol, dataset.frequency, reference, spread)

    def document(self) -> dict[str, Any]:
        """Plain data for JSON, without `reference`."""
        return {
            "design": self.known_design and to_dict(self.known_design),
            "protocol": self.known_protocol and asdict(self.known_protocol),
            "frequency": None if math.isnan(self.frequency) else self.frequency,
            "spread": self.spread,
            "extent": None if self.extent is None else self.extent.tolist(),
            "channels": len(self.reference),
            "units": {"impedance": "ohm", "frequency": "Hz", "length": "m", "angle": "degree"},
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any], reference: NDArray[Any]) -> "InputSpec":
        """Restore the specification, with NaN as the reference of touches on a recorded sensor.

        Raises ConfigurationError or DataError for values that no training gives.
        """
        design, protocol = document["design"], document["protocol"]
        design = design and from_dict(SensorDesign, design, "layout.design")
        protocol = protocol and from_dict(Protocol, protocol, "layout.protocol")
        stored_frequency, extent = document["frequency"], document.get("extent")
        frequency = math.nan if stored_frequency is None else float(stored_frequency)
        spread = document.get("spread", MAX_SPREAD)
        if np.isnan(reference).all():
            extent = None if extent is None else np.array(extent, dtype=float)
            return cls(design, protocol, frequency, reference, extent=extent)
        if reference.shape != (len(protocol),) or not np.all(reference >= 0) or not reference.any():
            raise DataError(
                f"expected {len(protocol)} magnitudes of the flat sensor, got an array of shape "
                f"{reference.shape} or others than positive numbers; train the pipeline again"
            )
        if not (0 < frequency < np.inf and 0 < float(spread) <= MAX_CHANNEL_SPREAD):
            raise DataError(
                f"expected a frequency and a spread of up to {MAX_CHANNEL_SPREAD:g}, got "
                f"{frequency:g} Hz and {float(spread):g}; train the pipeline again"
            )
        return cls(design, protocol, frequency, reference.astype(float), float(spread))

    @property
    def design(self) -> SensorDesign:
        """The nominal sensor; raises ConfigurationError where none is known."""
        return _require_known(self.known_design, "sensor's design", "--sensor")

    @property
    def protocol(self) -> Protocol:
        """The table of measurements; raises ConfigurationError where none is known."""
        return _require_known(self.known_protocol, "table of measurements", "--protocol")

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the measurements; their numbers where no table is known."""
        if self.known_protocol is None:
            return tuple(str(number) for number in range(len(self.reference)))
        return self.known_protocol.labels

    @property
    def outline(self) -> tuple[float, float]:
        """Length and width of the sensor [m]."""
        return self.design.outline.length, self.design.outline.width

    @property
    def pixels(self) -> tuple[int, int]:
        """Rows and columns of maps: about `PIXELS` squares, multiples of eight for the networks."""
        length, width = self.outline
        side = (length * width / PIXELS) ** 0.5
        rows, columns = (8 * max(1, round(extent / side / 8)) for extent in (width, length))
        return rows, columns

    def voltages(self, frame: Frame) -> tuple[NDArray[np.complex128], tuple[str, ...]]:
        """Values of a frame (measurements,) [ohm], NaN where bad, and its problems in words.

        Raises:
            FrameError: for a frame of another protocol or frequency.
            UnusableFrameError: for a frame with too few good channels.
        """
        self.require_same_measurements(frame.protocol, frame.frequency)
        return usable_values(frame)

    def require_same_measurements(self, protocol: Protocol, frequency: float) -> None:
        """Refuse a protocol or frequency [Hz] other than the trained one; raises FrameError."""
        if self.known_protocol is None:
            if len(protocol) != len(self.reference):
                raise FrameError(
                    f"this pipeline was trained for {len(self.reference)} channels, got "
                    f"{len(protocol)}; train on recordings of this sensor"
                )
        else:
            self.known_protocol.require_same(
                protocol,
                "this pipeline was trained for",
                "the frames have",
                "set the board to the first, or train a pipeline for the second",
            )
        if abs(frequency / self.frequency - 1.0) > FREQUENCY_TOLERANCE:
            raise FrameError(
                f"this pipeline was trained at {self.frequency:g} Hz, the frames were measured "
                f"at {frequency:g} Hz; set the board to that frequency"
            )

    def complete_dataset(self, dataset: Dataset) -> Dataset:
        """The dataset with this design and protocol where it has none.

        Raises FrameError for other measurements.
        """
        protocol = dataset.protocol or self.known_protocol
        if protocol is not None:
            self.require_same_measurements(protocol, dataset.frequency)
        return replace(dataset, protocol=protocol, design=dataset.design or self.known_design)

    def for_sensor(self, flat: NDArray[np.float64]) -> "InputSpec":
        """Specification for one sensor of this design.

        Args:
            flat: its magnitudes, flat and untouched (measurements,) [ohm]; NaN where unknown.
        """
        require_axes("flat", flat, len(self.reference), more=False)
        valid = np.isfinite(flat) & (flat > 0)
        common = np.median(flat[valid] / self.reference[valid])
        return replace(self, reference=np.where(valid, flat, common * self.reference))

    def require_adaptable(self, voltages: NDArray[np.complex128]) -> None:
        """Alias of `require_same_sensor` with `adapting`; deprecated."""
        warn("use require_same_sensor(voltages, adapting=True)", DeprecationWarning, stacklevel=2)
        self.require_same_sensor(voltages, adapting=True)

    def require_same_sensor(self, voltages: NDArray[np.complex128], adapting: bool = False) -> None:
        """Refuse a first frame (measurements,) [ohm] of another sensor; raises FrameError.

        The median of the log ratios to the trained reference is a common factor, the gel's
        conductivity or the board's gain; `MAX_SCALE` limits it. The remainder is due to
        contacts and geometry; `spread` limits its root mean square. (A median would
        overlook two swapped electrodes, which leave most channels unchanged.) Where another order
        of the electrodes leaves far less, that is the reason.

        Args:
            voltages: voltages of the flat sensor.
            adapting: whether known frames are to make the pipeline that of this sensor, whose
                contacts may differ by up to `MAX_CHANNEL_SPREAD`.
        """
        require_axes("voltages", voltages, len(self.reference), more=False)
        limit, remedy = (
            self.spread,
            ("make the pipeline its own by known angles (eitskin calibrate, eitskin adapt)"),
        )
        if adapting:
            limit, remedy = (
                MAX_CHANNEL_SPREAD,
                (
                    "train a pipeline for it (own frames go together with simulated ones: eitskin "
                    "dataset combine)"
                ),
            )
        good_channels = np.flatnonzero(np.isfinite(voltages) & np.isfinite(self.reference))
        if not good_channels.size:
            return
        logs = np.log(np.abs(voltages[good_channels] / self.reference[good_channels]))
        spread, common = _spread(logs, _weights(self.reference)[good_channels])
        worst = self.protocol.labels[good_channels[np.abs(logs - common).argmax()]]
        if abs(common) > np.log(MAX_SCALE):
            raise FrameError(
                f"values are {np.exp(common):.3g} times those of the sensor this pipeline was "
                f"trained for (expected {1 / MAX_SCALE:g} to {MAX_SCALE:g}): another "
                "sensor, or other units than ohm; train a pipeline for it"
            )
        if spread > MAX_SPREAD and (other := self._other_order(voltages, spread)):
            raise FrameError(
                f"the channels scatter by {spread:.1%} against the sensor this pipeline was "
                f"trained for, and by {other}: they are in another order; plug them in that of the "
                "design"
            )
        if spread > limit:
            raise FrameError(
                f"the channels scatter by {spread:.1%} against the sensor this pipeline was "
                f"trained for (expected up to {limit:.1%}, after one common factor of "
                f"{np.exp(common):.3g}), most of all {worst}: another sensor, a board that loads "
                "it otherwise, a bad contact, or electrodes in another order; check the wiring, or "
                f"{remedy}"
            )

    def _other_order(self, voltages: NDArray[np.complex128], spread: float) -> str:
        """Order of the electrodes that leaves far less than `spread`, in words; empty for none."""
        weights, best, words = _weights(self.reference), EXCHANGE_SCATTER_SHARE * spread, ""
        for name, order in electrode_orders(self.protocol):
            logs = np.log(np.abs(voltages[order]) / self.reference)
            finite = np.isfinite(logs)
            if (spread_left := _spread(logs[finite], weights[finite])[0]) < best:
                best, words = spread_left, f"{spread_left:.1%} with {name}"
        return words


def _require_known(value: Known | None, words: str, option: str) -> Known:
    """A value that recordings may lack; raises ConfigurationError without."""
    if value is None:
        raise ConfigurationError(
            f"expected a pipeline that knows its {words}, got one of touch positions from a "
            f"recording without; import the recording with {option} and train again"
        )
    return value


def _weights(reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of channels (m,): smaller values than a tenth of the rms are mostly noise."""
    share = reference / (SMALL * float(np.sqrt(np.mean(reference**2))))
    weights: NDArray[np.float64] = np.minimum(share, 1.0) ** 2
    return weights


def _spread(logs: NDArray[np.float64], weights: NDArray[np.float64]) -> tuple[float, float]:
    """Weighted root mean square of log ratios (m,) about their median, and that median.

    0 without any.
    """
    if not logs.size:
        return 0.0, 0.0
    common = float(np.median(logs))
    return float(np.sqrt(np.average((logs - common) ** 2, weights=weights))), common


def usable_values(frame: Frame) -> tuple[NDArray[np.complex128], tuple[str, ...]]:
    """Values of a frame (measurements,) [ohm], NaN where bad, and its problems in words.

    Raises UnusableFrameError for a frame with too few good channels.
    """
    size = np.abs(frame.impedance)
    # Others are no readings, and their squares would overflow.
    good = (LEAST_READING <= size) & (size <= LARGEST_READING) & (frame.status == 0)
    labels = frame.protocol.labels
    problems = tuple(
        f"channel {labels[i]} is left out: "
        + (f"board status {frame.status[i]}" if frame.status[i] else f"{frame.impedance[i]}")
        for i in np.flatnonzero(~good)
    )
    require_usable(good, *problems[:1])
    return np.where(good, frame.impedance, np.nan), problems


def require_usable(good: NDArray[np.bool_], *problems: str) -> None:
    """Refuse a frame with too few good channels (measurements,); raises UnusableFrameError.

    Args:
        good: whether each channel is usable.
        problems: problems of the channels, for the message.
    """
    if good.mean() < MIN_CHANNELS:
        count = f"got {good.sum()} of {good.size}"
        raise UnusableFrameError(
            f"expected at least {MIN_CHANNELS:.0%} usable channels, "
            + "; ".join([count, *problems, "check the cable and the electrodes"])
        )
