"""Files of a twin: design, fixture, materials, instrument, a recipe about it, residuals."""

import csv
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.config import to_toml, write_toml
from eitskin.datasets import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import MAX_DEVIATIONS, RANGES, Specimens, clearance
from eitskin.datasets.store.folder import new_folder
from eitskin.files import atomic_folder
from eitskin.geometry import Clamp, Free, Rectangle
from eitskin.simulator import Instrument
from eitskin.simulator.deformation.corrections import is_tabulable
from eitskin.simulator.instrument.instrument import decibels
from eitskin.training.twin.labelled_frames import KINDS
from eitskin.training.twin.twin import Twin

Array = NDArray[np.float64]

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
