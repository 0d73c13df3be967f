"""Frames of a recording, from a dataset of eitskin or a file of any other program."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from eitskin import datasets, simulator
from eitskin.errors import ConfigurationError, DataError

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


def read_recorded(path: Path, values: str | None, protocol: str | None) -> "datasets.Dataset":
    """Dataset of a recording.

    Args:
        path: folder or shard of a dataset, or a recording of another format.
        values: name of the values in such a recording.
        protocol: text of the option --protocol; None for the dataset's own.

    Raises:
        ConfigurationError: for names or protocols that do not fit, or an unknown kind of file.
        DataError: where the recording cannot be used.
        FrameError: for another protocol than the dataset's.
    """
    named = simulator.Protocol.from_name(protocol) if protocol else None
    if not path.exists():
        raise DataError(f"there is no dataset and no file {path}; check the path")
    if not (path.is_dir() or path.suffix.lower() in (".h5", ".hdf5")):
        return datasets.read_recording(path, datasets.RecordingNames(values), named)
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
