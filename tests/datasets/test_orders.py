"""Orders of readings of a frame, tested by reciprocity."""

import numpy as np
import pytest

from eitskin.datasets import RecordingForm, RecordingNames, read_recording
from eitskin.datasets.recordings.orders import in_order
from eitskin.errors import DataError
from eitskin.simulator import Protocol

PROTOCOL = Protocol.adjacent(8)


@pytest.mark.parametrize("order", ["rotated", "reversed"])
def test_the_order_that_fits_reciprocity_is_named(tmp_path, order):
    root = np.random.default_rng(0).normal(size=(8, 8))
    other = in_order(PROTOCOL, order)
    np.savez(tmp_path / "a.npz", v=np.abs(other.measure(root @ root.T))[None])
    names, path = RecordingNames("v"), tmp_path / "a.npz"
    with pytest.raises(DataError, match=rf"0.00% in the order '{order}': .*--order {order}"):
        read_recording(path, names, PROTOCOL)
    assert read_recording(path, names, other).protocol == other
    for chosen, protocol in (("given", PROTOCOL), (order, other)):
        form = RecordingForm(order=chosen)
        assert read_recording(path, names, PROTOCOL, form=form).protocol == protocol


def test_a_rotated_frame_begins_behind_the_drive_pair():
    first = [row[2:] for row in in_order(PROTOCOL, "rotated").table if row[:2] == (3, 4)]
    assert first == [(5, 6), (6, 7), (7, 0), (0, 1), (1, 2)]
