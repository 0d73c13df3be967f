"""What the geometry refuses: the message names the term, the value or place, and the remedy."""

import dataclasses
import math
import sys

import numpy as np
import pytest

from eitskin.config import parse_toml
from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Bend,
    Disc,
    Electrode,
    FreeArc,
    Hinge,
    Layer,
    Plates,
    Polygon,
    Rectangle,
    SensorDesign,
    Substrate,
    Surface,
    structured_mesh,
)
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.meshing.delaunay import triangulate
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import triangulated_mesh
from eitskin.geometry.meshing.tetrahedra import tetrahedral_mesh

from on_demand import OnDemand

trimesh = OnDemand("trimesh")
REFERENCE, SLAB = SensorDesign.reference(), Rectangle(0.1, 0.05)
HINGE, NAN = Hinge(span=0.040, offset=0.008), math.nan


def changed(**terms):
    return dataclasses.replace(REFERENCE, **terms)


def electrode(**terms):
    return Electrode(**{"x": 0.01, "y": 0.0, **terms})


def placed(*electrodes, outline=SLAB, thickness=0.004):
    return SensorDesign(outline, thickness, electrodes)


def part(x, z, height=0.001):
    return Electrode(x, 0.0, height=height, z=z)


def pads(x, *apart, on="top", z=None):
    return [Electrode(x + d, 0.02, on=on, z=z) for d in (0.0, *apart)]


FAR = Electrode(0.1, 0.025)
REFUSALS = [
    (lambda: Rectangle(0.0, 0.1), r"outline.length.*got 0.0"),
    (lambda: Rectangle(150, 60), r"outline.length.*1 um and 10 m.*150 m"),
    (lambda: SLAB.locate(0.02, 0.01), r"0\.01 m off .* is \(0\.02, 0\) m"),
    (lambda: Polygon(((0, 0), (1, 0))), r"outline.points.*3 to 4096.*2"),
    (lambda: Polygon(((0, 0), (1, 0, 0), (0, 1))), "points: expected 2 items"),
    (lambda: Polygon(((0.1, -0.2), (1, 0), (0.5, 1))), r"\(-0\.1, 0\.2\)"),
    (lambda: Polygon(((0, 0), (1, 1), (1, 0), (0, 1))), r"point 0 .*point 2"),
    (lambda: Polygon(((0, 0), (2, 0), (2, 1), (1, 0), (0, 1))), "point 3"),
    (lambda: Polygon(((0, 0), (1, 0), (2, 0), (2, 1e-8))), "along y"),
    (lambda: Polygon(((0, 0), (20, 0), (0, 1))), "along x"),
    (lambda: Polygon(((0, 0), (1, 0), (1, 0), (0, 1))), r"1 and 2 .*same"),
    # supports, layers, designs
    (lambda: Plates(0.0), "support span.*positive"),
    (lambda: changed(support=Plates(0.15)), r"length of 0.15 m, got 0.15 m.*'free'"),
    (lambda: Substrate(NAN, 1e3), "support thickness.*got nan"),
    (lambda: Substrate(0.01, 0.0), "support shear_modulus.*Pa, got 0"),
    (lambda: changed(thickness=0.0), r"thickness.*positive"),
    (lambda: changed(conductivity=0.0), r"conductivity.*positive.*S/m"),
    (lambda: changed(layers=(Layer(0.002, 1.0),) * 2), r"0.005 m.*0.004 m"),
    (lambda: changed(layers=(Layer(0.005, 1.0),), conductivity=2.0), "conductivity or lay"),
    (lambda: Layer(0.0, 1.0), r"layer .*positive"),
    (lambda: placed(Electrode(0.02, 0.0)), r"electrodes.*2 to 1024.*1"),
    (lambda: REFERENCE.edges(NAN), "spacing"),
    # electrodes
    (lambda: electrode(width=5e3), r"electrode width.*1 um and 10 m"),
    (lambda: electrode(height=-1.0), r"electrode height.*positive"),
    (lambda: electrode(y=-1e308), "electrode position must be within 10 m"),
    (lambda: electrode(on="rim"), r"Electrode: on: .*'side' or 'top' .*'rim'"),
    (lambda: electrode(shape="oval"), r"shape: .*'rectangle' or 'round'.*'oval'"),
    (lambda: electrode(shape="round"), r"side.*rectangle"),
    (lambda: electrode(z=0.001), r"height.*leave out z"),
    (lambda: electrode(on="inside"), r'"inside".*height z'),
    (lambda: electrode(contact_impedance=0.0), "positive real part"),
    # places of electrodes
    (lambda: placed(Electrode(0.02, 0.01), FAR), r"electrode 0.*\(0.02, 0.01\).*0.01 m"),
    (lambda: placed(Electrode(0.02, 0.0, 0.4), FAR), r"0.4 m .*0.3 m"),
    (lambda: placed(part(0.02, 0.0035, 0.002), FAR), "0.0025 to 0.0045 m, beyond .* 0.004"),
    (
        lambda: placed(Electrode(0.02, 0.01, z=0.004, on="inside"), FAR),
        r'below 0.004 m.*on = "top" or "bottom"',
    ),
    (lambda: placed(Electrode(0.001, 0.01, on="top"), FAR), "0.0015 m beyond"),
    (lambda: placed(electrode(z=0.0, on="surface"), FAR), r'"surface".*Rectangle'),
    (lambda: placed(FAR, Electrode(0.024, 0.0), Electrode(0.02, 0.0)), r"1 and 2 .*1 mm"),
    (lambda: placed(part(0.02, 0.001), part(0.021, 0.0018)), r"overlap.*0.2 mm"),
    (lambda: placed(*pads(0.02, 0.003)), r"overlap.*2 mm"),
    # layouts
    (lambda: uniform(SLAB, 1), r"count.*2 to 1024.*1"),
    (lambda: grid(SLAB, 0, 3, 0.001), r"rows.*1 to 1024.*0"),
    (lambda: grid(Rectangle(0.15, 0.06), 2, 3, 0.04), r"0.03 m.*0.04 m"),
    (lambda: grid(Disc(0.01), 1, 1, 0.019), "no pad"),
    # fixtures and deformations
    (lambda: Bend(NAN), r"angle_deg.*finite.*got nan"),
    (lambda: Hinge(span=0.0), r"span.*got 0"),
    (lambda: Hinge(transition=0.021), r"transition.*0\.02 m"),
    (lambda: Hinge(contraction=1.1), r"contraction.*0 to 1"),
    (lambda: FreeArc(-0.1), r"arc length.*got -0.1"),
    (lambda: FreeArc(0.2).flexure(REFERENCE, Bend(9.0)), "length"),
    (lambda: FreeArc(0.06).flexure(REFERENCE, Bend(350.0)), "last possible angle"),
    (lambda: HINGE.flexure(REFERENCE, Bend(-85.0)), r"-\d+"),
    (lambda: Displaced(lambda x: -2.0 * x).gradient(np.ones((1, 3))), "inside out"),
    # meshes
    (lambda: Grading(2e-3, 1e-3, 0.5), r"finest <= coarsest.*growth.*finest=0.002"),
    (
        lambda: structured_mesh(REFERENCE, Grading(1e-5, 1e-5, 1.0, 300)),
        r"2.7e\+10 points.*4.2e\+04 GB",
    ),
    (
        lambda: triangulate(SLAB, np.array([0.05]), lambda x: np.full(len(x), 1e-5)),
        r"500000 points.*finest",
    ),
]


@pytest.mark.parametrize(("make", "words"), REFUSALS)
def test_what_cannot_be_is_refused(make, words) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("thicknes = 0.005", "did you mean 'thickness'"),
        ("outline = { radus = 1 }", r"outline.*Disc \(radius\).*'radius'"),
        ("electrodes = { count = 8 }", r"`outline`.*layout"),
        ("outline = { radius = 0.1 }\nelectrodes = { cuont = 8 }", "did you mean 'count'"),
        ("outline = { radius = 0.1 }\nelectrodes = { count = 8, rows = 2 }", r"uniform \(count, "),
        ("electrodes = [{ x = 0, y = 0, width = -1 }]", r"electrodes\[0\].*width"),
    ],
)
def test_files_that_are_no_designs_say_where(text, words) -> None:
    with pytest.raises(ConfigurationError, match=words):
        parse_toml(SensorDesign, text)


# Surfaces


def ball(radius=1.0, faces=lambda f: f):
    """Sphere about the origin with other faces than its own."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return trimesh.Trimesh(mesh.vertices, faces(mesh.faces), process=False)


def beside(mesh):
    return trimesh.util.concatenate([ball(), mesh.apply_translation((5, 0, 0))])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ball(faces=lambda f: f[1:]), "open: 3 of its edges"),
        (lambda: ball(faces=lambda f: np.vstack([f[:1, ::-1], f[1:]])), "look both ways"),
        (lambda: ball(faces=lambda f: f[:, ::-1]), "inside out"),
        (lambda: beside(ball()), "holds 2 bodies"),
        (lambda: beside(ball(faces=lambda f: f[:, ::-1])), "cavity"),
        (lambda: ball(20.0), r"length.*bad.stl.*metres"),
    ],
)
def test_surfaces_that_bound_no_body_say_what_to_do(tmp_path, make, words) -> None:
    make().export(tmp_path / "bad.stl")
    with pytest.raises(ConfigurationError, match=words):
        Surface(tmp_path / "bad.stl")


BOMB = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none.stl", None, "none.stl: No such file"),
        ("text.stl", b"hello", "holds no triangles"),
        ("claims.stl", bytes(80) + b"\xff\xff\xff\x7f" + bytes(450), "claims.stl"),
        ("part.step", b"ISO-10303-21;", r"triangle.*STL"),
        ("bomb.ply", BOMB + b"end_header\n", r"bomb\.ply as a surface"),
    ],
)
def test_files_that_hold_no_surface_are_refused(tmp_path, name, content, words) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigurationError, match=words):
        Surface(tmp_path / name)
    with pytest.raises(ConfigurationError, match=r"outline\.scale.*positive"):
        Surface(tmp_path / name, NAN)


@pytest.fixture(scope="module")
def round_body(tmp_path_factory):
    path = tmp_path_factory.mktemp("ball") / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4, radius=0.05).export(path)
    return Surface(path)


def on_ball(body, *electrodes, height=0.1):
    return SensorDesign(body, height, electrodes, encapsulated_thickness=0.1)


OPPOSITE = tuple(Electrode(x, 0.0, z=0.0, on="surface") for x in (0.05, -0.05))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda b: on_ball(b, Electrode(0.06, 0.0, z=0.0, on="surface"), OPPOSITE[1]),
            r"0.01 m off the surface.*\(0.05, ",
        ),
        (
            lambda b: on_ball(b, Electrode(0.05, 0.0, 0.096, z=0.0, on="surface"), OPPOSITE[1]),
            "% of its pad",
        ),
        (lambda b: on_ball(b, Electrode(0.05, 0.0, on="top"), OPPOSITE[1]), r'"top".*Surface'),
        (lambda b: on_ball(b, *OPPOSITE, height=0.09), r"height.*0\.1000?0*1?5?.*0.09"),
        (lambda b: dataclasses.replace(on_ball(b, *OPPOSITE), support=Plates()), "'rigid'"),
        (lambda b: grid(b, 2, 2, 0.001), "surface"),
        (lambda b: structured_mesh(on_ball(b, *OPPOSITE), Grading(1e-3, 5e-3, 1.0)), "tetrahedra"),
        (lambda b: triangulated_mesh(on_ball(b, *OPPOSITE), Grading(1e-3, 5e-3, 1.0)), "plane"),
    ],
)
def test_bodies_from_files_are_no_layers(round_body, make, words) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make(round_body)


def test_the_extra_is_named_where_pytetwild_is_missing(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    with pytest.raises(ImportError, match=r"eitskin\[mesh\]"):
        tetrahedral_mesh(REFERENCE, Grading(3e-3, 12e-3, 0.7))


@pytest.mark.slow
def test_the_last_possible_angle_is_possible() -> None:
    with pytest.raises(ConfigurationError, match="last possible angle") as error:
        HINGE.flexure(REFERENCE, Bend(300.0))
    limit = float(str(error.value).split("direction is ")[1].split(" deg")[0])
    HINGE.flexure(REFERENCE, Bend(limit))
    with pytest.raises(ConfigurationError):
        HINGE.flexure(REFERENCE, Bend(limit + 0.2))
