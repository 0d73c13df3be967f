"""Twin of one sensor: its physical numbers, fitted to labelled frames, its files, and presses."""

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.config import to_toml, write_toml
from eitskin.datasets import Dataset, Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import MAX_DEVIATIONS, RANGES, Specimen, Specimens, clearance
from eitskin.datasets.store.folder import new_folder
from eitskin.extras import old_names
from eitskin.files import atomic_folder
from eitskin.geometry import Bend, Clamp, ConfigurationError, Free, Rectangle, SensorDesign, Surface
from eitskin.geometry.deformation.fixtures import Fixture
from eitskin.simulator import (
    Cylinder,
    FourTerminalMeter,
    Instrument,
    Mechanics,
    Protocol,
    Scene,
    Touch,
    fit_meter,
)
from eitskin.simulator.deformation.sensor_grid import read_fixed
from eitskin.simulator.deformation.tabled_corrections import is_tabulable
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.instrument import decibels
from eitskin.simulator.instrument.meter import Parameter
from eitskin.simulator.instrument.meter_fit import Agreement, agreement
from eitskin.training.twin.fit import Laplace, TwinProblem
from eitskin.training.twin.labelled_frames import KINDS, LabelledFrames, labelled_frames
from eitskin.training.twin.parameters import (
    TwinPrior,
    instrument_parameters,
    interpolation_centre,
    sensor_parameters,
    twin_parameter,
)

Array = NDArray[np.float64]

_UNIT_GAIN = 1e3  # factor of the gain's prior where readings are in no known unit
# standard deviation, over the prior's, from which frames do not show a number
_UNDETERMINED_RATIO = 0.9
_MIN_COMPONENT = 0.3  # least component of a parameter in a combination for it to be named
_METER_STARTS, _DRAWN, _FIRST_STEPS = 4, 2, 3
_ANGLES, _FORCES = (-20.0, 50.0), (4.0, 12.0)  # where no frames say what is of interest
_SPECIMENS, _SCENES = 50, 500
_SPREADS = {
    "conductivity": "conductivity",
    "thickness": "thickness",
    "contact_impedance": "contact_impedance",
    "electrode_place": "electrode_place",
    "gel_modulus": "gel_modulus",
    "encapsulation_modulus": "encapsulation_modulus",
    "hinge_span": "span",
    "hinge_offset": "offset",
}
_LENGTHS = ("electrode_place", "hinge_span", "hinge_offset")


@old_names(judged="evaluate", predicted="predict", undetermined="undetermined_combinations")
@dataclass(frozen=True, slots=True, eq=False)
class Twin:
    """Physical numbers behind one sensor, with standard errors.

    Attributes:
        nominal: sensor, fixture and materials that the prior is about.
        specimen: fitted sensor, fixture and materials.
        meter: fitted circuit and reading of the board.
        parameters: the fitted numbers.
        posterior: posterior of their coordinates.
        frames: labelled frames that were fitted.
        agreements: r and relative residual by kind of frame; kinds without frames are left out.

    Example:
        >>> from eitskin.training import Twin
        >>> twin = Twin.fit(design, data, terms=("sink", "idle"))  # doctest: +SKIP
    """

    nominal: Specimen
    specimen: Specimen
    meter: FourTerminalMeter
    parameters: tuple[Parameter, ...]
    posterior: Laplace
    frames: LabelledFrames
    agreements: dict[str, Agreement]
    resolution: Resolution

    @classmethod
    def fit(
        cls,
        design: SensorDesign,
        data: Dataset,
        fixture: Fixture | None = None,
        mechanics: Mechanics | None = None,
        terms: Sequence[str] = (),
        prior: TwinPrior | None = None,
        resolution: Resolution = "coarse",
        seed: int = 0,
        progress: Callable[[int], None] = lambda _: None,
    ) -> "Twin":
        """Twin that explains labelled frames of one sensor, by MAP estimate.

        Whatever is labelled is used: flat, untouched frames at least, known angles, and touches of
        known position and force or depth. Numbers that the frames do not show keep their prior.

        Args:
            design: nominal sensor, the centre of the prior.
            data: labelled frames of one specimen, in ohms or in any unit proportional to them.
            fixture: nominal fixture; the default clamp when omitted.
            mechanics: nominal materials; the reference sensor's when omitted.
            terms: terms of the meter to fit, as for `fit_meter`; an ideal one but for its gain when
                omitted.
            prior: standard deviations; as wide as what people build when omitted.
            resolution: resolution of the simulator.
            seed: seed of the starting points of the meter.
            progress: called with the number of each Gauss-Newton step.

        Raises:
            ConfigurationError: for sensors whose numbers cannot be varied on one mesh, unknown
                terms, or frames of another number of electrodes.
            DataError: without frames of the flat, untouched sensor.
        """
        nominal = interpolation_centre(
            Specimen(design, fixture or Clamp(), mechanics or Mechanics())
        )
        frames = labelled_frames(data)
        if frames.protocol.n_electrodes != len(design.electrodes):
            raise ConfigurationError(
                f"the protocol is for {frames.protocol.n_electrodes} electrodes, the design has "
                f"{len(design.electrodes)}; give the design of the sensor that was recorded"
            )
        wide = data.quantity not in ("impedance", "magnitude")
        problem = _problem(nominal, frames, terms, prior or TwinPrior(), resolution, wide)
        posterior = problem.estimate(_start(problem, terms, seed), progress=progress)
        return cls(
            nominal,
            problem.specimen(posterior.x),
            problem.meter(posterior.x),
            problem.parameters,
            posterior,
            frames,
            agreements(posterior.predicted, frames),
            resolution,
        )

    @property
    def values(self) -> Array:
        """Fitted numbers in their units, (parameters,)."""
        pairs = zip(self.parameters, self.posterior.x, strict=True)
        return np.array([each.number(float(x)) for each, x in pairs])

    @property
    def standard_errors(self) -> Array:
        """Standard errors of the numbers, linearised, (parameters,)."""
        pairs = zip(self.parameters, self.posterior.x, strict=True)
        slopes = np.array([each.slope(float(x)) for each, x in pairs])
        return np.asarray(slopes * self.narrowing)

    @property
    def narrowing(self) -> Array:
        """Standard deviation of each coordinate over that of the prior, (parameters,)."""
        return np.sqrt(np.diag(self.posterior.covariance))

    @property
    def undetermined_combinations(self) -> tuple[tuple[str, ...], ...]:
        """Numbers, and combinations of them, that the frames do not show.

        Along them the posterior is as wide as the prior.
        """
        lost = self.narrowing > _UNDETERMINED_RATIO
        single = [(str(self.parameters[k]),) for k in np.flatnonzero(lost)]
        rest = np.flatnonzero(~lost)
        widths, directions = np.linalg.eigh(self.posterior.covariance[np.ix_(rest, rest)])
        tied = [
            tuple(str(self.parameters[rest[k]]) for k in np.flatnonzero(np.abs(v) > _MIN_COMPONENT))
            for v in directions[:, widths > _UNDETERMINED_RATIO**2].T
        ]
        return (*single, *(names for names in tied if names))

    def predict(self, frames: LabelledFrames) -> Array:
        """Rows of other labelled frames as this twin has them, (rows, channels)."""
        other = TwinProblem(self.nominal, self.parameters, frames, self.resolution)
        return other.predict(self.posterior.x)

    def evaluate(self, data: Dataset) -> dict[str, Agreement]:
        """Agreement with frames that were not fitted, by kind."""
        frames = labelled_frames(data)
        return agreements(self.predict(frames), frames)


@old_names(of="from_twin")
@dataclass(frozen=True, slots=True, eq=False)
class PressedTwin:
    """Twin of one sensor whose touches are simulated, for `Pipeline.adapt`.

    Attributes:
        specimen: fitted sensor, fixture and materials.
        meter: fitted circuit and reading of the board.
        protocol: protocol of the measurements.
        resolution: resolution of the simulator.
        nominal: sensor whose mesh and factors are shared, which halves the time; None for its own.

    Example:
        >>> from eitskin.training import PressedTwin
        >>> PressedTwin.read("twin", protocol)  # doctest: +SKIP
    """

    specimen: Specimen
    meter: FourTerminalMeter
    protocol: Protocol
    resolution: Resolution = "coarse"
    nominal: SensorDesign | None = None

    @classmethod
    def from_twin(cls, twin: Twin) -> "PressedTwin":
        """Touches on a twin that was just fitted."""
        nominal = twin.nominal.design
        return cls(twin.specimen, twin.meter, twin.frames.protocol, twin.resolution, nominal)

    @classmethod
    def read(cls, folder: str | Path, protocol: Protocol) -> "PressedTwin":
        """Touches on the twin in a folder of `eitskin fit twin`, in measurements of a protocol.

        Raises ConfigurationError where a file of it is missing or damaged, or where the twin has
        another number of electrodes than the protocol.
        """
        place = Path(folder)
        design = SensorDesign.from_toml(place / "design.toml")
        fixed = read_fixed(place / "fixture.toml", place / "mechanics.toml")
        meter = Instrument.from_toml(place / "rig.toml").meter or FourTerminalMeter()
        if protocol.n_electrodes != (count := len(design.electrodes)):
            raise ConfigurationError(
                f"expected a twin with {protocol.n_electrodes} electrodes, as the pipeline has, "
                f"got {count} in {folder}; fit the twin to the same sensor"
            )
        return cls(Specimen(design, *fixed), meter, protocol)

    def inside(self, places: Array) -> NDArray[np.bool_]:
        """Whether positions (n, 2) [m] are on the sensor (n,).

        Raises ConfigurationError for a sensor whose outline is a surface.
        """
        outline = self.specimen.design.outline
        if isinstance(outline, Surface):
            raise ConfigurationError("expected a twin with a plane outline, got a surface")
        return outline.contains(places)

    def changes(self, touches: Array, angle_deg: float, radius: float) -> Array:
        """Changes of log V (n, C); see `TwinPresses.changes`. The indenter is a cylinder.

        Raises ConfigurationError for bends or touches that the twin cannot have.
        """
        simulator = self.specimen.simulator(self.nominal, self.resolution, self.protocol)
        bend, indenter = Bend(angle_deg), Cylinder(round(radius, 6))
        pressed = ((Touch(x, y, force, indenter),) for x, y, force in touches.tolist())
        scenes = [Scene(bend=bend), *(Scene(bend=bend, touches=each) for each in pressed)]
        Z = np.real(simulator.impedances(scenes))
        reading, _ = self.meter.reading(self.meter.transfer_impedance(Z, self.protocol))
        logs = np.log(np.abs(reading))
        changes: Array = logs[1:] - logs[0]
        return changes


def agreements(predicted: Array, frames: LabelledFrames) -> dict[str, Agreement]:
    """Agreement of predicted rows (n, C) with measured ones, by kind."""
    return {
        kind: agreement(predicted[own].ravel(), frames.values[own].ravel())
        for kind, own in frames.kind_masks.items()
    }


def _problem(
    nominal: Specimen,
    frames: LabelledFrames,
    terms: Sequence[str],
    prior: TwinPrior,
    resolution: Resolution,
    wide: bool,
) -> TwinProblem:
    """Problem with all parameters; the gain is centred where the flat frame says."""
    sensor = sensor_parameters(nominal, prior)
    parameters = (*sensor, twin_parameter("gain", 1.0, prior.gain))
    alone = TwinProblem(nominal, parameters, frames.only_flat(), resolution)
    x = np.zeros(len(parameters))
    gain = 1.0
    if wide:
        nominally, flat = alone.readings(x)[0], frames.values[0]
        gain = float(nominally @ flat / (nominally @ nominally)) or 1.0
    typical = float(np.median(np.abs(np.diag(alone.impedances(x)[0]))))
    meter = instrument_parameters(terms, frames.protocol.n_electrodes, prior, typical)
    spread = _UNIT_GAIN if wide else prior.gain
    parameters = (*sensor, twin_parameter("gain", gain, spread), *meter)
    return TwinProblem(nominal, parameters, frames, resolution)


def _start(problem: TwinProblem, terms: Sequence[str], seed: int) -> Array:
    """Start of the fit: the best fit to the flat frame alone, which takes little time.

    It starts from the prior's middle and, where terms of the meter are fitted, also from the meter
    that suits the nominal sensor, and from meters of chance.
    """
    flat = problem.for_frames(problem.frames.only_flat())
    x, meter, frames = np.zeros(len(problem.parameters)), problem.terms, flat.frames
    starts = [x]
    if len(meter) and len(meter) + 2 < len(frames.protocol):
        Z, values = flat.impedances(x)[0], frames.values
        fit = fit_meter(Z, frames.protocol, values, terms, frames.reads, seed, starts=_METER_STARTS)
        own = x.copy()
        for k, value in zip(meter, fit.values, strict=True):
            own[k] = problem.parameters[k].coordinate(float(value))
        starts.append(own)
    rng = np.random.default_rng(seed)
    for _ in range(_DRAWN * bool(len(meter))):
        drawn = x.copy()
        drawn[meter] = np.abs(rng.standard_normal(len(meter)))
        starts.append(drawn)
    fits = [flat.estimate(start, _FIRST_STEPS) for start in starts]
    best = max(fits, key=lambda each: each.log_evidence)
    return flat.estimate(best.x).x


def write_twin(twin: Twin, folder: Path) -> None:
    """Write a twin into a new folder, whole or not at all.

    `design.toml`, `fixture.toml`, `mechanics.toml`, `rig.toml` (the instrument) and `recipe.toml`
    are read by the other commands; `twin.json` has all numbers, `residuals.csv` what is left of
    each channel.

    Raises ConfigurationError where the folder has files, or cannot be written.
    """
    new_folder(folder)
    with atomic_folder(folder) as made:
        twin.specimen.design.to_toml(made / "design.toml")
        write_toml(twin.specimen.fixture, made / "fixture.toml")
        materials = f"{to_toml(twin.specimen.mechanics)}\n[grid]\n{to_toml(twin.specimen.grid)}"
        (made / "mechanics.toml").write_text(materials, encoding="utf-8")
        rig(twin).to_toml(made / "rig.toml")
        (made / "recipe.toml").write_text(recipe(twin).to_toml(), encoding="utf-8")
        (made / "twin.json").write_text(json.dumps(as_plain(twin), indent=1), encoding="utf-8")
        _write_residuals(twin, made / "residuals.csv")


def rig(twin: Twin) -> Instrument:
    """Instrument of a twin: its meter, and the noise of its flat frames."""
    full_scale = float(np.abs(twin.frames.values[0]).max())
    return Instrument(snr_db=decibels(full_scale, twin.frames.noise), meter=twin.meter)


def recipe(twin: Twin) -> Recipe:
    """Recipe of sensors about a twin, which differ by its posterior's standard deviations."""
    design, fixture = twin.specimen.design, twin.specimen.fixture
    shown = [twin.frames.scenes[k] for k in twin.frames.shown]
    scenes = [SceneGroup("idle", count=_SCENES)]
    bends = isinstance(design.outline, Rectangle) or not isinstance(fixture, Clamp)
    if bends and not isinstance(design.support, Free):
        angles = [scene.bend.angle_deg for scene in shown if scene.bend.angle_deg]
        span = (min(*angles, 0.0), max(*angles, 0.0)) if len(angles) > 1 else _ANGLES
        scenes.append(SceneGroup("bend", count=_SCENES, angle_deg=span))
    if is_tabulable(design):
        forces = [t.force for scene in shown for t in scene.touches if t.depth is None]
        push = (min(forces), max(forces)) if len(forces) > 1 else _FORCES
        scenes.append(SceneGroup("touch", count=_SCENES, force=push))
    return Recipe(
        name="twin",
        description="Sensors about a twin, as far apart as its standard errors.",
        scenes=tuple(scenes),
        resolution=twin.resolution,
        sensor=design,
        protocol=twin.frames.protocol,
        fixture=fixture,
        mechanics=twin.specimen.mechanics,
        grid=twin.specimen.grid,
        instrument=rig(twin),
        specimens=spread(twin),
    )


def spread(twin: Twin) -> Specimens:
    """Posterior standard deviations as those of specimens, at most what recipes allow."""
    spread_table: dict[str, Any] = {"count": _SPECIMENS}
    kinds = [parameter.name for parameter in twin.parameters]
    kinds = kinds[: kinds.index("gain")]  # the meter has an offset, too
    for name, kind in _SPREADS.items():
        own = [k for k, each in enumerate(kinds) if each == kind]
        if not own:
            continue
        errors = twin.standard_errors[own]
        relative = errors if name in _LENGTHS else errors / np.abs(twin.values[own])
        spread_table[name] = min(float(np.sqrt(np.mean(relative**2))), RANGES[name][0])
    if "hinge_span" in spread_table:
        span = float(twin.values[kinds.index("span")])
        spread_table["hinge_span"] = min(spread_table["hinge_span"], 0.99 * span / MAX_DEVIATIONS)
    if "electrode_place" in spread_table:
        room = max(clearance(twin.specimen.design)[0], 0.0) / MAX_DEVIATIONS
        spread_table["electrode_place"] = min(spread_table["electrode_place"], room)
    return Specimens(**spread_table)


def as_plain(twin: Twin) -> dict[str, Any]:
    """Every number of a twin for JSON: SI units, percentages of the flat frame's mean square."""
    frames = twin.frames
    level = float(np.sqrt(np.mean(frames.values[0] ** 2)))
    lost = {names[0] for names in twin.undetermined_combinations if len(names) == 1}
    return {
        "frames": frames.frames,
        "left_out": frames.left_out,
        "scenes": {kind: int(np.sum(frames.kind == k)) for k, kind in enumerate(KINDS)},
        "parameters": [
            {
                "name": str(parameter),
                "unit": parameter.unit,
                "value": float(value),
                "standard_error": float(error),
                "prior": parameter.number(0.0),
                "prior_standard_error": abs(parameter.slope(0.0)),
                "narrowing": float(narrow),
                "determined": str(parameter) not in lost,
            }
            for parameter, value, error, narrow in zip(
                twin.parameters, twin.values, twin.standard_errors, twin.narrowing, strict=True
            )
        ],
        "not_identifiable": [list(names) for names in twin.undetermined_combinations],
        "agreement": {kind: asdict(each) for kind, each in twin.agreements.items()},
        "left_percent": {
            kind: 100.0 * float(error) / level
            for kind, error in zip(KINDS, twin.posterior.error, strict=True)
            if kind in twin.agreements
        },
        "noise_percent": 100.0 * frames.noise / level,
        "log_evidence": twin.posterior.log_evidence,
    }


def channel_residuals(twin: Twin) -> list[tuple[str, float, float, dict[str, float]]]:
    """Each channel's name, measured and predicted flat reading, and residuals.

    Residuals by kind are root mean squares over its frames, in per cent of the measured flat
    reading.
    """
    frames = twin.frames
    flat, left = frames.values[0], twin.posterior.predicted - frames.values
    sizes = {
        kind: 100.0 * np.sqrt(np.mean(left[own] ** 2, axis=0)) / np.maximum(np.abs(flat), 1e-300)
        for kind, own in frames.kind_masks.items()
    }
    predicted = twin.posterior.predicted[0].tolist()
    rows = zip(frames.protocol.labels, flat.tolist(), predicted, strict=True)
    return [
        (*row, {kind: float(size[k]) for kind, size in sizes.items()}) for k, row in enumerate(rows)
    ]


def _write_residuals(twin: Twin, path: Path) -> None:
    kinds = list(twin.agreements)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        header = ["channel", "flat", "flat of the twin", *(f"{kind} residual, %" for kind in kinds)]
        writer.writerow(header)
        for name, measured, predicted, residual in channel_residuals(twin):
            cells = [f"{residual[kind]:.4g}" for kind in kinds]
            writer.writerow([name, f"{measured:.6g}", f"{predicted:.6g}", *cells])
