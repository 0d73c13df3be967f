"""Complex values in columns of two parts, and electrodes in the names of columns."""

import numpy as np
import pytest

from eitskin.datasets import RecordingForm, RecordingNames, read_recording
from eitskin.errors import ConfigurationError, DataError
from eitskin.simulator import Protocol

VALUES = np.array([[1 + 2j, -3 + 0.5j, -2j], [2 - 1j, 4, -1 + 1j]])


def written(path, first, second, values=VALUES, degrees=None, apart=False):
    """File with two columns for each value, beside each other or the second ones behind all."""
    parts = np.stack([values.real, values.imag], axis=-1)
    if degrees is not None:
        angle = np.angle(values, deg=degrees)
        parts = np.stack([np.abs(values), angle], axis=-1)
    names = [(first.format(k), second.format(k)) for k in range(values.shape[1])]
    columns = np.array([*zip(*names, strict=True)] if apart else [n for p in names for n in p])
    cells = parts.transpose(0, 2, 1) if apart else parts
    lines = [columns.ravel(), *cells.reshape(len(values), -1).astype(str)]
    path.write_text("\n".join(",".join(line) for line in lines))
    return path


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(
    ("first", "second", "degrees"),
    [
        ("ch{}_Magnitude", "ch{}_Phase", True),
        ("RzMag{} [Ohm]", "RzPhase{} [deg]", True),
        ("abs({})", "arg({}) [rad]", False),
        ("amp{}", "phase{}_rad", False),
        ("v{}.re", "v{}.im", None),
        ("Real {}", "Imag {}", None),
        ("ch{} I [V]", "ch{} Q [V]", None),
    ],
)
def test_two_parts_are_joined_by_their_names(tmp_path, first, second, degrees, apart):
    path = written(tmp_path / "a.csv", first, second, degrees=degrees, apart=apart)
    assert np.allclose(read_recording(path).impedance, VALUES)


def test_parts_of_other_names_are_given(tmp_path):
    np.savez(tmp_path / "a.npz", u=VALUES.real, phi=VALUES.imag, w_im=VALUES.imag, w=VALUES.real)
    read = read_recording(tmp_path / "a.npz", RecordingNames("u,w_im"))
    assert np.allclose(read.impedance, VALUES)
    form = RecordingForm(phase_unit="rad")
    polar = read_recording(tmp_path / "a.npz", RecordingNames("u,phi"), form=form)
    assert np.allclose(polar.impedance, VALUES.real * np.exp(1j * VALUES.imag))
    with pytest.raises(DataError, match="--phase-unit"):
        read_recording(tmp_path / "a.npz", RecordingNames("u,phi"))
    with pytest.raises(ConfigurationError, match=r"magnitude,phase or real,imag"):
        read_recording(tmp_path / "a.npz", RecordingNames("u,w"))


@pytest.mark.parametrize("base", [0, 1])
def test_names_carry_electrodes(tmp_path, base):
    protocol = Protocol.adjacent(5)
    names = ["_".join(f"E{e + base:02}" for e in row) for row in protocol.table]
    lines = [
        [f"{name}_{part}" for name in names for part in ("re", "im")],
        ["1.5"] * 2 * len(names),
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(",".join(line) for line in lines))
    assert read_recording(path).protocol == protocol
    other = Protocol.from_rows(protocol.table[::-1], 5)
    with pytest.raises(DataError, match=r"measurement 0 .* leave --protocol out"):
        read_recording(path, protocol=other)
