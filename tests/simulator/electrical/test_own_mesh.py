"""Models on meshes of one's own, against closed forms and models of designs."""

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import skfem
from scipy.io import loadmat

from eitskin.errors import ConfigurationError
from eitskin.simulator import ForwardModel, Protocol
from eitskin.training import Reconstructor

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


def test_an_annulus_converges_to_its_logarithm() -> None:
    exact = closed_forms.sector_between_arcs(2 * np.pi, 1, 2, 0.05)
    errors = []
    for n in (10, 20):
        points, cells, i = fan(np.linspace(1, 2, n // 2 + 1), np.arange(4 * n) * np.pi / 2 / n)
        model = ForwardModel.from_mesh(
            (points, cells), [i[0], i[-1]], contact_impedance=0.05, thickness=0.5
        )
        R = Protocol.pairwise(2).measure(model.impedance())[0]
        errors.append(abs(R * 0.5 / exact - 1))
    assert errors[1] < errors[0] < 1e-4


def test_a_disc_meets_its_integral_equation() -> None:
    points, cells, electrodes = disc()
    model = ForwardModel.from_mesh((points, cells), electrodes, contact_impedance=0.05)
    angles = np.arange(ELECTRODES) * 2 * np.pi / ELECTRODES
    exact = closed_forms.disc_impedance(angles, WIDTH, 0.05)
    Z = model.impedance()
    assert pytest.approx(exact, abs=1e-3 * np.abs(exact).max()) == Z


def test_the_jacobian_is_the_derivative_of_the_measurements() -> None:
    points, cells, electrodes = disc(8, 4)
    model = ForwardModel.from_mesh((points, cells), electrodes)
    protocol, rng = Protocol.adjacent(ELECTRODES), np.random.default_rng(3)
    change = rng.normal(size=len(model.mesh.cells))
    up, down = (protocol.measure(model.impedance(1 + s * 1e-4 * change)) for s in (1, -1))
    J = model.sensitivity(protocol, 1.0)
    assert J @ change == pytest.approx((up - down) / 2e-4, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("moved", [0.0, 5.0])
def test_a_picture_shows_where_a_body_has_changed(moved) -> None:
    """Wherever its points are, and for the conductivity of cells as for one number."""
    points, cells, electrodes = disc(12, 6)
    sigma = np.full(len(cells), 2.0) if moved else 2.0
    protocol = Protocol.adjacent(ELECTRODES)
    mine = ForwardModel.from_mesh((points + moved, cells), electrodes, sigma, 0.05)
    away = np.hypot(*(points[cells].mean(axis=1) - [0.4, -0.2]).T)
    seen = protocol.measure(mine.impedance(np.where(away < 0.2, 1.0, 2.0)))
    maker = Reconstructor(mine, protocol, "noser", pixels=400)
    picture = maker.images(maker.data(seen, protocol.measure(mine.impedance())))
    values = picture[maker.grid.inside]
    x, y = maker.grid.centres[values < 0.5 * values.min()].mean(axis=0)
    assert np.hypot(x - moved - 0.4, y - moved + 0.2) < 0.12
    whole = maker.grid.sum_pixels(maker.model.sensitivity).sum(axis=1)
    assert whole == pytest.approx(mine.sensitivity(protocol) @ np.full(len(cells), 2.0), rel=1e-6)


def test_groups_and_regions_of_files_are_taken_by_their_names() -> None:
    """As meshio has them from gmsh, with a point that no cell has, and from VTK without names."""
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


def test_files_are_read_by_meshio(tmp_path) -> None:
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


def test_the_mesh_of_a_real_tank_meets_its_voltages() -> None:
    """As closely as the tank is a circle: with one conductivity, 8.5 % of the voltages are left."""
    folder = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[4] / "shared" / "data"))
    if not (folder / "ktc2023_mesh_sparse.mat").is_file():
        pytest.skip(f"{folder} has no ktc2023_mesh_sparse.mat; set EITSKIN_DATA to its folder")
    mesh, tank = (
        loadmat(folder / f"ktc2023_{name}.mat", simplify_cells=True)
        for name in ("mesh_sparse", "ref")
    )
    faces = [np.asarray(each, dtype=int) for each in mesh["elfaces"]]
    model = ForwardModel.from_mesh((mesh["g"], mesh["H"].astype(int)), faces, 1.0, 1e-6)
    volts = (tank["Mpat"].T @ model.impedance() @ tank["Injref"]).T.ravel()
    scale = volts @ tank["Uelref"] / (volts @ volts)
    left = np.linalg.norm(scale * volts - tank["Uelref"])
    assert left < 0.085 * np.linalg.norm(tank["Uelref"])


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


@pytest.mark.parametrize("mesh", [3, (np.zeros((4, 2)), np.zeros((1, 4), int))])
def test_what_is_no_mesh_is_refused(mesh) -> None:
    with pytest.raises(ConfigurationError, match="expected"):
        ForwardModel.from_mesh(mesh, [[0, 1]])
