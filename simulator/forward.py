"""The forward model: from a conductivity to the impedances between electrodes."""

from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry import ConfigurationError, Mesh, SensorDesign, structured_mesh
from eitskin.geometry.structured import Grading
from eitskin.simulator.assembly import Assembly, Contact, Stiffness
from eitskin.simulator.protocol import Protocol
from eitskin.simulator.sensitivity import pixel_gram
from eitskin.simulator.solvers import BlockCholesky, Solver

Array = NDArray[np.float64]
Field = Callable[[Array], ArrayLike]
Conductivity: TypeAlias = float | Array | Field
AreaRatio: TypeAlias = Callable[[Array, Array], Array]
Resolution = Literal["fast", "standard", "fine"]
Discretisation: TypeAlias = tuple[tuple[int, int], Grading]

# Element order (in the plane, upwards) and cell sizes. What each costs and how wrong it is:
# `python -m eitskin.benchmarks.accuracy`.
RESOLUTIONS: dict[str, Discretisation] = {
    "fast": ((2, 1), Grading(finest=1e-3, coarsest=4e-3, growth=0.7, layers=1)),
    "standard": ((3, 2), Grading(finest=1.2e-4, coarsest=5e-3, growth=2.5, layers=1)),
    "fine": ((4, 2), Grading(finest=5e-5, coarsest=6e-3, growth=3.0, layers=1)),
}


class ForwardModel:
    """The complete electrode model of one design on one mesh.

    div(sigma grad u) = 0; u + z sigma du/dn = U_l on electrode l; no flux elsewhere (Somersalo,
    Cheney and Isaacson 1992). Solved on the undeformed mesh: a deformed sensor comes as the
    pulled-back tensor J F^-1 sigma F^-T and the area ratio of its electrodes.

    Attributes:
        design: the sensor.
        mesh: of the undeformed layer.
        solver: how the matrix is factorised; `solver.name` says it in words.
        factorisations: how many matrices have been factorised so far.
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation = "standard",
        breaks: Sequence[float] = (),
    ) -> None:
        """Mesh the design.

        Args:
            design: the sensor.
            resolution: a name, or element order (in the plane, upwards) and grading.
            breaks: further x at which the mesh has faces [m].
        """
        if isinstance(resolution, str):
            if resolution not in RESOLUTIONS:
                raise ConfigurationError(
                    f"resolution must be one of {', '.join(RESOLUTIONS)}, got '{resolution}'"
                )
            resolution = RESOLUTIONS[resolution]
        order, grading = resolution
        self.design = design
        self.mesh: Mesh = structured_mesh(design, grading, breaks)
        self.factorisations = 0
        self._assembly = Assembly(self.mesh, order)
        faces = np.unique(self.mesh.points[:, 0])
        strip = np.searchsorted(faces - 1e-12, self._assembly.places[:, 0], side="right") - 1
        strip += self._assembly.places[:, 0] > faces[strip] + 1e-12
        self.solver: Solver = BlockCholesky(self._assembly.rows, self._assembly.columns, strip)

    @property
    def unknowns(self) -> int:
        """Number of potential unknowns that are solved for."""
        return self._assembly.unknowns

    def impedance(
        self, conductivity: Conductivity | None = None, area_ratio: AreaRatio | None = None
    ) -> Array:
        """Electrode impedance matrix Z [ohm], (electrodes, electrodes).

        Z maps injected currents, which add up to zero, to electrode potentials of zero mean: its
        rows and columns sum to zero.

        Args:
            conductivity: [S/m] a scalar, (cells,), (cells, 3, 3), or f(x) with x (..., 3) [m]
                giving (...) or (..., 3, 3); the design's own when omitted.
            area_ratio: f(x, normal), both (..., 3), giving deformed over flat area of the
                electrodes, (...); one when omitted.

        Raises:
            ConfigurationError: for a conductivity of another shape, or not positive.
        """
        stiffness, contact = self._system(conductivity, area_ratio)
        values = np.concatenate([stiffness.values, contact.values])
        eliminated = self.solver.congruence(values, contact.coupling)
        return _inverse_of_admittance(np.diag(contact.admittance) - eliminated)

    def sensitivity(
        self,
        protocol: Protocol,
        conductivity: Conductivity | None = None,
        pixels: tuple[int, int] | None = None,
    ) -> Array:
        """Adjoint Jacobian d measurement / d conductivity [ohm per S/m], (measurements, cells).

        d V_m / d sigma_c = - int_c grad u_drive . grad u_sense (Geselowitz 1971), exact for the
        discrete model.

        Args:
            protocol: the measurements.
            conductivity: at which the derivative is taken, as in `impedance`.
            pixels: (rows along y, columns along x): differentiate with respect to the
                conductivity of columns over this grid on the outline instead of cells; the
                result is (measurements, rows * columns), row by row, x and y increasing.
        """
        u = self._cell_potentials(conductivity)
        if pixels is None:
            gram = self._assembly.cell_gram(u)
        else:
            outline = self.design.outline
            gram = pixel_gram(self._assembly, self.mesh, u, outline, pixels)
        drive, sense = protocol.patterns()
        J: Array = -np.einsum("em,cef,fm->mc", drive, gram, sense, optimize=True)
        return J

    def _system(
        self, conductivity: Conductivity | None, area_ratio: AreaRatio | None
    ) -> tuple[Stiffness, Contact]:
        """The matrices of one scene; counts as a factorisation."""
        assembly = self._assembly
        ratio = (
            1.0 if area_ratio is None else area_ratio(assembly.facet_points, assembly.facet_normals)
        )
        impedances = np.array([e.contact_impedance for e in self.design.electrodes])
        contact = assembly.contact(impedances, ratio)
        self.factorisations += 1
        return assembly.stiffness(self._tensors(conductivity)), contact

    def _cell_potentials(self, conductivity: Conductivity | None) -> Array:
        """Potentials per unit electrode current, (cells, functions, electrodes) [V/A]."""
        stiffness, contact = self._system(conductivity, None)
        values = np.concatenate([stiffness.values, contact.values])
        potentials = self.solver.factorise(values).solve(contact.coupling)
        Y = np.diag(contact.admittance) - contact.coupling.T @ potentials
        return self._assembly.in_cells(potentials @ _inverse_of_admittance(Y), stiffness)

    def _tensors(self, conductivity: Conductivity | None) -> Array:
        """The conductivity as tensors, (cells, 3, 3) or, per point, (cells, q, 3, 3)."""
        if conductivity is None:
            conductivity = self.design.conductivity
        field = callable(conductivity)
        points = self._assembly.points if field else self._assembly.points[:, 0]
        given = conductivity(points) if callable(conductivity) else conductivity
        value = np.asarray(given, dtype=np.float64)
        scalar, tensor = points.shape[:-1], (*points.shape[:-1], 3, 3)
        if value.shape == scalar or value.ndim == 0:
            value = value[..., None, None] * np.eye(3)
        elif value.shape != tensor:
            asked = f"from f(x) of x with shape {points.shape}" if field else "per cell"
            raise ConfigurationError(
                f"conductivity must be a scalar, or {asked} of shape {scalar} or {tensor}, "
                f"got shape {value.shape}"
            )
        if not _positive_definite(value):
            raise ConfigurationError(
                "conductivity must be finite, symmetric and positive everywhere, in S/m; "
                f"smallest entry on the diagonal: {np.diagonal(value, 0, -2, -1).min():g}"
            )
        return np.broadcast_to(value, tensor)


def _positive_definite(S: Array) -> bool:
    """Whether all symmetric tensors S (..., 3, 3) are positive definite (Sylvester's minors)."""
    first = S[..., 0, 0]
    second = first * S[..., 1, 1] - S[..., 0, 1] ** 2
    third = (
        second * S[..., 2, 2]
        - first * S[..., 1, 2] ** 2
        - S[..., 1, 1] * S[..., 0, 2] ** 2
        + 2.0 * S[..., 0, 1] * S[..., 0, 2] * S[..., 1, 2]
    )
    # NaN fails every comparison, so it is refused too.
    positive = all(bool(np.all(m > 0.0) and np.all(np.isfinite(m))) for m in (first, second, third))
    return positive and bool(np.allclose(S, np.swapaxes(S, -1, -2), rtol=1e-9, atol=0.0))


def _inverse_of_admittance(Y: Array) -> Array:
    """Z of Y on the currents that add up to zero: rows and columns of both sum to zero.

    The constant vector is Y's null space. Filled with a mode of Y's own size it can be inverted;
    that mode is taken off again afterwards. Unlike a pseudo-inverse this has no threshold that
    rounding could decide.
    """
    n = len(Y)
    Y = 0.5 * (Y + Y.T)
    level = np.trace(Y) / n**2
    Z = np.linalg.inv(Y + level) - 1.0 / (level * n**2)
    Z -= Z.mean(axis=0)
    Z -= Z.mean(axis=1)[:, None]
    symmetric: Array = 0.5 * (Z + Z.T)
    return symmetric
