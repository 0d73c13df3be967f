"""Pictures of meshes and currents, for each kind of cell, and what they are made of."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import mesh_design
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.view import shapes
from eitskin.simulator.view.model_pictures import (
    draw_drive,
    draw_mesh,
    height_inside,
    in_front,
    model_for_pictures,
)

from pictured_bar import bar_between_electrodes, colours

COARSE = Grading(2e-3, 5e-3, 1.0)
BAR = bar_between_electrodes(contact_impedance=1e-3)  # the current density is 1 / area


def coloured(pixels, low, high) -> int:
    """How many pixels lie between two colours."""
    return int(((pixels >= low) & (pixels <= high)).all(axis=2).sum())


@pytest.mark.parametrize("kind", ["hexahedra", "prisms"])
def test_lines_of_current_in_a_bar_are_straight_and_carry_its_density(kind) -> None:
    model = ForwardModel(BAR, ((1, 1), COARSE), cells=kind)
    lines = shapes.lines_of_current(model.mesh, model.current_density((0, 1)), plus=0, count=10)
    assert lines.n_cells == 10
    assert lines["magnitude"] == pytest.approx(1.0 / (0.010 * 0.005), rel=1e-6)
    for number in range(lines.n_cells):
        points = lines.get_cell(number).points
        assert np.ptp(points[:, 1:], axis=0).max() < 1e-6
    x = lines.points[:, 0]
    assert (x.min(), x.max()) == pytest.approx((0.0, 0.040), abs=3e-3)
    # They spread over the electrode they begin on.
    many = shapes.lines_of_current(model.mesh, model.current_density((0, 1)), 0, count=40)
    for axis, extent in ((1, 0.010), (2, 0.005)):
        quarters = np.histogram(many.points[:, axis], bins=4, range=(0.0, extent))[0]
        assert quarters.min() > 0.5 * quarters.mean()


@pytest.mark.slow
def test_a_design_with_electrodes_of_every_kind_is_drawn(tmp_path) -> None:
    electrodes = (
        Electrode(0.060, 0.030),
        Electrode(0.040, 0.020, 0.010, on="top", shape="round"),
        Electrode(0.020, 0.040, 0.010, on="inside", z=0.002),
    )
    design = SensorDesign(Disc(0.030), 0.004, electrodes)
    draw_mesh(mesh_design(design, Grading(2e-3, 8e-3, 1.0)), tmp_path / "mesh.png")
    pixels = colours(tmp_path / "mesh.png")
    assert coloured(pixels, (160, 90, 20), (230, 150, 80)) > 2000  # electrodes
    assert (pixels.min(axis=2) < 250).mean() > 0.2
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.png"]


@pytest.mark.slow
def test_potential_and_current_of_a_drive_pair_are_drawn(tmp_path) -> None:
    model = ForwardModel(BAR, ((1, 1), COARSE))
    draw_drive(model, (0, 1), tmp_path / "drive.png")
    pixels = colours(tmp_path / "drive.png")
    middle = pixels[pixels.shape[0] // 3 : 2 * pixels.shape[0] // 3]
    potential = middle[:, : middle.shape[1] // 2]
    red = potential[..., 0] - potential[..., 2] > 60
    blue = potential[..., 2] - potential[..., 0] > 60
    assert red.sum() > 3000
    assert blue.sum() > 3000
    # The current enters on the left, where the potential is high.
    assert np.nonzero(red)[1].mean() < np.nonzero(blue)[1].mean()


def test_electrodes_inside_and_below_are_looked_at_where_they_are() -> None:
    places = ((0.010, "top"), (0.030, "bottom"))
    pads = tuple(Electrode(x, 0.020, 0.008, on=on) for x, on in places)
    sheet = Electrode(0.020, 0.030, 0.008, on="inside", z=0.001)
    design = SensorDesign(Disc(0.020), 0.004, (*pads, sheet))
    mesh = mesh_design(design, Grading(2e-3, 8e-3, 1.0))
    heights = [height_inside(mesh, electrode) for electrode in range(3)]
    assert heights == [None, None, pytest.approx(0.001)]
    assert [np.sign(in_front(mesh, electrode)[2]) for electrode in range(3)] == [1.0, -1.0, 1.0]


def test_electrodes_that_do_not_exist_are_refused(tmp_path) -> None:
    model = ForwardModel(BAR, ((1, 1), COARSE))
    for drive in ((0, 2), (1, 1)):
        with pytest.raises(ConfigurationError):
            draw_drive(model, drive, tmp_path / "drive.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hexahedra", "prisms"])
def test_the_model_for_pictures_is_right_to_a_few_percent(kind) -> None:
    design = SensorDesign.reference()
    pairs = Protocol.pairwise(8)
    model = model_for_pictures(design, kind)
    R = pairs.measure(model.impedance())
    assert pairs.measure(ForwardModel(design).impedance()) == pytest.approx(R, rel=0.03)
    assert len(model.mesh.cells) < 40_000
