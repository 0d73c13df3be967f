"""The complete electrode model against closed forms, dense solutions and rates."""

import dataclasses

import numpy as np
import pytest

from eitskin.benchmarks.cosine_box import box_impedance
from eitskin.benchmarks.stability.closed_forms import block, shunt_pair
from eitskin.geometry import Disc, Electrode, Mesh, Rectangle, SensorDesign, structured_mesh
from eitskin.geometry.deformation.kinematics import area_ratio
from eitskin.geometry.design.patches import electrode_contacts
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import mesh_design
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.electrical import forward_model as forward
from eitskin.simulator.electrical.function_space import FunctionSpace, estimated_memory
from eitskin.simulator.electrical.resolution import discretisation

import closed_forms
from alternatives import pulled_back
from contacts import with_contacts
from cut_blocks import AS_TETRAHEDRA, AS_WEDGES

THICKNESS = 0.005
COARSE = Grading(finest=2.5e-3, coarsest=1e-2, growth=1.0, layers=1)
EVEN = Grading(finest=5e-3, coarsest=5e-3, growth=1.0, layers=1)
SHARP = Grading(finest=1e-6, coarsest=2e-2, growth=1.5, layers=1)


def two_electrodes(outline, *electrodes, conductivity=1.0):
    return SensorDesign(outline, THICKNESS, electrodes, conductivity)


def strip(*z, conductivity=1.0):
    """100 x 40 mm with an electrode over each whole end."""
    ends = (Electrode(0.0, 0.02, 0.04, z[0]), Electrode(0.1, 0.02, 0.04, z[-1]))
    return two_electrodes(Rectangle(0.1, 0.04), *ends, conductivity=conductivity)


def pair(Z):
    return Protocol.pairwise(2).measure(Z)[0]


def resistance(model, *scene):
    return pair(model.impedance(*scene))


# Block between full-end electrodes


@pytest.mark.parametrize("z", [(1e-3, 1e-3), (1e-9, 1e3), (1e-3 - 4e-3j, 1e-6 + 2e-4j)])
@pytest.mark.parametrize("order", [(1,), (3, 2, 1), (5, 4)])
def test_block_between_any_contacts(z, order) -> None:
    R = resistance(ForwardModel(strip(*z, conductivity=0.5), (order, COARSE)))
    exact = block(0.1, 0.04 * THICKNESS, 0.5, *z)
    assert R == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("z", [1e-9, 1e-3, 1e3])
def test_body_of_a_block_keeps_its_digits_beside_any_contact(z) -> None:
    """R - 2 z / A, a millionth of R at z = 1e3, is still L / (sigma A)."""
    R = resistance(ForwardModel(strip(z), ((2,), COARSE)))
    area = 0.04 * THICKNESS
    assert R - 2 * z / area == pytest.approx(block(0.1, area, 1.0), rel=1e-6)


# Two shunt electrodes on a rectangle

PAIRS = {
    "short-side mids": (((0.0, 0.03), (0.15, 0.03)), 3.796273),
    "long-side mids": (((0.075, 0.0), (0.075, 0.06)), 2.178901),
    "one side": (((0.0225, 0.0), (0.075, 0.0)), 2.593986),
    "neighbours round a corner": (((0.1275, 0.0), (0.15, 0.03)), None),
}


def edges(place):
    """Ends of a 5 mm electrode on the rim of 150 x 60 mm, in turn counter-clockwise."""
    along = {0.0: (-1, 0), 0.06: (1, 0)}.get(place[1], (0, 1 if place[0] == 0.0 else -1))
    half = 0.0025 * np.array(along)
    return tuple(place + half), tuple(place - half)


@pytest.mark.parametrize("name", PAIRS)
def test_two_shunt_electrodes_on_a_rectangle(name) -> None:
    places, table = PAIRS[name]
    exact = shunt_pair(0.15, 0.06, [*edges(places[0]), *edges(places[1])])
    if table is not None:
        assert exact == pytest.approx(table, abs=6e-7)
    design = two_electrodes(
        Rectangle(0.15, 0.06), *(Electrode(*place, 0.005, 1e-9) for place in places)
    )
    R = resistance(ForwardModel(design, ((4,), SHARP)))
    assert R * THICKNESS == pytest.approx(exact, rel=5e-5)


# Annular sectors and discs: a rectangle seen through the polar map


class Polar:
    """Maps x to the radius, `inner` to `outer`, and y to the angle, 0 to `angle`."""

    def __init__(self, outline, angle, inner, outer):
        self.inner = inner
        self.rates = ((outer - inner) / outline.length, angle / outline.width)

    def gradient(self, x):
        along, turning = self.rates
        radius, turn = self.inner + along * x[..., 0], turning * x[..., 1]
        cos, sin = np.cos(turn), np.sin(turn)
        F = np.zeros((*x.shape, 3))
        F[..., 0, 0], F[..., 1, 0] = along * cos, along * sin
        F[..., 0, 1], F[..., 1, 1] = -turning * radius * sin, turning * radius * cos
        F[..., 2, 2] = 1.0
        return F

    def impedance(
        self, design, grading=EVEN, breaks=(), conductivity=lambda x: np.ones(x.shape[:-1])
    ):
        model = ForwardModel(design, ((4,), grading), breaks)
        return model.impedance(
            lambda x: conductivity(x)[..., None, None] * pulled_back(self.gradient(x)),
            lambda x, normal: area_ratio(self.gradient(x), normal),
        )


@pytest.mark.parametrize("z", [1e-9, 1e-3, 1.0])
def test_sector_between_its_curved_faces(z) -> None:
    design = strip(z)
    Z = Polar(design.outline, 2.0, 0.02, 0.05).impedance(design)
    exact = closed_forms.sector_between_arcs(2.0, 0.02, 0.05, z)
    assert pair(Z) * THICKNESS == pytest.approx(exact, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1e6, 0.5 + 2j])
def test_concentric_disc(ratio) -> None:
    """Half a disc, as currents cos(n phi) are even; they leave evenly from very bad contacts."""
    count, share, z, radius = 8, 0.5, 1e3, 0.6
    outline = Rectangle(0.1, 0.08)
    pitch = outline.width / count
    places = pitch * (np.arange(count) + 0.5)
    electrodes = (Electrode(outline.length, float(y), share * pitch, z) for y in places)
    design = SensorDesign(outline, THICKNESS, tuple(electrodes))
    polar, interface = Polar(outline, np.pi, 1e-3, 1.0), outline.length * (radius - 1e-3) / 0.999
    Z = polar.impedance(
        design,
        Grading(finest=1e-4, coarsest=1e-2, growth=1.0, layers=1),
        (interface,),
        lambda x: np.where(x[..., 0] < interface, ratio, 1.0),
    )
    width = share * np.pi / count
    for n in (1, 2, 5):
        pattern = np.cos(n * np.pi * (np.arange(count) + 0.5) / count)
        measured = pattern @ Z @ pattern / (pattern @ pattern) * THICKNESS - z / width
        exact = closed_forms.ring_of_gap_electrodes(
            n, 2 * count, width, lambda m: closed_forms.concentric_disc(m, ratio, radius)
        )
        assert measured == pytest.approx(exact, rel=1e-4)


# The system solved densely


REFERENCE = SensorDesign.reference()
PAIRWISE = Protocol.pairwise(8)


def whole_matrices(model, sigma):
    """K, B, D and the contact mass over all functions, inner ones too, dense."""
    assembly = model.assembly
    space, element, outer = assembly.space, assembly.space.element, assembly.unknowns
    inner = outer + np.arange(len(space.numbers) * element.inner).reshape(len(space.numbers), -1)
    numbers = np.concatenate([space.numbers, inner], axis=1)

    def summed(rule, scale):
        shape = np.einsum("iaq,cab->cqib", element.gradients(rule.X), space.inverses)
        scale = scale * rule.weights * space.jacobians[:, None]
        return np.einsum("cq,cqib,cqjb->cij", scale, shape, shape, optimize=True)

    # A tenth of the energy between the reduced points, for the mean in each of the cells.
    found = sigma(assembly.points)
    means = np.average(found, axis=1, weights=space.rule.weights.reshape(element.cells, -1)[0])
    cells = summed(space.rule, found.reshape(len(numbers), -1))
    for rule, sign in ((space.full_rule, 0.1), (space.rule, -0.1)):
        each = np.repeat(means, rule.points.shape[1]).reshape(len(numbers), -1)
        cells += sign * summed(rule, each)
    K = np.zeros((numbers.max() + 1,) * 2)
    np.add.at(K, (numbers[:, :, None], numbers[:, None, :]), cells)
    return K, assembly


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "layers", "z"),
    [((2, 1), 2, 1e-3), ((3, 2, 1), 1, 1e-3 - 4e-4j), ((3, 3, 3), 2, 1e-3)],
)
def test_the_whole_system_solved_densely_gives_the_same_impedances(order, layers, z) -> None:
    """All unknowns kept, neither condensed nor lifted nor grounded."""
    places = [(0.01, 0.0), (0.04, 0.01), (0.02, 0.02)]
    electrodes = tuple(Electrode(x, y, contact_impedance=z) for x, y in places)
    design = SensorDesign(Rectangle(0.04, 0.02), 0.005, electrodes)
    grading = Grading(finest=5e-3, coarsest=1e-2, growth=1.0, layers=layers)
    model = ForwardModel(design, (order, grading))
    K, assembly = whole_matrices(model, lambda x: 1 + 4 * x[..., 1])
    contact = assembly.electrode_terms(np.full(3, z))
    A, n = K.astype(type(z)), len(K)
    rows, columns = (p[-assembly.contact_entries :] for p in (assembly.rows, assembly.columns))
    np.add.at(A, (rows, columns), contact.values)
    off = rows != columns
    np.add.at(A, (columns[off], rows[off]), contact.values[off])
    B = np.zeros((n, 3), dtype=A.dtype)
    B[: assembly.unknowns] = contact.coupling
    Y = np.diag(contact.admittance) - B.T @ np.linalg.solve(A, B)
    Z = model.impedance(lambda x: 1 + 4 * x[..., 1])
    assert pytest.approx(np.eye(3) - 1 / 3, abs=1e-9) == Y @ Z


@pytest.mark.parametrize("z", [1e-9, 1.0, 1e3])
def test_both_forms_of_an_electrode_agree_where_both_hold(z, monkeypatch) -> None:
    """Lifted or not, an electrode is the same; far from z = 1 one of the two loses digits."""
    model = ForwardModel(with_contacts(z), ((2, 2), COARSE))
    free = PAIRWISE.measure(model.impedance())
    monkeypatch.setattr(model.pattern, "_liftable", np.zeros(8, dtype=bool))
    plain = PAIRWISE.measure(model.impedance())
    lost = 1e-16 / z / 1e-9 + 1e-10  # what the plain form loses
    assert plain == pytest.approx(free, rel=max(lost, 1e-10))


@pytest.mark.slow
@pytest.mark.parametrize("on", ["side", "top", "inside"])
def test_what_is_grounded_takes_part_in_a_constant_potential(on) -> None:
    """Else the system is singular but for rounding, and nearly all digits are lost."""
    design = REFERENCE
    if on != "side":
        z = design.thickness / 2 if on == "inside" else None
        pads = grid(Rectangle(0.15, 0.06), 2, 4, 0.005, on=on, z=z)
        design = dataclasses.replace(REFERENCE, electrodes=tuple(pads))
    model = ForwardModel(design, ((3, 2, 1), COARSE))
    Z = model.impedance(1.0)
    size = np.abs(Z).max()
    assert np.abs(Z.sum(axis=0)).max() < 1e-9 * size
    assert np.abs(Z - Z.T).max() < 1e-9 * size
    again = model.impedance(1.0 + 1e-12)
    assert np.abs(again - Z).max() < 1e-9 * size


# Rates of convergence


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
            patch.setattr(forward, "stored_mesh", lambda *_: split(design, grading, kind))
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


@pytest.mark.slow
@pytest.mark.parametrize("cells", ["hexahedra", "prisms"])
@pytest.mark.parametrize(
    ("resolution", "close"),
    [("fast", 1.7e-2), ("standard", 1e-3), ("fine", 1e-5)],
)
def test_flat_reference_sensor_matches_the_hp_solution(resolution, close, cells) -> None:
    model = ForwardModel(with_contacts(1e-4), resolution, cells=cells)
    R = PAIRWISE.measure(model.impedance())
    assert [*R[:7], R.sum()] == pytest.approx(HP, rel=close)


# Electrodes lower than the layer

_LOW = Rectangle(0.050, 0.024)


def low_electrodes(heights):
    """Electrodes at half the height of the layer, one on each side."""
    places = ((0.014, 0.0), (0.050, 0.010), (0.036, 0.024), (0.0, 0.012))
    some = (
        Electrode(x, y, 0.005, height=height, z=0.5 * THICKNESS)
        for (x, y), height in zip(places, heights, strict=True)
    )
    return two_electrodes(_LOW, *some)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("heights", "resolution", "cells", "error"),
    [
        (4 * (1e-3,), "fast", "hexahedra", 4e-3),
        ((1e-3, 4e-3, 3e-3, 2e-3), "fast", "hexahedra", 4e-3),
        ((1e-3, 4e-3, 3e-3, 2e-3), "standard", "hexahedra", 3e-3),
        ((1e-3, 4e-3, 3e-3, 2e-3), "fast", "prisms", 4e-3),
    ],
)
def test_electrodes_lower_than_the_layer(heights, resolution, cells, error):
    """Against cosine modes of the box; falling orders in the plane were 0.6 to 1 % off."""
    model = ForwardModel(low_electrodes(heights), resolution, cells=cells)
    assert model.unknowns < 45_000
    assert box_error(model) < error


def box_error(model):
    """Largest relative error of resistances of four electrodes, against cosine modes."""
    R, exact = (
        Protocol.pairwise(4).measure(Z)
        for Z in (model.impedance(), box_impedance(model.design, polynomials=6))
    )
    return np.abs(R / exact - 1.0).max()


@pytest.mark.slow
def test_electrodes_on_a_side_on_top_at_the_bottom_and_inside():
    places = {"side": (0.014, 0.0), "top": (0.010, 0.014), "bottom": (0.03, 0.008)}
    some = [Electrode(*place, 0.005, on=on) for on, place in places.items()]
    inner = Electrode(0.038, 0.016, 0.004, height=0.006, z=0.002, on="inside")
    assert box_error(ForwardModel(two_electrodes(_LOW, *some, inner), "fast")) < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("outline", "cells"), [(Rectangle(0.150, 0.060), "hexahedra"), (Disc(0.050), "prisms")]
)
def test_electrodes_of_unequal_height_fit_the_memory(outline, cells):
    some = enumerate(uniform(outline, 8))
    electrodes = [dataclasses.replace(e, height=1e-3 * (1 + k % 4), z=2.5e-3) for k, e in some]
    design = two_electrodes(outline, *electrodes)
    order, grading = discretisation("standard", design, cells)
    assert estimated_memory(FunctionSpace(mesh_design(design, grading, cells), order)) < 5e9
