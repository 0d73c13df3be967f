"""The linear system: condensation, solvers, and forms that no contact impedance makes cancel."""

import dataclasses

import numpy as np
import pytest

from eitskin.geometry import Electrode, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import grid
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol

from contacts import with_contacts

REFERENCE = SensorDesign.reference()
PAIRS = Protocol.pairwise(8)
COARSE = Grading(finest=2.5e-3, coarsest=1e-2, growth=1.0, layers=1)


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
    free = PAIRS.measure(model.impedance())
    monkeypatch.setattr(model.pattern, "_liftable", np.zeros(8, dtype=bool))
    plain = PAIRS.measure(model.impedance())
    lost = 1e-16 / z / 1e-9 + 1e-10  # what the plain form loses
    assert plain == pytest.approx(free, rel=max(lost, 1e-10))


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
