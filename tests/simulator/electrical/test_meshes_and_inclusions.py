"""Models on meshes of the user's own, and inclusions with faces at their rims."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import skfem

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Inclusion, Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol

import closed_forms

ELECTRODES, WIDTH = 8, 0.3  # on a disc; widths [rad]


def fan(radii, angles):
    """Rings of triangles about the origin, the innermost ring open: points, cells, numbers."""
    places = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    i = np.arange(len(radii) * len(angles)).reshape(len(radii), -1)
    a, b, c, d = (x.ravel() for x in (i[:-1], np.roll(i, -1, 1)[:-1], i[1:], np.roll(i, -1, 1)[1:]))
    return places.reshape(-1, 2), np.stack([[a, b, c], [b, d, c]]).swapaxes(1, 2).reshape(-1, 3), i


def disc(rings=40, per_electrode=16):
    """Unit disc whose electrodes begin and end at points; points, cells, point numbers of each."""
    step = 2 * np.pi / ELECTRODES
    half = np.sin(np.linspace(-np.pi / 2, np.pi / 2, per_electrode + 1)) * WIDTH / 2
    gap = np.linspace(WIDTH / 2, step - WIDTH / 2, per_electrode + 1)[1:-1]
    angles = np.concatenate([k * step + np.append(half, gap) for k in range(ELECTRODES)])
    radii = 1 - np.linspace(1, 0, rings + 1)[1:] ** 2 * 0.98
    points, cells, numbers = fan(np.append(0.02, radii), angles)
    last = numbers[-1].reshape(ELECTRODES, -1)[:, : per_electrode + 1]
    middle = np.stack([numbers[0], np.roll(numbers[0], -1), np.full_like(numbers[0], len(points))])
    return np.append(points, [[0.0, 0.0]], axis=0), np.vstack([cells, middle.T]), list(last)


def test_a_bar_of_tetrahedra_has_the_resistance_of_its_length() -> None:
    """L / (sigma A) + 2 z / A, and a potential that falls evenly, with ends in either order."""
    bar = skfem.MeshTet.init_tensor(
        *(np.linspace(0, x, n) for x, n in ((0.3, 7), (0.02, 3), (1, 4)))
    )
    bar = bar.with_boundaries({"b2": lambda x: x[0] > 0.299, "b10": lambda x: x[0] < 1e-9})
    model = ForwardModel.from_mesh(bar, conductivity=2.0, contact_impedance=0.01)
    assert model.design.electrodes == ("b2", "b10")
    R = Protocol.pairwise(2).measure(model.impedance())
    assert R == pytest.approx([0.3 / 2 / 0.02 + 2 * 0.01 / 0.02])
    drop = model.potentials() @ [1.0, -1.0]
    assert np.polyfit(bar.p[0], drop, 1)[0] == pytest.approx(1 / 2 / 0.02)


@pytest.mark.slow
def test_a_disc_has_the_eigenvalues_of_its_series() -> None:
    """Through contacts so bad that currents leave evenly from them."""
    points, cells, electrodes = disc()
    model = ForwardModel.from_mesh((points, cells), electrodes, contact_impedance=1e3)
    Z, numbers = model.impedance(), np.arange(ELECTRODES)
    length = np.linalg.norm(np.diff(points[electrodes[0]], axis=0), axis=1).sum()
    for n in (1, 2, 3):
        pattern = np.cos(2 * np.pi * n * numbers / ELECTRODES)
        found = pattern @ Z @ pattern / (pattern @ pattern) - 1e3 / length
        exact = closed_forms.ring_of_gap_electrodes(
            n, ELECTRODES, WIDTH, lambda m: closed_forms.concentric_disc(m, 1.0, 0.5)
        )
        assert found == pytest.approx(exact, rel=1e-3)


def test_files_are_read_by_meshio_with_their_groups_and_regions(tmp_path):
    """As meshio has them from gmsh, with a point that no cell has, and from VTK without names."""
    meshio = pytest.importorskip("meshio")
    points, cells, electrodes = disc(6, 4)
    edges = np.vstack([np.stack([e[:-1], e[1:]], axis=1) for e in electrodes])
    tags = np.repeat(np.arange(ELECTRODES) + 1, 4)
    meshio.Mesh(
        np.pad(points, ((0, 0), (0, 1))),
        [("triangle", cells), ("line", edges)],
        cell_data={"electrode": [np.zeros(len(cells), int), tags]},
    ).write(tmp_path / "disc.vtu")
    Z = ForwardModel.from_mesh(tmp_path / "disc.vtu", contact_impedance=0.05).impedance()
    given = ForwardModel.from_mesh((points, cells), electrodes, contact_impedance=0.05).impedance()
    assert pytest.approx(given) == Z
    grid = skfem.MeshTri.init_tensor(np.linspace(0, 1, 5), np.linspace(0, 1, 5))
    left, right = (
        grid.facets[:, grid.facets_satisfying(f)].T
        for f in (lambda x: x[0] < 1e-9, lambda x: x[0] > 1 - 1e-9)
    )
    lines, tags = np.vstack([left, right]), np.repeat([7, 8], [len(left), len(right)])
    soft = grid.p[0][grid.t].mean(axis=0) < 0.5
    read = SimpleNamespace(
        points=np.pad(np.vstack([[9.0, 9.0], grid.p.T]), ((0, 0), (0, 1))),
        cells_dict={"line": lines + 1, "triangle": grid.t.T + 1, "vertex": np.array([[0]])},
        cell_sets_dict={},
        field_data={"soft": (3, 2), "hard": (4, 2), "left": (7, 1)},
        cell_data_dict={"gmsh:physical": {"line": tags, "triangle": np.where(soft, 3, 4)}},
    )
    model = ForwardModel.from_mesh(read, ["8", "left"], {"soft": 1.0, "hard": 4.0}, 1e-9)
    assert Protocol.pairwise(2).measure(model.impedance()) == pytest.approx([0.5 + 0.125])
    assert np.isnan(model.potentials()[0]).all()
    with pytest.raises(ConfigurationError, match=r"no region 'bone'.*soft, hard"):
        ForwardModel.from_mesh(read, ["8", "left"], {"bone": 1.0})


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.msh", b""),
        ("a.vtk", b"\x80\xff"),
        ("a.msh", b"$Nodes\n3\n1"),
        ("a.py", b""),
        ("b", None),
    ],
)
def test_a_file_that_is_no_mesh_is_refused(tmp_path, name, content) -> None:
    pytest.importorskip("meshio")
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigurationError, match=name):
        ForwardModel.from_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("electrodes", "wrong"),
    [
        (None, "named parts"),
        (["left"], "no part 'left'"),
        ([[0, 1], [3]], "single points"),
        ([[0, 1], [0, 1, 2]], "share a face"),
        ([[0, 1], [2, 99]], "point 99"),
        ([[0.5, 1]], "point numbers"),
    ],
)
def test_electrodes_that_have_no_contact_area_are_refused(electrodes, wrong) -> None:
    square = skfem.MeshTri.init_tensor(np.linspace(0, 1, 3), np.linspace(0, 1, 3))
    with pytest.raises(ConfigurationError, match=wrong):
        ForwardModel.from_mesh((square.p.T, square.t.T), electrodes)
    for mesh in (3, (np.zeros((4, 2)), np.zeros((1, 4), int))):
        with pytest.raises(ConfigurationError, match="expected"):
            ForwardModel.from_mesh(mesh, [[0, 1]])


RADIUS, HEIGHT, COUNT = 0.05, 0.005, 8
ROUND = SensorDesign(
    Disc(RADIUS),
    HEIGHT,
    uniform(Disc(RADIUS), COUNT, width=0.0004, contact_impedance=1e-7),
)
PROTOCOL = Protocol.adjacent(COUNT)
COARSE = ((2, 2, 2), Grading(0.0004, 0.008, 0.5))


def closed_form(part: float, contrast: float) -> np.ndarray:
    """Measurements of a concentric disc of `part` of the radius, by a Fourier series.

    Source: Isaacson, IEEE Trans. Med. Imaging 5 (1986) 91-95.
    """
    mu, n = (1.0 - contrast) / (1.0 + contrast), np.arange(1, 2001)
    gain = (1.0 + mu * part ** (2 * n)) / (1.0 - mu * part ** (2 * n)) / (np.pi * HEIGHT * n)
    angles = 2.0 * np.pi * np.arange(COUNT) / COUNT
    potential = (np.cos(np.outer(angles, n)) * gain).sum(axis=1)
    a, b, c, e = np.array(PROTOCOL.table).T
    return potential[c - a] - potential[c - b] - potential[e - a] + potential[e - b]


@cache
def without_disc():
    return PROTOCOL.measure(ForwardModel(ROUND, COARSE).impedance()).real


@pytest.mark.slow
@pytest.mark.parametrize(("contrast", "part"), [(2.0, 0.1), (100.0, 0.5)])
def test_a_disc_in_a_disc_has_the_signal_of_the_closed_form(contrast, part) -> None:
    """Next to a model without the disc, whose mesh is another."""
    plain = without_disc()
    expected = closed_form(part, contrast) - closed_form(part, 1.0)
    half = (part * RADIUS, part * RADIUS)
    for disc in (
        Inclusion.cylinder(RADIUS, RADIUS, part * RADIUS, contrast),
        Inclusion.ellipse(RADIUS, RADIUS, half, contrast),
    ):
        model = ForwardModel(ROUND, COARSE, inclusions=[disc])
        change = PROTOCOL.measure(model.impedance()).real - plain
        assert np.abs(change - expected).max() < 0.01 * np.abs(expected).max()


@pytest.mark.slow
def test_a_small_ball_has_the_signal_of_its_dipole() -> None:
    """In a bar between electrodes over both ends; of Maxwell's 3 (s - 1) / (s + 2) per volume."""
    length, width, radius, contrast = 0.04, 0.02, 0.003, 2.0
    ends = tuple(Electrode(x, width / 2, width, 1e-9) for x in (0.0, length))
    bar = SensorDesign(Rectangle(length, width), width, ends, encapsulated_thickness=width)
    ball = Inclusion.ellipsoid((length / 2, width / 2, width / 2), (radius,) * 3, contrast, 3)
    slabs = np.diff([0.0] + [2.0 * (part.high - length / 4) for part in ball])
    volume = sum(np.pi * p.outline.radius**2 * h for p, h in zip(ball, slabs, strict=True))
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * radius**3)
    model = ForwardModel(bar, ((2, 2), Grading(2e-3, 8e-3, 1.5)), inclusions=ball)
    resistance = Protocol(((0, 1, 0, 1),), 2).measure(model.impedance()).real
    change = float(resistance[0]) - length / width**2
    expected = -3.0 * (contrast - 1.0) / (contrast + 2.0) * volume / width**4
    assert change == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
def test_inclusions_have_cells_of_their_own_and_impossible_ones_are_refused():
    outline = Polygon(((0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)))
    design = SensorDesign(outline, HEIGHT, uniform(outline, 8))
    triangle = Polygon(((0, 0), (0.012, 0), (0.006, 0.01)))
    parts = [
        Inclusion.box(0.06, 0.015, 0.04, 0.01, 2.0),
        Inclusion(triangle, 0.015, 0.06, 3.0),
        Inclusion.cylinder(0.06, 0.0155, 0.003, 4.0 + 1.0j),
    ]
    model = ForwardModel(design, ((1, 1, 1), Grading(0.002, 0.01, 0.5)), inclusions=parts)
    corners = model.mesh.points[model.mesh.cells][..., :2]
    for part in parts:
        depth = part.mesh_outline.nearest(corners - part.origin)[1]
        assert ((depth > -1e-9).all(axis=1) | (depth < 1e-9).all(axis=1)).all()
    values = model._conductivity(None)[:, 0, 0]
    assert set(values.tolist()) == {1.0, 2.0, 3.0, 4.0 + 1.0j}
    model = ForwardModel(ROUND, COARSE)
    with pytest.warns(UserWarning, match="Inclusion"):
        model.impedance(lambda x: np.where(x[..., 0] > 0.043, 2.0, 1.0))
