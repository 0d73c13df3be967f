"""Calls of public functions with good arguments, for extremes to be put into."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from eitskin.benchmarks.studies.hostile.boards import good_frame, shipped_pipeline
from eitskin.datasets import Dataset, Recipe, touch_maps
from eitskin.geometry import (
    Bend,
    Clamp,
    Disc,
    Electrode,
    FreeArc,
    Hinge,
    Layer,
    Plates,
    Polygon,
    Rectangle,
    Roll,
    SensorDesign,
    Substrate,
    Twist,
)
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.hardware import check_readings, check_sensor, open_virtual
from eitskin.simulator import (
    Cylinder,
    ForwardModel,
    FourTerminalMeter,
    Instrument,
    Mechanics,
    Profile,
    Protocol,
    Scene,
    Simulator,
    Sphere,
    Touch,
)
from eitskin.training import (
    FrameLabel,
    NetworkSettings,
    PixelGrid,
    Reconstructor,
    Regularisation,
    StoredReference,
    TouchLabel,
    TrainingSettings,
    TwinPrior,
    Zero,
    figures_of_merit,
)

Call = Callable[[Mapping[str, Any]], object]


@functools.lru_cache
def cases() -> Mapping[str, tuple[Mapping[str, Any], Call]]:
    """Good arguments and the call, by name."""
    return {**_of_geometry(), **_of_simulator(), **_of_datasets(), **_of_training(), **_of_boards()}


@functools.lru_cache
def _reference() -> Simulator:
    return Simulator(SensorDesign.reference(), resolution="coarse")


@functools.lru_cache
def _bent_by(fixture: Any) -> Simulator:
    return Simulator(SensorDesign.reference(), resolution="coarse", fixture=fixture)


def _measured(design: SensorDesign) -> object:
    return Simulator(design, resolution="coarse").measure(Scene()).impedance


def _of_geometry() -> dict[str, tuple[Mapping[str, Any], Call]]:
    side = uniform(Disc(0.05), 4)
    layered = dataclasses.replace(
        SensorDesign.reference(), layers=(Layer(0.002, 1.0), Layer(0.003, 2.0))
    )
    around = ((0.0, 0.0), (0.1, 0.0), (0.1, 0.06), (0.0, 0.06))
    corner = SensorDesign(Polygon(around), 0.005, uniform(Polygon(around), 4))
    return {
        "design": ({"design": SensorDesign.reference()}, lambda a: _measured(a["design"])),
        "round design": (
            {"design": SensorDesign(Disc(0.05), 0.005, side)},
            lambda a: _measured(a["design"]),
        ),
        "polygon": ({"design": corner}, lambda a: _measured(a["design"])),
        "layers": ({"design": layered}, lambda a: _measured(a["design"])),
        "layout": (
            {"count": 8, "start": 0.02, "width": 0.004, "height": 0.003},
            lambda a: [e.x for e in uniform(Rectangle(0.1, 0.06), **a)],
        ),
        "grid": (
            {"rows": 2, "columns": 3, "size": 0.004},
            lambda a: [e.x for e in grid(Rectangle(0.1, 0.06), **a)],
        ),
        "electrode": (
            {"electrode": Electrode(0.02, 0.0, 0.004, 1e-3 + 1e-4j, 0.003, 0.0025)},
            lambda a: a["electrode"].footprint() if a["electrode"].on != "side" else 0.0,
        ),
        "conductivity at points": (
            {"points": np.full((4, 3), 0.003)},
            lambda a: layered.conductivity_at(np.nan_to_num(a["points"])),
        ),
        "edges": ({"spacing": 0.001}, lambda a: len(SensorDesign.reference().edges(**a))),
        "supports": (
            {"supports": (Substrate(0.01, 1e5), Plates(0.04))},
            lambda a: None,  # noqa: ARG005 - checked when they are made
        ),
    }


def _of_simulator() -> dict[str, tuple[Mapping[str, Any], Call]]:
    pressed = Scene(Bend(10.0), (Touch(0.05, 0.03, 2.0), Touch(0.1, 0.02, 1.0)))
    turned = Scene(roll=Roll(20.0))
    values = np.linspace(400.0, 700.0, 64).reshape(8, 8)
    matrix = values + values.T
    pairs = Protocol.pairwise(8)
    meter = FourTerminalMeter(1e-5, 1e-5, 1e-5, 1e-5, 1e-6, (1e-7,) * 8, (1.0,) * 8, 1e-4)
    return {
        "scene": (
            {"scene": pressed},
            lambda a: _bent_by(Hinge()).measure(a["scene"]).impedance,
        ),
        "roll": ({"scene": turned}, lambda a: _bent_by(Hinge()).measure(a["scene"]).impedance),
        "twist": (
            {"scene": Scene(twist=Twist(10.0))},
            lambda a: _bent_by(Hinge()).measure(a["scene"]).impedance,
        ),
        "depth": (
            {"scene": Scene(touches=(Touch(0.05, 0.03, depth=5e-4),))},
            lambda a: _reference().measure(a["scene"]).impedance,
        ),
        "hinge": (
            {"fixture": Hinge(0.04, 0.008, 0.001, 0.01, 0.1)},
            lambda a: _bent_by(a["fixture"]).measure(Scene(Bend(10.0))).impedance,
        ),
        "free arc": (
            {"fixture": FreeArc(0.1, 0.01, 0.1)},
            lambda a: _bent_by(a["fixture"]).measure(Scene(Bend(10.0))).impedance,
        ),
        "clamp": ({"fixture": Clamp(0.04, 0.008, 0.1, "both", 0.04, 0.008)}, lambda a: None),  # noqa: ARG005
        "indenters": (
            {"all": (Sphere(0.005), Cylinder(0.005, 0.1))},
            lambda a: [each.profile(np.linspace(0.0, 1e-3, 5)) for each in a["all"]],
        ),
        "profile": (
            {"each": Profile((0.0, 0.002, 0.004), (0.0, 1e-3, 3e-3))},
            lambda a: a["each"].profile(np.linspace(0.0, 1e-3, 5)),
        ),
        "mechanics": (
            {"each": dataclasses.replace(Mechanics(), solved_thickness=0.005, solved_ratio=1.4)},
            lambda a: [s.thickness for s in a["each"].stack(SensorDesign.reference()).sheets],
        ),
        "instrument": ({"board": Instrument.ad5940()}, lambda a: _read_by(a["board"], matrix)),
        "matrix of an instrument": (
            {"matrix": matrix},
            lambda a: _bad_matrix(Instrument.ad5940(), a["matrix"], pairs),
        ),
        "meter": ({"meter": meter}, lambda a: a["meter"].transfer_impedance(matrix, pairs)),
        "protocol": ({"n_electrodes": 8, "skip": 2}, lambda a: len(Protocol.skip(**a))),
        "pairs": ({"n_electrodes": 8}, lambda a: len(Protocol.pairwise(**a))),
        "table": (
            {"table": ((0, 1, 2, 3), (1, 2, 3, 4)), "n_electrodes": 8},
            lambda a: len(Protocol(**a)),
        ),
        "conductivity": (
            {"conductivity": np.full(len(_model().mesh.cells), 0.4)},
            lambda a: _model().impedance(a["conductivity"]),
        ),
        "one conductivity": (
            {"conductivity": 0.4},
            lambda a: _model().impedance(a["conductivity"]),
        ),
        "tolerance": (
            {"tolerance": 3e-5},
            lambda a: _bent_by(Hinge()).measure_all([Scene(), Scene(Bend(5.0))], **a),
        ),
        "breaks": (
            {"breaks": (0.05, 0.1)},
            lambda a: ForwardModel(SensorDesign.reference(), "coarse", a["breaks"]).impedance(1.0),
        ),
    }


@functools.lru_cache
def _model() -> ForwardModel:
    return ForwardModel(SensorDesign.reference(), "coarse")


def _read_by(board: Instrument, matrix: Any) -> object:
    pairs = Protocol.pairwise(8)
    made = board.session(pairs, 800.0, np.random.default_rng(0))
    ideal = board.terminal_impedances(matrix, pairs)
    return made.measure(ideal[None], np.zeros(1), np.random.default_rng(1))[0]


def _bad_matrix(board: Instrument, matrix: Any, protocol: Protocol) -> None:
    """A matrix is the caller's: what is not finite in it may stay so."""
    board.transfer_impedance(matrix, protocol)


def _of_datasets() -> dict[str, tuple[Mapping[str, Any], Call]]:
    touch = np.full((6, 4), 0.03)
    arrays = {
        "impedance": np.full((6, 28), 500.0 + 1j),
        "flat_reference": np.full((1, 28), 500.0),
        "touch_x": touch,
        "touch_y": touch,
        "touch_force": touch,
        "bend_angle_deg": np.full(6, 5.0),
        "frequency": 40e3,
    }
    maps = {"x": touch, "y": touch, "radius": touch, "outline": (0.15, 0.06), "shape": (8, 20)}
    recipe = Recipe.shipped("quick_test")
    return {
        "dataset": (arrays, _made_dataset),
        "touch maps": (maps, lambda a: touch_maps(**a)),
        "recipe": ({"recipe": recipe}, lambda a: len(a["recipe"].to_toml())),
    }


def _made_dataset(arguments: Mapping[str, Any]) -> None:
    """Values and touches that are not known are NaN in a dataset."""
    first, second, *others = arguments
    keywords = {name: arguments[name] for name in others}
    Dataset.from_arrays(
        arguments[first], arguments[second], protocol=Protocol.pairwise(8), **keywords
    )


def _of_training() -> dict[str, tuple[Mapping[str, Any], Call]]:
    frames, angles = _known_frames()
    values = np.stack([frame.impedance for frame in frames])
    plane = PixelGrid.of(Rectangle(0.15, 0.06), 100)
    labels = tuple(FrameLabel(angle) for angle in angles)
    touch = FrameLabel(0.0, (TouchLabel(0.05, 0.03, 2.0),))
    return {
        "calibration": (
            {"angles": np.array(angles)},
            lambda a: list(shipped_pipeline().calibrate(frames, a["angles"]).as_dict().values()),
        ),
        "labels": ({"labels": (*labels[:-1], touch)}, lambda a: _adapted(frames, a["labels"])),
        "taring": ({"values": values[:2]}, lambda a: _tared(a["values"])),
        "frames of a calibration": (
            {"values": values},
            lambda a: _calibrated(a["values"], angles),
        ),
        "stored reference": ({"values": values[:2], "still": 1e-3}, _stored),
        "grid of pixels": (
            {"pixels": 100},
            lambda a: len(PixelGrid.of(Rectangle(0.15, 0.06), **a)),
        ),
        "discs": (
            {"centres": np.full((2, 2), 0.03), "radius": 0.01},
            lambda a: plane.discs(**a),
        ),
        "pictures": ({"impedance": values[1]}, _picture),
        "regularisation": (
            {"regularisation": Regularisation("lambda", 1e-2)},
            lambda a: _picture({"impedance": values[1], **a}),
        ),
        "figures of merit": (
            {"values": np.ones(len(plane)), "centre": (0.07, 0.03), "integral": 1e-4},
            lambda a: dataclasses.astuple(figures_of_merit(grid=plane, **a)),
        ),
        "prior of a twin": ({"prior": TwinPrior()}, lambda a: dataclasses.astuple(a["prior"])),
        "settings": ({"settings": TrainingSettings.preset("joint")}, lambda a: None),  # noqa: ARG005
        "network": ({"settings": NetworkSettings(1e-3, 10, 32)}, lambda a: None),  # noqa: ARG005
        "epochs": ({"epochs": 5}, lambda a: len(str(TrainingSettings().with_epochs(**a)))),
    }


@functools.lru_cache
def _known_frames() -> tuple[tuple[Any, ...], tuple[float, ...]]:
    """Frames of a sensor at known angles, and these [deg]."""
    pipeline, rng = shipped_pipeline(), np.random.default_rng(0)
    flat = good_frame(pipeline, rng, 0)
    angles = (0.0, 0.0, 10.0, 20.0, 30.0, 40.0)
    slope = 0.002 * np.sin(np.arange(len(flat.impedance)))
    frames = [
        dataclasses.replace(flat, impedance=flat.impedance * (1 + slope * angle), number=number)
        for number, angle in enumerate(angles)
    ]
    return tuple(frames), angles


def _adapted(frames: Any, labels: Any) -> None:
    shipped_pipeline().adapt(frames, labels)


def _with_values(values: Any) -> list[Any]:
    frames, _ = _known_frames()
    return [
        dataclasses.replace(frame, impedance=own)
        for frame, own in zip(frames, values, strict=False)
    ]


def _calibrated(values: Any, angles: Any) -> object:
    return list(shipped_pipeline().calibrate(_with_values(values), angles).as_dict().values())


def _tared(values: Any) -> None:
    try:
        shipped_pipeline().tare(_with_values(values))
    finally:
        shipped_pipeline().use(None)


def _stored(arguments: Mapping[str, Any]) -> object:
    made = StoredReference.of(
        list(arguments["values"]), Protocol.pairwise(8), 40e3, Zero.FLAT, arguments["still"]
    )
    return [made.noise or 0.0]


def _picture(arguments: Mapping[str, Any]) -> object:
    frames, _ = _known_frames()
    made = _reconstructor(arguments.get("regularisation"))
    image = made.image(dataclasses.replace(frames[1], impedance=arguments["impedance"]), frames[0])
    return image[made.grid.inside]


@functools.lru_cache(maxsize=64)
def _reconstructor(regularisation: Regularisation | None) -> Reconstructor:
    return Reconstructor(
        SensorDesign.reference(),
        method="tikhonov",
        regularisation=regularisation,
        pixels=100,
        resolution="coarse",
    )


def _of_boards() -> dict[str, tuple[Mapping[str, Any], Call]]:
    frames, _ = _known_frames()
    return {
        "virtual board": ({"period": 0.3}, _one_frame),
        "readings": (
            {"impedance": frames[0].impedance[None]},
            lambda a: str(check_readings(a["impedance"], frames[0].protocol)),
        ),
        "check of a sensor": (
            {"values": np.stack([frame.impedance for frame in frames[:3]])},
            lambda a: str(check_sensor(_with_values(a["values"]), np.abs(frames[0].impedance))),
        ),
        "expected readings": (
            {"expected": np.abs(frames[0].impedance)},
            lambda a: str(check_sensor(list(frames[:3]), a["expected"])),
        ),
    }


def _one_frame(arguments: Mapping[str, Any]) -> object:
    with open_virtual(simulator=_reference(), speed="max", **arguments) as board:
        return next(board.frames()).impedance
