"""Frames that commands read: of a recording, and those to picture, of a scene or a board too."""

import dataclasses
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from eitskin import datasets, geometry, simulator
from eitskin.cli import options
from eitskin.cli.commands.simulate import announce_unsolved
from eitskin.errors import ConfigurationError, DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.evaluation.drawing import Circle

Recorded = Annotated[
    Path,
    typer.Argument(help="Recording: a dataset's folder or shard, or a file as `import` reads it."),
]
Values = Annotated[
    str | None,
    typer.Option(help="Variable (CSV: beginning of columns) with the values, in another file."),
]
OneSpecimen = Annotated[
    int | None, typer.Option("--specimen", min=0, help="Number of the specimen in the dataset.")
]


def read_recorded(
    path: Path, values: str | None, protocol: str | None, *, marks_lost: bool = False
) -> "datasets.Dataset":
    """Dataset of a recording.

    Args:
        path: folder or shard of a dataset, or a recording of another format.
        values: name of the values in such a recording.
        protocol: text of the option --protocol; None for the dataset's own.
        marks_lost: whether values that are lost in such a recording are marked, not refused.

    Raises:
        ConfigurationError: for names or protocols that do not fit, or an unknown kind of file.
        DataError: where the recording cannot be used.
        FrameError: for another protocol than the dataset's.
    """
    named = simulator.Protocol.from_name(protocol) if protocol else None
    if not path.exists():
        raise DataError(f"there is no dataset and no file {path}; check the path")
    if not (path.is_dir() or path.suffix.lower() in (".h5", ".hdf5")):
        form = datasets.RecordingForm(bad_values="mark" if marks_lost else "refuse")
        return datasets.read_recording(path, datasets.RecordingNames(values), named, form=form)
    if values is not None:
        raise ConfigurationError(
            f"--values names a variable of a file that is no dataset, got {path}; leave it out"
        )
    data = datasets.open_dataset(path)
    if named is not None and data.protocol is None:
        return dataclasses.replace(data, protocol=named)
    if named is not None and data.protocol is not None:
        sides = "the recording is of", "--protocol names"
        data.protocol.require_same(named, *sides, "leave --protocol out")
    return data


def select_one_sensor(data: "datasets.Dataset", specimen: int | None) -> "datasets.Dataset":
    """Frames of the one specimen, or of that which is chosen; raises ConfigurationError."""
    if specimen is None:
        if (count := len(set(data.specimen.tolist()))) > 1:
            raise ConfigurationError(
                f"expected frames of one sensor, got {count} specimens; choose one by --specimen"
            )
        return data.own_specimens()
    own = data.specimen_number[data.specimen] == specimen
    if not own.any():
        raise ConfigurationError(
            f"--specimen {specimen} has no frames; the dataset has specimens "
            f"{', '.join(map(str, data.specimen_number[:8]))}"
        )
    return data.select(own).own_specimens()


def required_protocol(data: "datasets.Dataset") -> "simulator.Protocol":
    """Protocol of a recording; raises ConfigurationError where it has none."""
    if data.protocol is None:
        raise ConfigurationError(
            "the recording does not say which electrodes its channels drive and sense; give "
            "--protocol"
        )
    return data.protocol


class PicturedFrames(NamedTuple):
    """Frames to reconstruct, of one sensor and protocol.

    Attributes:
        design, protocol: sensor and measurements.
        names: name of each frame.
        impedance, reference: values of the frames and before them (frames, measurements) [ohm]; NaN
            where bad.
        circles: true touches of each frame, where known.
        still: frames of the untouched sensor one after another (n, measurements) [ohm], whose
            differences are noise; none where unknown.
    """

    design: "geometry.SensorDesign"
    protocol: "simulator.Protocol"
    names: list[str]
    impedance: "NDArray[Any]"
    reference: "NDArray[Any]"
    circles: "list[tuple[Circle, ...]]"
    still: "NDArray[Any]"


@dataclass(frozen=True)
class FrameOptions:
    """Options of the frames that are pictured: of a scene, a dataset, or a board."""

    sensor: options.SensorFile = None
    protocol: options.MeasuredPairs = None
    frames: Annotated[
        str | None,
        typer.Option("--frames", help="Frames of a dataset, as 0,5,10-12, or number for a board."),
    ] = None
    reference: Annotated[
        str,
        typer.Option(
            help="Reference of a dataset's frames: untouched, flat, the mean of frames 0-9, or of "
            "another recording, by its path."
        ),
    ] = "untouched"
    order: Annotated[
        Literal["given", "rotated", "reversed", "sense-first"] | None,
        typer.Option(
            help="Order of readings; tested by reciprocity and sums around loops if omitted."
        ),
    ] = None
    average: Annotated[
        int,
        typer.Option(min=1, help="Number of first, untouched frames that are the reference."),
    ] = 16

    def read(
        self, source: str, resolution: "Resolution", seed: int, output: options.Output
    ) -> PicturedFrames:
        """Frames of a scene, a board, or a dataset, whose order is tested by reciprocity."""
        import numpy as np

        from eitskin.datasets.recordings.protocols import in_order, require_order
        from eitskin.hardware.opening import is_board

        if source.endswith(".eitmodel"):
            raise ConfigurationError(
                "pictures are of the frames of a dataset, a scene (.toml) or a board, and need no "
                f"trained pipeline of any kind, got the pipeline {source}"
            )
        if source.endswith(".toml"):
            return self._from_scene(Path(source), resolution, output)
        if is_board(source):
            frames = self._from_board(source, seed, output)
        else:
            frames = self._from_dataset(Path(source), output)
        if not self.order:
            require_order(frames.protocol, np.nan_to_num(frames.reference).mean(axis=0))
        return frames._replace(protocol=in_order(frames.protocol, self.order or "given"))

    def require_protocol(
        self, design: "geometry.SensorDesign", known: "simulator.Protocol", whose: str
    ) -> None:
        """Refuse a --protocol other than that of the source."""
        if self.protocol:
            named = simulator.Protocol.from_name(self.protocol, len(design.electrodes))
            named.require_same(known, "--protocol names", whose, "leave --protocol out")

    def _from_scene(
        self, path: Path, resolution: "Resolution", output: options.Output
    ) -> PicturedFrames:
        """Frame of a scene, against it without its touches or against the flat sensor."""
        import numpy as np

        if self.reference not in ("untouched", "flat"):
            raise ConfigurationError(
                f"expected --reference untouched or flat for a scene, got '{self.reference}'"
            )
        scene, design = simulator.Scene.from_toml(path), options.read_design(self.sensor)
        sim = options.SensorOptions(protocol=self.protocol or "pairwise").simulator(
            resolution, design
        )
        sim.check_scene(scene)
        announce_unsolved(sim, scene, output)
        before = (
            simulator.Scene()
            if self.reference == "flat"
            else dataclasses.replace(scene, touches=())
        )
        circles = tuple((touch.x, touch.y, touch.indenter.rims[1]) for touch in scene.touches)
        now, then = (np.array([sim.measure(each).impedance]) for each in (scene, before))
        return PicturedFrames(design, sim.protocol, [path.stem], now, then, [circles], then[:0])

    def _from_dataset(self, path: Path, output: options.Output) -> PicturedFrames:
        """Chosen frames of a dataset; the first touched one where none is chosen."""
        import numpy as np

        from eitskin.training.reconstruction.reconstructor import silent_channels

        data = read_recorded(path, None, None, marks_lost=True)
        design = options.read_design(self.sensor) if self.sensor else data.design
        if design is None:
            raise DataError(
                f"expected a dataset that knows its sensor, got {path} without one; name the "
                "design with --sensor DESIGN.toml"
            )
        protocol = data.protocol
        if protocol is not None:
            self.require_protocol(design, protocol, "the dataset has")
        elif self.protocol:
            protocol = simulator.Protocol.from_name(self.protocol, len(design.electrodes))
        else:
            raise DataError(
                f"expected a dataset that knows its protocol, got {path} without one; name it with "
                "--protocol, such as adjacent"
            )
        touched = np.flatnonzero(data.touch_count > 0)
        chosen = (
            options.frame_numbers(self.frames, len(data))
            if self.frames
            else [*touched[:1].tolist()] or [0]
        )
        same = data.specimen == data.specimen[chosen[0]]
        flat = np.nan_to_num(data.bend_angle_deg) == 0
        still = data.impedance[same & flat & (data.state == datasets.State.IDLE)]
        if self.reference == "flat":
            before = data.reference[data.specimen[chosen]]
        elif self.reference == "untouched":
            before = data.values_before_touch[chosen]
            if not len(still) and data.source == "measured":
                still = data.touch_reference[same & data.has_touch_reference]
        else:
            if Path(self.reference).exists():
                other = read_recorded(Path(self.reference), None, None, marks_lost=True)
                required_protocol(other).require_same(
                    protocol, "--reference has", "the frames have", "name a recording like theirs"
                )
                still = np.where(other.status != 0, np.nan, other.impedance)
            else:
                still = data.impedance[options.frame_numbers(self.reference, len(data))]
            before = np.tile(still.mean(axis=0), (len(chosen), 1))
        some = data.impedance[np.unique(np.linspace(0, len(data) - 1, 200).astype(int))]
        silent = silent_channels(some)
        if silent.any():
            labels = [protocol.labels[k] for k in np.flatnonzero(silent)[:5]]
            output.note(
                f"left out: {silent.sum()} dead or stuck channels, such as {', '.join(labels)}"
            )
        radius = 0.02 * min(design.outline.length, design.outline.width)  # where it is not known
        circles = np.stack([data.touch_x, data.touch_y, data.touch_radius], axis=2)[chosen]
        circles[..., 2] = np.where(np.isfinite(circles[..., 2]), circles[..., 2], radius)
        return PicturedFrames(
            design,
            protocol,
            [f"frame {k}" for k in chosen],
            np.where((data.status[chosen] != 0) | silent, np.nan, data.impedance[chosen]),
            before,
            [tuple(map(tuple, circle[np.isfinite(circle[:, 0])].tolist())) for circle in circles],
            np.where(silent, np.nan, still),
        )

    def _from_board(self, uri: str, seed: int, output: options.Output) -> PicturedFrames:
        """Frames of a board after the frames of its reference."""
        import numpy as np

        design, frames = options.read_design(self.sensor), self.frames
        count = int(frames) if frames and frames.isdigit() else 1
        if frames and not 1 <= count <= options.MAX_PICTURES:
            raise ConfigurationError(
                f"expected --frames of a board from 1 to {options.MAX_PICTURES}, got '{frames}'"
            )

        def good(frame: "simulator.Frame") -> "NDArray[np.complex128]":
            return np.where(frame.status == 0, frame.impedance, np.nan)

        with options.opened_board(uri, seed) as board:
            self.require_protocol(design, board.protocol, "the board measures")
            output.note(f"{self.average} frames for the reference; keep the sensor untouched")
            arriving = board.frames()
            first = np.array([good(frame) for frame in islice(arriving, self.average)])
            output.note(f"{count} frame{'s' * (count > 1)} to picture; touch the sensor")
            taken_frames = list(islice(arriving, count))
        if not taken_frames:
            raise DataError(
                f"expected frames after the {self.average} of the reference, got none; take fewer "
                "with --average"
            )
        return PicturedFrames(
            design,
            board.protocol,
            [f"frame {frame.number}" for frame in taken_frames],
            np.array([good(frame) for frame in taken_frames]),
            np.tile(np.nanmean(first, axis=0), (len(taken_frames), 1)),
            [()] * len(taken_frames),
            first,
        )
