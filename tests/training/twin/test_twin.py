"""Twins of simulated sensors whose numbers are known."""

import dataclasses

import numpy as np
import pytest

from eitskin.config import write_toml
from eitskin.datasets import Dataset, Recipe, State
from eitskin.datasets.recipe.specimen import Specimen
from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Clamp, SensorDesign
from eitskin.simulator import (
    FourTerminalMeter,
    Instrument,
    Mechanics,
    Protocol,
    Scene,
    Simulator,
    Touch,
)
from eitskin.training import PressedTwin, Twin, TwinPrior
from eitskin.training.twin.fit import TwinProblem
from eitskin.training.twin.labelled_frames import FLAT, LabelledFrames, labelled_frames
from eitskin.training.twin.parameters import (
    instrument_parameters,
    interpolation_centre,
    sensor_parameters,
    twin_parameter,
)
from eitskin.training.twin.twin import as_plain, recipe, write_twin

DESIGN = SensorDesign.reference()
NOMINAL = interpolation_centre(Specimen(DESIGN, Clamp(), Mechanics()))
ADJACENT = Protocol.adjacent(8, shared=True)
TERMS = ("sink", "idle")
PARAMETERS = (
    *sensor_parameters(NOMINAL, TwinPrior()),
    twin_parameter("gain", 1.0, 1.01),
    *instrument_parameters(TERMS, 8, TwinPrior(), 350.0),
)


def forward(scenes=(FLAT,), parameters=PARAMETERS, protocol=ADJACENT):
    """Problem of scenes without measured values, each row one of them."""
    n = np.arange(len(scenes))
    nothing = np.zeros((len(n), len(protocol)))
    kind = np.zeros(len(n), int)
    frames = LabelledFrames(
        protocol, "signed", tuple(scenes), n, n - 1 - n, kind, nothing, kind + 1.0, 0.0, 0, 0
    )
    return TwinProblem(NOMINAL, parameters, frames, "coarse")


def hidden(seed):
    """Coordinates of a sensor whose contacts, places, conductivity and thickness are off."""
    rng = np.random.default_rng(seed)
    size = {
        "thickness": 0.3,
        "gain": 1.0,
        "contact_impedance": 0.5,
        "electrode_place": 0.67,
        "conductivity": 0.2,
    }
    x = np.clip(rng.standard_normal(len(PARAMETERS)), -2.0, 2.0)
    # Bends of fixtures and materials near the reference's come with the package.
    x *= [0.3 if each.name in TERMS else size.get(each.name, 0.05) for each in PARAMETERS]
    return np.where([each.name in TERMS for each in PARAMETERS], np.abs(x), x)


def flat_frames(parameters, x, snr_db=75.0, count=10):
    rng = np.random.default_rng(3)
    clean = forward(parameters=parameters).readings(x)[0]
    noise = np.abs(clean).max() * 10 ** (-snr_db / 20) * rng.standard_normal((count, len(clean)))
    states = np.full(count, State.IDLE)
    return Dataset.from_arrays(clean + noise, protocol=ADJACENT, state=states, quantity="impedance")


@pytest.fixture(scope="module")
def fitted():
    """Twin of a flat frame of the reference sensor, on a board with loads."""
    return Twin.fit(DESIGN, flat_frames(PARAMETERS, hidden(3)), terms=TERMS)


@pytest.mark.slow
def test_flat_numbers_on_a_board_are_found_and_written_as_files_that_commands_read(
    fitted, tmp_path
):
    twin, x = fitted, hidden(3)
    assert [str(each) for each in twin.parameters] == [str(each) for each in PARAMETERS]
    # Loads are relative to the nominal sensor's impedance, which the fit takes from its mesh.
    true = np.array([each.number(v) for each, v in zip(PARAMETERS, x, strict=True)])
    off = (twin.values - true) / twin.standard_errors
    assert np.sqrt(np.mean(off**2)) < 1.3
    assert np.abs(off).max() < 4.0
    shown = {str(each): n for each, n in zip(twin.parameters, twin.narrowing, strict=True)}
    assert shown["contact_impedance[1]"] < 0.05
    assert shown["electrode_place[1]"] < 0.5
    assert twin.agreements["flat"].residual < 1e-3
    assert set(twin.agreements) == {"flat"}
    for name in ("span", "offset", "gel_modulus", "encapsulation_modulus"):  # no frame shows them
        assert shown[name] == pytest.approx(1.0)
        assert (name,) in twin.undetermined_combinations
    twin = fitted
    write_twin(twin, tmp_path / "twin")
    made = Recipe.from_toml(tmp_path / "twin" / "recipe.toml")
    assert made == recipe(twin)
    assert made.sensor == SensorDesign.from_toml(tmp_path / "twin" / "design.toml")
    assert made.specimens.hinge_span > 0.005
    assert 0.0 < made.specimens.contact_impedance < 0.3
    rows = (tmp_path / "twin" / "residuals.csv").read_text().splitlines()
    assert len(rows) == 1 + len(ADJACENT)
    assert as_plain(twin)["scenes"] == {"flat": 1, "bend": 0, "touch": 0}
    with pytest.raises(ConfigurationError):
        write_twin(twin, tmp_path / "twin")


@pytest.mark.slow
def test_twins_find_span_and_offset_and_change_as_their_derivatives_say():
    x = hidden(1)
    model = forward()
    J = model.jacobian(x)
    names = [str(each) for each in PARAMETERS]
    for name in ("conductivity", "contact_impedance[2]", "electrode_place[4]", "gain", "idle"):
        k, h = names.index(name), 0.01
        ends = [np.where(np.arange(len(x)) == k, x + sign * h, x) for sign in (1, -1)]
        one, other = (forward().readings(end) for end in ends)
        assert J[..., k] == pytest.approx(
            (one - other) / (2 * h), abs=2e-3 * np.abs(J[..., k]).max()
        )
    assert not J[..., names.index("span")].any()
    pairs = Protocol.pairwise(8)
    free = ("span", "offset", "electrode_place", "contact_impedance")
    parameters = tuple(each for each in PARAMETERS if each.name not in TERMS)
    rng = np.random.default_rng(5)
    x = np.array([0.2 * rng.standard_normal() if each.name in free else 0 for each in parameters])
    angles = np.array([0.0] * 10 + [-10.0, 20.0, 40.0])
    scenes = [Scene(bend=Bend(float(angle))) for angle in angles]
    clean = forward(scenes, parameters, pairs).readings(x)
    noise = 1.8e-4 * clean.max() * rng.standard_normal(clean.shape)
    state = np.where(angles == 0.0, State.IDLE, State.BEND)
    data = Dataset.from_arrays(
        clean + noise, protocol=pairs, state=state, bend_angle_deg=angles, quantity="impedance"
    )
    twin = Twin.fit(DESIGN, data)
    off = (twin.posterior.x - x) / twin.narrowing
    assert np.sqrt(np.mean(off**2)) < 1.3
    names = [each.name for each in twin.parameters]
    assert twin.narrowing[names.index("span")] < 0.1
    assert twin.narrowing[names.index("offset")] < 0.1
    assert twin.predict(labelled_frames(data)).shape == (4, 28)


def test_frames_are_grouped_by_labels():
    n = len(ADJACENT)
    level = np.arange(1.0, n + 1)
    values = np.array([level, level + 0.5, level + 2, level + 3, level + 5, level])
    nan = np.full((6, 4), np.nan)
    x, y, force, before = nan.copy(), nan.copy(), nan.copy(), np.full((6, n), np.nan)
    x[4, 0], y[4, 0], force[4, 0] = 0.05, 0.03, 7.5
    before[4] = level + 1
    state = [State.IDLE, State.IDLE, State.BEND, State.BEND, State.TOUCH, State.TOUCH]
    data = Dataset.from_arrays(
        values,
        protocol=ADJACENT,
        state=np.array(state),
        bend_angle_deg=np.array([0, 0, 20, np.nan, 0, 0]),
        touch_x=x,
        touch_y=y,
        touch_force=force,
        touch_reference=before,
        quantity="impedance",
    )
    found = labelled_frames(data)
    touch = Scene(touches=(Touch(0.05, 0.03, 7.5),))
    assert found.scenes == (FLAT, Scene(bend=Bend(20.0)), touch)
    assert found.left_out == 2  # a bend without angle, a touch without place
    assert found.values == pytest.approx(np.array([level + 0.5, 1.5 + 0 * level, 4 + 0 * level]))
    assert found.variance == pytest.approx([1 / 3, 1 + 1 / 3, 2.0])
    assert list(found.base) == [-1, 0, 0]


# ---- pressed twin ----


PAIRWISE = Protocol.pairwise(8)
METER = FourTerminalMeter(sink=2e-4, common_mode=0.01, scale=3.0)


@pytest.fixture
def folder(tmp_path):
    reference = SensorDesign.reference()
    first = dataclasses.replace(reference.electrodes[0], contact_impedance=2e-3)
    dataclasses.replace(reference, electrodes=(first, *reference.electrodes[1:])).to_toml(
        tmp_path / "design.toml"
    )
    write_toml(Clamp(), tmp_path / "fixture.toml")
    write_toml(Mechanics(), tmp_path / "mechanics.toml")
    Instrument(snr_db=70.0, meter=METER).to_toml(tmp_path / "rig.toml")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("angle_deg", [0.0, 20.0])
def test_changes_are_those_of_the_simulator_with_the_twins_instrument(folder, angle_deg):
    touches = np.array([[0.03, 0.02, 6.0], [0.10, 0.04, 9.0]])
    found = PressedTwin.read(folder, PAIRWISE).changes(touches, angle_deg, 0.0075000001)
    simulator = Simulator(SensorDesign.from_toml(folder / "design.toml"), "coarse")
    bend = Bend(angle_deg)
    scenes = [Scene(bend), *(Scene(bend, (Touch(x, y, force),)) for x, y, force in touches)]
    Z = np.real([simulator.impedance_matrix(scene) for scene in scenes])
    reading, _ = METER.reading(METER.transfer_impedance(Z, PAIRWISE))
    logs = np.log(np.abs(reading))
    np.testing.assert_allclose(found, logs[1:] - logs[0], atol=6e-4 * np.abs(found).max())
