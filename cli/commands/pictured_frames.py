"""Frames that `eitskin reconstruct` pictures: of a scene, a dataset, or a board."""

import dataclasses
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from eitskin.cli.commands.simulate import announce_unsolved
from eitskin.cli.options import Output, SensorOptions, opened_board
from eitskin.errors import ConfigurationError, DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.frame import Frame
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.protocol import Protocol
    from eitskin.training.evaluation.drawing import Circle

MOST_PICTURES = 24
SCHEMES = ("serial:", "text:", "virtual:", "replay:")


class PicturedFrame(NamedTuple):
    """Frame to reconstruct.

    Attributes:
        name: of the frame.
        impedance, reference: of the frame and before it (measurements,) [ohm]; NaN where bad.
        circles: true touches, where known.
    """

    name: str
    impedance: "NDArray[Any]"
    reference: "NDArray[Any]"
    circles: "tuple[Circle, ...]" = ()


class PicturedFrames(NamedTuple):
    """Frames to reconstruct, of one sensor and protocol."""

    design: "SensorDesign"
    protocol: "Protocol"
    frames: list[PicturedFrame]


def pictured_frames(
    source: str,
    sensor: Path | None,
    protocol: str | None,
    frames: str | None,
    reference: str,
    average: int,
    resolution: Any,
    seed: int,
    output: Output,
) -> PicturedFrames:
    """Frames of a scene, a board, or a dataset."""
    from eitskin.geometry.design.sensor import SensorDesign

    design = SensorDesign.from_toml(sensor) if sensor else None
    if source.startswith(SCHEMES):
        return _from_board(source, design, protocol, frames, average, seed, output)
    if Path(source).suffix == ".toml":
        return _from_scene(Path(source), design, protocol, reference, resolution, output)
    if Path(source).suffix == ".eitmodel":
        raise ConfigurationError(
            "pictures are of the frames of a dataset, a scene (.toml) or a board, and need no "
            f"trained pipeline of any kind, got the pipeline {source}"
        )
    return _from_dataset(Path(source), design, protocol, frames, reference)


def _from_scene(
    path: Path,
    design: "SensorDesign | None",
    protocol: str | None,
    reference: str,
    resolution: Any,
    output: Output,
) -> PicturedFrames:
    """Frame of a scene, against the same scene without its touches or against the flat sensor."""
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.simulator.scene.scene import Scene

    if reference not in ("untouched", "flat"):
        raise ConfigurationError(
            f"expected --reference untouched or flat for a scene, got '{reference}'"
        )
    scene, design = Scene.from_toml(path), design or SensorDesign.reference()
    sim = SensorOptions(protocol=protocol or "pairwise").simulator(resolution, design)
    sim.check_scene(scene)
    announce_unsolved(sim, scene, output)
    before = Scene() if reference == "flat" else dataclasses.replace(scene, touches=())
    circles = tuple((each.x, each.y, each.indenter.rims[1]) for each in scene.touches)
    measured, reference_values = (sim.measure(each).impedance for each in (scene, before))
    frame = PicturedFrame(path.stem, measured, reference_values, circles)
    return PicturedFrames(design, sim.protocol, [frame])


def _from_dataset(
    path: Path,
    design: "SensorDesign | None",
    protocol: str | None,
    frames: str | None,
    reference: str,
) -> PicturedFrames:
    """Chosen frames of a dataset; the first touched one where none is chosen."""
    import numpy as np

    from eitskin.datasets.store.folder import open_dataset
    from eitskin.protocol import Protocol

    data = open_dataset(path)
    design = design or data.design
    if design is None:
        raise DataError(
            f"expected a dataset that knows its sensor, got {path} without one; name the design "
            "with --sensor DESIGN.toml"
        )
    given = Protocol.named(protocol, len(design.electrodes)) if protocol else None
    pairs = given or data.protocol
    if pairs is None:
        raise DataError(
            f"expected a dataset that knows its protocol, got {path} without one; name it with "
            "--protocol, such as adjacent"
        )
    if given is not None and data.protocol is not None:
        given.require_same(
            data.protocol, "--protocol names", "the dataset has", "leave --protocol out"
        )
    touched = np.flatnonzero(data.touch_count > 0)
    chosen = numbers(frames, len(data)) if frames else [int(touched[0]) if touched.size else 0]
    taken = PicturedFrames(design, pairs, [])
    flat = data.reference[data.specimen]
    references = {"flat": flat, "untouched": data.untouched}
    if reference not in references:
        number = numbers(reference, len(data))[0]
        references[reference] = np.broadcast_to(data.impedance[number], flat.shape)
    bad = data.status != 0
    for k in chosen:
        circles = tuple(
            (
                float(x),
                float(y),
                float(radius) if np.isfinite(radius) else 0.02 * _shorter_side(design),
            )
            for x, y, radius in zip(
                data.touch_x[k], data.touch_y[k], data.touch_radius[k], strict=True
            )
            if np.isfinite(x)
        )
        frame = np.where(bad[k], np.nan, data.impedance[k])
        before = references[reference][k]
        taken.frames.append(PicturedFrame(f"frame {k}", frame, before, circles))
    return taken


def _from_board(
    uri: str,
    design: "SensorDesign | None",
    protocol: str | None,
    frames: str | None,
    average: int,
    seed: int,
    output: Output,
) -> PicturedFrames:
    """Frames of a board after the frames of its reference."""
    import numpy as np

    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.protocol import Protocol

    design = design or SensorDesign.reference()
    count = int(frames) if frames and frames.isdigit() else 1
    if frames and not 1 <= count <= MOST_PICTURES:
        raise ConfigurationError(
            f"expected --frames of a board from 1 to {MOST_PICTURES}, got '{frames}'"
        )
    with opened_board(uri, seed) as board:
        if protocol:
            Protocol.named(protocol, len(design.electrodes)).require_same(
                board.protocol, "--protocol names", "the board measures", "leave --protocol out"
            )
        output.note(f"{average} frames for the reference; keep the sensor untouched")
        arriving = board.frames()
        first = np.array([_good(frame) for frame in islice(arriving, average)])
        output.note(f"{count} frame{'s' * (count > 1)} to picture; touch the sensor")
        before = np.nanmean(first, axis=0) if len(first) else first
        chosen = [
            PicturedFrame(f"frame {frame.number}", _good(frame), before)
            for frame in islice(arriving, count)
        ]
    if not chosen:
        raise DataError(
            f"expected frames after the {average} of the reference, got none; take fewer with "
            "--average"
        )
    return PicturedFrames(design, board.protocol, chosen)


def _good(frame: "Frame") -> "NDArray[np.complex128]":
    """Values of a frame [ohm], NaN where bad."""
    import numpy as np

    return np.where(frame.status == 0, frame.impedance, np.nan)


def _shorter_side(design: "SensorDesign") -> float:
    """Shorter side of the outline's bounding box [m]."""
    return min(design.outline.length, design.outline.width)


def numbers(text: str, count: int) -> list[int]:
    """Frame numbers of a text such as 0,5,10-12.

    Raises ConfigurationError for other text, and numbers that are not among `count` frames.
    """
    try:
        parts = [[int(end) for end in part.split("-")] for part in text.split(",")]
        found = [k for part in parts for k in range(part[0], part[-1] + 1)]
    except ValueError as error:
        raise ConfigurationError(f"expected frames as 0,5,10-12, got '{text}'") from error
    if not found or min(found) < 0 or max(found) >= count or len(found) > MOST_PICTURES:
        raise ConfigurationError(
            f"expected up to {MOST_PICTURES} frames from 0 to {count - 1}, got '{text}'"
        )
    return found
