"""Orders of readings of a frame, tested by reciprocity and sums around loops."""

import numpy as np
import pytest

from eitskin.datasets import RecordingForm, RecordingNames, read_recording
from eitskin.datasets.recordings.orders import in_order
from eitskin.errors import DataError
from eitskin.simulator import Protocol

PROTOCOL = Protocol.adjacent(8)


# Magnitudes have reciprocity alone; opposite drives have no reciprocal ones, but sums around loops.
@pytest.mark.parametrize(
    ("order", "protocol", "size"),
    [
        ("rotated", PROTOCOL, np.abs),
        ("reversed", PROTOCOL, np.abs),
        ("rotated", PROTOCOL, np.asarray),
        ("sense-first", Protocol.opposite(8, shared=True), np.asarray),
    ],
)
def test_the_order_that_fits_the_laws_is_named(tmp_path, order, protocol, size):
    """A dead channel in the frame changes nothing."""
    root = np.random.default_rng(0).normal(size=(8, 8))
    other = in_order(protocol, order)
    frame = size(other.measure(root @ root.T))
    frame[5] = 0.0
    np.savez(tmp_path / "a.npz", v=frame[None])
    names, path = RecordingNames("v"), tmp_path / "a.npz"
    with pytest.raises(DataError, match=rf"0.00% in the order '{order}': .*--order {order}"):
        read_recording(path, names, protocol)
    assert read_recording(path, names, other).protocol == other
    for chosen, expected in (("given", protocol), (order, other)):
        form = RecordingForm(order=chosen)
        assert read_recording(path, names, protocol, form=form).protocol == expected


def test_a_rotated_frame_begins_behind_the_drive_pair():
    first = [row[2:] for row in in_order(PROTOCOL, "rotated").table if row[:2] == (3, 4)]
    assert first == [(5, 6), (6, 7), (7, 0), (0, 1), (1, 2)]
