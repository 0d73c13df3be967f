"""Import of measured recordings, from any board and skin, as datasets."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from eitskin.bounds import require_positive
from eitskin.datasets.recordings.blocks import Block, ReferenceMeans, add_previous_readings
from eitskin.datasets.recordings.protocols import law_misfit
from eitskin.datasets.recordings.recorded_file import (
    RecordedFile,
    RecordingForm,
    RecordingNames,
    fitting_protocols,
)
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.manifest import Names
from eitskin.datasets.store.schema import LIMITS
from eitskin.datasets.store.summary import DatasetSummary
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import old_names
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

_MAX_EPISODES: Final = 1 << 32


def read_recording(
    path: str | Path | Sequence[str | Path],
    names: RecordingNames | None = None,
    protocol: Protocol | None = None,
    frequency: float = 40e3,
    design: SensorDesign | None = None,
    form: RecordingForm | None = None,
) -> Dataset:
    r"""Dataset of a recording with any number of channels.

    Arguments and errors as for `Recording`.

    Example:
        >>> from pathlib import Path
        >>> from eitskin.datasets import read_recording
        >>> _ = Path("table.csv").write_text("x,y,v0,v1\n0.05,0.02,530.1,718.9\n")
        >>> len(read_recording("table.csv"))
        1
    """
    recording = Recording(path, names, protocol, frequency, design, form)
    return Dataset.collect(recording.parts(), recording.frames)


@old_names(understood="describe_format")
class Recording:
    r"""Recording in one or several files, read twice: for its references, then for its frames.

    Besides the tables of `names`, `state` (idle, touch, bend or their numbers), `angle_deg` [deg],
    `x`, `y`, `depth`, `radius` [m], `force` [N], `t` [s], `specimen`, `sensor` and `session`
    (numbers or names) are taken where the files have them. Each file begins a new session.

    Attributes:
        frames: number of frames.
        protocol: drive and sense pairs of the channels; None where unknown.
        unused: tables of the files that are not read.
        specimens: number of each specimen by its name in the files.
        sessions: number of each session by its name in the files.

    Example:
        >>> from pathlib import Path
        >>> from eitskin.datasets import Recording
        >>> _ = Path("log.csv").write_text("v0,v1\n530.1,718.9\n541.2,733.8\n")
        >>> Recording("log.csv").unused
        ()
    """

    def __init__(
        self,
        path: str | Path | Sequence[str | Path],
        names: RecordingNames | None = None,
        protocol: Protocol | None = None,
        frequency: float = 40e3,
        design: SensorDesign | None = None,
        form: RecordingForm | None = None,
    ) -> None:
        """Read the files once, and check all of them.

        Args:
            path: path of the file, or of several of one form in the order of time: .csv, .tsv, .dat
                or .txt with columns, .xlsx, .parquet, .mat, .npz without pickled objects, .h5, or
                .txt with OpenEIT's "magnitudes : a , b , ..." lines.
            names: names of the tables in the files.
            protocol: drive and sense pairs of the channels; None where unknown.
            frequency: frequency of the excitation [Hz].
            design: design of the sensor; None where unknown.
            form: arrangement of the rows, and units.

        Raises:
            DataError: where a file or its content cannot be used.
            ConfigurationError: for another kind of file, or names that are not in a file.
            ImportError: where the package that reads a file is not installed.
        """
        require_positive("frequency", frequency, "Hz")
        paths = [path] if isinstance(path, str | Path) else list(path)
        self._form = form or RecordingForm()
        self._files = [
            RecordedFile(
                Path(path),
                names or RecordingNames(),
                protocol,
                design,
                self._form,
                session=str(path) if len(paths) > 1 else "",
            )
            for path in paths
        ]
        if not self._files:
            raise ConfigurationError("expected at least one file of a recording, got none")
        self.protocol = self._files[0].protocol
        self.unused = tuple(dict.fromkeys(name for file in self._files for name in file.unused))
        self._shared: dict[str, Any] = {
            "design": design,
            "frequency": frequency,
            "source": "measured",
            "quantity": self._form.quantity,
            "protocol": self.protocol,
        }
        self._survey()

    def parts(self) -> Iterator[Dataset]:
        """Frames in parts of a few thousand, with all specimens of each part."""
        numbers = np.array(sorted(self.specimens.values()), dtype=np.uint32)
        named = {number: name for name, number in self.specimens.items()}
        reference = self._references.references([named[number] for number in numbers.tolist()])
        first, last = 0, None
        for file, block in self._blocks():
            if self._form.keep_before:
                last, block = block, add_previous_readings(block, last)  # noqa: PLW2901
            rows = [self.specimens[name] for name in block.specimens.tolist()]
            labels = dict(block.labels)
            if block.before is not None:
                labels["touch_reference"] = block.before
            with file.named_errors():
                part = Dataset.from_arrays(
                    block.values,
                    reference,
                    specimen=np.searchsorted(numbers, rows),
                    specimen_number=numbers,
                    episode=np.array([self.sessions[name] for name in block.sessions.tolist()]),
                    number=np.arange(first, first + len(rows)),
                    status=block.status,
                    **labels,
                    **self._shared,
                ).own_specimens()
            yield part
            first += len(rows)

    def describe_format(self) -> tuple[dict[str, str], dict[str, str]]:
        """Reading of the first file, in words; and the options that say the same."""
        file, summary = self._files[0], DatasetSummary()
        parts = summary.add_parts(self.parts())
        part = next(parts)
        for _ in parts:
            pass
        channels = part.impedance.shape[1]
        values = part.impedance if np.imag(part.impedance).any() else np.real(part.impedance)
        first = ", ".join(f"{value:.6g}" for value in values[0, :3])
        if self.protocol is None:
            names = fitting_protocols(0, channels) or ["TABLE.csv"]
            protocol, order = f"unknown; name it with --protocol {' or '.join(names)}", ""
        else:
            misfit = law_misfit(self.protocol, part.impedance.mean(axis=0))
            named = "; names of columns count them from 1" if file.counts_from_one else ""
            protocol = f"{self.protocol}, electrodes counted from 0{named}"
            order = f"reciprocity and sums around loops hold to {misfit:.2%} (median)"
            order = order if np.isfinite(misfit) else "no readings that test it"
        scale = file.detected_options.get("--scale", 1)
        description = {
            "frames": str(self.frames),
            "values": f"{channels} channels of {file.detected_options['--values']}: {first} ...",
            "protocol": protocol,
            "order": order,
            "ranges": summary.ranges,
            "labels": ", ".join(f"{k} = {v}" for k, v in file.labels.items()) or "none",
            "units": f"lengths in {self._form.length_unit}, values times {scale}",
            "not read": ", ".join(self.unused) or "nothing",
        }
        return {name: text for name, text in description.items() if text}, file.detected_options

    def _blocks(self) -> Iterator[tuple[RecordedFile, Block]]:
        """Blocks of all files, one file after the other."""
        return ((file, block) for file in self._files for block in file.blocks())

    def _survey(self) -> None:
        """Count the frames, and find specimens, sessions and references."""
        self.frames, self._references = 0, ReferenceMeans()
        sessions: dict[str, None] = {}
        channels = 0
        for file, block in self._blocks():
            channels = channels or block.values.shape[1]
            if block.values.shape[1] != channels or file.protocol != self.protocol:
                raise DataError(
                    f"{file.path}: expected {channels} channels of one protocol as in "
                    f"{self._files[0].path}, got {block.values.shape[1]}; import it on its own"
                )
            self.frames += len(block.values)
            sessions |= dict.fromkeys(block.sessions.tolist())
            self._references.add(block)
        if not self.frames:
            raise DataError(f"{self._files[0].path}: expected at least one frame, got none")
        self.frames *= 2 if self._form.keep_before else 1
        self.specimens = _number_names(self._references.names, LIMITS["specimen"])
        self.sessions = _number_names(sessions, _MAX_EPISODES)
        self._shared["names"] = Names.from_numbers(self.specimens, self.sessions)


def _number_names(names: Iterable[str], limit: int) -> Mapping[str, int]:
    """Number of each name: the name itself where all are numbers below `limit`, else by order."""
    distinct = list(dict.fromkeys(names))
    numbers = [int(name) for name in distinct if name.isascii() and name.isdigit()]
    if len(set(numbers)) < len(distinct) or max(numbers, default=0) >= limit:
        numbers = list(range(len(distinct)))
    return dict(zip(distinct, numbers, strict=True))
