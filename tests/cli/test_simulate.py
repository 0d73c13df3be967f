"""`eitskin simulate` and `mesh`: numbers, protocols, touches, and mistakes in scenes."""

import json

import command_line
import pytest

from eitskin.geometry import FreeArc, Hinge, SensorDesign
from eitskin.simulator import Mechanics, Protocol, Scene, Simulator
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.mechanics.materials import NeoHookean


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("[[touches]]\nx = 0.05\ny = 0.02\n")
    return path


def run(scene, *options):
    return command_line.run("simulate", scene, "--resolution", "fast", *options)


def simulate(scene, *options) -> dict:
    return json.loads(run(scene, "--json", *options).stdout)


QUANTITIES = {
    "_N": ("force",),
    "_m": ("depth", "contact_radius", "edge_distance", "neighbour_distance"),
    "_m2": ("contact_area",),
    "_Pa": ("mean_pressure", "peak_pressure"),
    "": ("thinning", "signal_error", "caution"),
}


def written(path, text):
    path.write_text(text)
    return path


@pytest.mark.slow
def test_an_instrument_measures_and_its_noise_may_be_another(tmp_path) -> None:
    flat = written(tmp_path / "flat.toml", "")
    board = ("--instrument", "ad5940")
    clean, one, again, quieter, other = (
        simulate(flat, *options)
        for options in ((), board, board, (*board, "--noise", "90"), (*board, "--seed", "1"))
    )
    assert set(clean["impedance_imag_ohm"]) == {0.0}
    assert max(one["impedance_imag_ohm"]) < -1.0  # of the stray capacitance
    assert one["impedance_real_ohm"] == again["impedance_real_ohm"]
    assert one["impedance_real_ohm"] != other["impedance_real_ohm"]
    moved = [a - b for a, b in zip(one["change_ohm"], quieter["change_ohm"], strict=True)]
    assert 0.05 < max(map(abs, moved)) < 1.0  # 0.15 ohm of noise are gone
    assert one["status"] == [0] * 28


def test_changes_are_from_the_flat_sensor_and_relative_where_its_value_is_not_zero(scene, tmp_path):
    """The untouched sensor differs from its flat self by nothing, in the units of any meter."""
    flat = written(tmp_path / "flat.toml", "")
    rig = written(
        tmp_path / "rig.toml",
        'snr_db = 0.0\n[meter]\nsink = 3e-4\nidle = 5e-5\nscale = 12.0\nreads = "magnitude"\n',
    )
    board = ("--protocol", "opposite", "--instrument", str(rig))
    assert simulate(flat, *board)["change_ohm"] == pytest.approx([0.0] * 16, abs=1e-9)
    assert 1e-3 < max(map(abs, simulate(scene, *board)["relative_change"])) < 0.2
    # Electrodes 7 and 3 are the middles of the short sides, 1 and 5 of the long ones.
    Protocol(((1, 5, 3, 7), (1, 5, 1, 5)), 8).to_file(tmp_path / "symmetric.csv")
    found = simulate(scene, "--protocol", str(tmp_path / "symmetric.csv"))
    assert found["relative_change"][0] is None
    before = found["impedance_real_ohm"][1] - found["change_ohm"][1]
    assert found["relative_change"][1] == pytest.approx(found["change_ohm"][1] / before)
    assert abs(found["change_ohm"][0]) > 1e-3


@pytest.mark.slow
def test_every_touch_tells_what_became_of_it(scene, tmp_path) -> None:
    picture = tmp_path / "scene.png"
    free = written(tmp_path / "free.toml", "support = 'free'\n" + scene.read_text())
    (alone,) = simulate(scene, "--view", str(picture), "--color", "strain")["touches"]
    assert picture.stat().st_size > 10_000
    assert alone["neighbour_distance_m"] is None
    options = ("--support", "rigid", "--touch-model", "tabulated")
    assert simulate(free, *options)["touches"] == [alone]
    scene = written(
        tmp_path / "two.toml",
        "[[touches]]\nx = 0.05\ny = 0.02\n[[touches]]\nx = 0.06\ny = 0.056\nforce = 5\n",
    )
    found = simulate(scene)["touches"]
    presses = Simulator(SensorDesign.reference(), "fast").presses(Scene.from_toml(scene))
    for row, press in zip(found, presses, strict=True):
        for unit, names in QUANTITIES.items():
            for name in names:
                assert row[name + unit] == getattr(press, name), name
    first, second = presses
    assert first.caution == ""
    assert second.caution in " ".join(run(scene).stdout.split())


@pytest.mark.slow
def test_mechanics_and_fixture_come_from_files(scene, tmp_path) -> None:
    mechanics = written(
        tmp_path / "mechanics.toml",
        "bulk_ratio = 1e4\n[gel]\nshear_modulus = 10e3\n"
        "[encapsulation]\nshear_modulus = 14e3\n[piezoresistivity]\nvolume = 1.5\n",
    )
    scene.write_text(scene.read_text() + "force = 4\n[bend]\nangle_deg = 15\n")
    given = ("--mechanics", str(mechanics))
    for text, fixture in (("span = 0.05\n", Hinge(span=0.05)), ("length = 0.07\n", FreeArc(0.07))):
        found = simulate(scene, *given, "--fixture", str(written(tmp_path / "f.toml", text)))
        soft = Mechanics(
            NeoHookean(10e3), NeoHookean(14e3), piezoresistivity=Piezoresistivity(volume=1.5)
        )
        sim = Simulator(SensorDesign.reference(), "fast", fixture, mechanics=soft)
        frame = sim.measure(Scene.from_toml(scene))
        assert found["impedance_real_ohm"] == pytest.approx(frame.impedance.real, rel=1e-12)
        assert found["touches"][0]["depth_m"] > simulate(scene)["touches"][0]["depth_m"]


@pytest.mark.parametrize("kind", ["hexahedra", "prisms"])
def test_the_numbers_of_a_mesh_are_those_of_the_reference_sensor(kind) -> None:
    found = command_line.printed_json("mesh", "--cells", kind, "--resolution", "fast")
    assert (found["kind"], found["electrodes"]) == (kind, 8)
    assert found["volume"] == pytest.approx(0.150 * 0.060 * 0.005)
    assert found["electrode_area_error"] < 1e-9
    assert found["cells"] > 100
    assert 0.0 < found["scaled_jacobian"] <= 1.0 + 1e-12
