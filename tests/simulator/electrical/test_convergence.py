"""How errors fall with refinement, and that every mesh and element falls to the same values.

The smooth problem is a block between full-end electrodes, seen through a smooth map of the box
onto itself: a full tensor field and contacts that vary from place to place, and yet
R = L / (sigma A) + 2 z / A. Its error is one of energy, so it falls like h^2p for elements of
order p.
"""

import numpy as np
import pytest

from eitskin.benchmarks.stability.closed_forms import block
from eitskin.geometry import Electrode, Mesh, Rectangle, SensorDesign, structured_mesh
from eitskin.geometry.deformation.kinematics import area_ratio
from eitskin.geometry.design.patches import electrode_contacts
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.electrical import forward_model as forward

from alternatives import pulled_back
from contacts import with_contacts
from cut_blocks import AS_TETRAHEDRA, AS_WEDGES

SIZE = np.array([0.04, 0.02, 0.01])
CONTACT = 1e-3
EXACT = block(SIZE[0], SIZE[1] * SIZE[2], 1.0, CONTACT, CONTACT)
BLOCK = SensorDesign(
    Rectangle(*SIZE[:2]),
    SIZE[2],
    tuple(Electrode(x, SIZE[1] / 2, SIZE[1], CONTACT) for x in (0.0, SIZE[0])),
)


def onto_itself(points, amount, waves):
    """Gradient of x_i + 4 amount_i L_i s_i (1 - s_i) cos(waves (s_j + s_k)), s = x / L.

    With two amounts the third direction is left alone.
    """
    s = points / SIZE
    F = np.broadcast_to(np.eye(3), (*points.shape, 3)).copy()
    for i, a in enumerate(amount):
        others = [j for j in range(len(amount)) if j != i]
        phase = waves * s[..., others].sum(axis=-1)
        F[..., i, i] += 4 * a * (1 - 2 * s[..., i]) * np.cos(phase)
        for j in others:
            bulge = 4 * a * SIZE[i] / SIZE[j] * s[..., i] * (1 - s[..., i])
            F[..., i, j] = -waves * bulge * np.sin(phase)
    return F


def split(design: SensorDesign, grading: Grading, kind: str) -> Mesh:
    """Each box of a structured mesh cut into two prisms, or into six tetrahedra (Kuhn)."""
    mesh = structured_mesh(design, grading)
    if kind == "prisms":
        columns = mesh.cells[:, AS_WEDGES].reshape(-1, len(mesh.heights) - 1, 2, 6)
        cells, heights = columns.swapaxes(1, 2).reshape(-1, 6), mesh.heights
    else:
        cells, heights = mesh.cells[:, AS_TETRAHEDRA].reshape(-1, 4), None
    contacts = electrode_contacts(mesh.points, cells, design.patches())
    return Mesh(mesh.points, cells, contacts, heights)


def model(design, order, grading, kind) -> ForwardModel:
    """The forward model on boxes cut up, so that halving them halves every cell."""
    with pytest.MonkeyPatch.context() as patch:
        if kind != "hexahedra":
            patch.setattr(forward, "mesh_design", lambda *_: split(design, grading, kind))
        return ForwardModel(design, (order, grading))


def error(order, cells, layers, kind) -> float:
    """Relative error of R with `cells` along x; a single layer is mapped in the plane only."""
    h = SIZE[0] / cells
    amount, waves = ((0.2, 0.2, 0.2), 1.0) if layers > 1 else ((0.15, 0.15), 3.0)

    def gradient(x):
        return onto_itself(x, amount, waves)

    Z = model(BLOCK, order, Grading(h, h, 1.0, layers), kind).impedance(
        lambda x: pulled_back(gradient(x)), lambda x, normal: area_ratio(gradient(x), normal)
    )
    return abs(Protocol.pairwise(2).measure(Z)[0] / EXACT - 1)


RATES = [
    ("hexahedra", (4,), (4, 8), 1),
    ("prisms", (3,), (8, 16), 1),
    ("hexahedra", (1, 1), (8, 16), 2),
    ("hexahedra", (2, 2, 2), (4, 8), 2),
    ("prisms", (1, 1), (8, 16), 2),
    pytest.param("prisms", (2, 2, 2), (6, 12), 2, marks=pytest.mark.slow),
    ("tetrahedra", (1,), (12, 16), 2),
    pytest.param("tetrahedra", (2,), (14, 16), 2, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("kind", "order", "cells", "layers"), RATES)
def test_rate(kind, order, cells, layers) -> None:
    coarse, fine = (error(order, n, 1 if layers == 1 else n // 2, kind) for n in cells)
    rate = np.log(coarse / fine) / np.log(cells[1] / cells[0])
    assert rate == pytest.approx(2 * order[0], abs=0.2 if layers == 1 else 0.1)


# The reference sensor, electrode edges and all

# hp-FEM for sigma = 1 S/m, z = 1e-4 ohm m2, converged to nine digits: pairs (0,1) .. (0,7) and
# the sum of all 28 [ohm].
HP = [530.08615, 718.93029, 744.02202, 720.20649, 548.07843, 470.82818, 407.32498, 16209.0957]
PAIRS = Protocol.pairwise(8)


@pytest.mark.slow
@pytest.mark.parametrize("cells", ["hexahedra", "prisms"])
@pytest.mark.parametrize(
    ("resolution", "close"),
    [("fast", 1.7e-2), ("standard", 1e-3), ("fine", 1e-5)],
)
def test_flat_reference_sensor_matches_the_hp_solution(resolution, close, cells) -> None:
    model = ForwardModel(with_contacts(1e-4), resolution, cells=cells)
    R = PAIRS.measure(model.impedance())
    assert [*R[:7], R.sum()] == pytest.approx(HP, rel=close)
