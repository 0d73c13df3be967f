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


@pytest.mark.parametrize("z", [1e-3, 2e-4 + 3e-4j])
def test_both_orders_of_elimination_agree(z) -> None:
    sigma = lambda x: 1 + 3 * x[..., 1]  # noqa: E731
    one, other = (
        ForwardModel(with_contacts(z), ((2, 2), COARSE), solver=name)
        for name in ("block Cholesky", "nested dissection")
    )
    assert one.solver.name != other.solver.name
    assert one.impedance(sigma) == pytest.approx(other.impedance(sigma), rel=1e-10, abs=1e-9)
    J = one.sensitivity(PAIRS, sigma)
    assert pytest.approx(other.sensitivity(PAIRS, sigma), rel=1e-8, abs=1e-6) == J


@pytest.mark.parametrize("z", [1e-9, 1.0, 1e3])
def test_both_forms_of_an_electrode_agree_where_both_hold(z, monkeypatch) -> None:
    """Lifted or not, an electrode is the same; far from z = 1 one of the two loses digits."""
    model = ForwardModel(with_contacts(z), ((2, 2), COARSE))
    free = PAIRS.measure(model.impedance())
    monkeypatch.setattr(model.pattern, "_liftable", np.zeros(8, dtype=bool))
    plain = PAIRS.measure(model.impedance())
    lost = 1e-16 / z / 1e-9 + 1e-10  # what the plain form loses
    assert plain == pytest.approx(free, rel=max(lost, 1e-10))


def test_small_contact_impedances_keep_their_digits() -> None:
    """R(z) is smooth near z = 0: its second difference at 1e-9 is far below rounding of 1/z."""
    z = 1e-9 * np.array([1.0, 2.0, 3.0])
    R = [PAIRS.measure(ForwardModel(with_contacts(v), ((2, 2), COARSE)).impedance()) for v in z]
    first, second = R[1] - R[0], R[2] - 2 * R[1] + R[0]
    assert np.all(first > 0)
    assert np.abs(second).max() < 1e-2 * np.abs(first).max()


def test_contacts_of_opposite_extremes_on_one_sensor() -> None:
    """Shunt electrodes beside buried ones: each keeps its digits, against a scaled copy."""
    z = np.array([1e-9, 1e3, 1e-3, 1e-9, 1.0, 1e-6, 1e3, 1e-9])
    Z = ForwardModel(with_contacts(z), ((2, 2), COARSE)).impedance()
    scaled = dataclasses.replace(with_contacts(z / 7.0), conductivity=7.0)
    other = ForwardModel(scaled, ((2, 2), COARSE)).impedance()
    # Pairs of shunt electrodes have resistances a million times smaller than the buried ones'.
    assert 7.0 * PAIRS.measure(other) == pytest.approx(PAIRS.measure(Z), rel=1e-8)


def test_complex_contacts_are_the_analytic_continuation_of_real_ones() -> None:
    """Cauchy-Riemann: the imaginary part of Z(z + i h) / h is dZ/dz."""
    h = 1e-11
    step = ForwardModel(with_contacts(1e-3 + 1j * h), ((2, 2), COARSE)).impedance()
    ahead, behind = (
        PAIRS.measure(ForwardModel(with_contacts(1e-3 + s * 1e-7), ((2, 2), COARSE)).impedance())
        for s in (1, -1)
    )
    assert PAIRS.measure(step).imag / h == pytest.approx((ahead - behind) / 2e-7, rel=1e-6)


@pytest.mark.parametrize("order", [(3, 2, 1), (3, 2, 2)], ids=["fast", "standard"])
@pytest.mark.parametrize("on", ["side", "top", "inside"])
def test_what_is_grounded_takes_part_in_a_constant_potential(on, order) -> None:
    """Else the system is singular but for rounding, and nearly all digits are lost."""
    design = REFERENCE
    if on != "side":
        z = design.thickness / 2 if on == "inside" else None
        pads = grid(Rectangle(0.15, 0.06), 2, 4, 0.005, on=on, z=z)
        design = dataclasses.replace(REFERENCE, electrodes=tuple(pads))
    model = ForwardModel(design, (order, COARSE))
    Z = model.impedance(1.0)
    size = np.abs(Z).max()
    assert np.abs(Z.sum(axis=0)).max() < 1e-9 * size
    assert np.abs(Z - Z.T).max() < 1e-9 * size
    again = model.impedance(1.0 + 1e-12)
    assert np.abs(again - Z).max() < 1e-9 * size
