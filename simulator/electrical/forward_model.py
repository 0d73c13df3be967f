"""The forward model: from a conductivity to the impedances between electrodes."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_design import CellKind, mesh_design, natural_cells
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.assembly import TENSOR_COLUMNS, TENSOR_ROWS, Assembly, Stiffness
from eitskin.simulator.electrical.cem_system import Places, System, zero_sums
from eitskin.simulator.electrical.resolution import Discretisation, Resolution, discretisation
from eitskin.simulator.electrical.sensitivity import Tensors, pixel_gram
from eitskin.simulator.linalg.sparse_solvers import Solver, SolverName, choose_solver

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Field = Callable[[Array], ArrayLike]
Conductivity: TypeAlias = float | Array | Field
AreaRatio: TypeAlias = Callable[[Array, Array], Array]


class ForwardModel:
    """The complete electrode model of one design on one mesh.

    div(sigma grad u) = 0; u + z sigma du/dn = U_l on electrode l; no flux elsewhere (Somersalo,
    Cheney and Isaacson 1992). Solved on the undeformed mesh: a deformed sensor comes as the
    pulled-back tensor J F^-1 sigma F^-T and the area ratio of its electrodes.

    Attributes:
        design: the sensor.
        mesh: of the undeformed layer.
        assembly: of the matrices on it.
        places: of their values.
        solver: how the matrix is factorised; `solver.name` says it in words.
        factorisations: how many matrices have been factorised so far.
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation = "standard",
        breaks: Sequence[float] = (),
        cells: CellKind | None = None,
        solver: SolverName | None = None,
    ) -> None:
        """Mesh the design.

        Args:
            design: the sensor.
            resolution: a name, or element order and grading.
            breaks: further x at which a mesh of hexahedra has faces [m].
            cells: kind of mesh; hexahedra for rectangles, prisms for other outlines and
                tetrahedra for surfaces when omitted.
            solver: "block Cholesky" or "sparse LU"; chosen by the shape when omitted.
        """
        cells = cells or natural_cells(design)
        order, grading = discretisation(resolution, design, cells)
        self.design = design
        self.mesh: Mesh = mesh_design(design, grading, cells, breaks)
        self.factorisations = 0
        self.assembly = Assembly(self.mesh, order)
        self.places = Places(self.assembly)
        self.solver: Solver = choose_solver(
            solver,
            self.places.rows,
            self.places.columns,
            self.assembly.space.numbers,
            self._first(),
        )

    def _first(self) -> NDArray[np.int64]:
        """The elements at the body's lower end in x."""
        x = self.mesh.points[self.mesh.cells, 0].min(axis=1)
        touching = np.flatnonzero(x <= x.min() + 1e-9 * np.ptp(self.mesh.points[:, 0]))
        return np.unique(touching // self.assembly.space.element.cells)

    @property
    def unknowns(self) -> int:
        """Number of potential unknowns that are solved for."""
        return self.assembly.unknowns

    def impedance(
        self, conductivity: Conductivity | None = None, area_ratio: AreaRatio | None = None
    ) -> Numbers:
        """Electrode impedance matrix Z [ohm], (electrodes, electrodes).

        Z maps injected currents, which add up to zero, to electrode potentials of zero mean: its
        rows and columns sum to zero. It is complex where a contact impedance is.

        Args:
            conductivity: [S/m] a scalar, (cells,), (cells, 3, 3), or f(x) with x (..., 3) [m]
                giving (...) or (..., 3, 3); the design's own when omitted.
            area_ratio: f(x, normal), both (..., 3), giving deformed over flat area of the
                electrodes, (...); one when omitted.

        Raises:
            ConfigurationError: for a conductivity of another shape, or not positive.
        """
        _, system = self._system(conductivity, area_ratio)
        return system.impedance(self.solver.congruence(system.values, system.coupling))

    def sensitivity(
        self,
        protocol: Protocol,
        conductivity: Conductivity | None = None,
        pixels: tuple[int, int] | None = None,
        area_ratio: AreaRatio | None = None,
        along: Tensors | None = None,
    ) -> Numbers:
        """Adjoint Jacobian d measurement / d conductivity [ohm per S/m], (measurements, cells).

        d V_m / d sigma_c = - int_c grad u_drive . S grad u_sense (Geselowitz 1971), exact for the
        discrete model; S is one, or the tensors that the conductivity is changed along.

        Args:
            protocol: the measurements.
            conductivity: at which the derivative is taken, as in `impedance`.
            pixels: (rows along y, columns along x): differentiate with respect to the
                conductivity of columns over this grid on the outline's bounding box instead of
                cells; the result is (measurements, rows * columns), row by row, x and y
                increasing.
            area_ratio: as in `impedance`.
            along: symmetric S(x), (..., 3, 3), for pixels; with the conductivity itself the result
                is per relative change [ohm].

        Raises:
            ConfigurationError: for `along` without pixels.
        """
        u, _ = self.element_potentials(conductivity, area_ratio)
        if pixels is not None:
            gram = pixel_gram(self.assembly, self.mesh, u, self.design.outline, pixels, along)
        elif along is None:
            gram = self.assembly.cell_gram(u)
        else:
            raise ConfigurationError("a sensitivity along tensors is one of pixels; give pixels")
        drive, sense = protocol.patterns()
        J: Numbers = -np.einsum("em,cef,fm->mc", drive, gram, sense, optimize=True)
        return J

    def contact_sensitivity(
        self, protocol: Protocol, conductivity: Conductivity | None = None
    ) -> Numbers:
        """d measurement / d contact impedance [ohm per ohm m2], (measurements, electrodes).

        d V_m / d z_l = int_{E_l} j_drive j_sense with the current densities
        j = (U_l - u) / z_l (Vilhunen et al. 2002), exact for the discrete model.
        """
        assembly, z = self.assembly, self.contact_impedance
        electrode = assembly.facet_electrode
        _, system, w, U = self._solve(conductivity)
        j = self.contact_drops(w, U, system.lift) / z[electrode][:, None, None]
        pieces = np.einsum("fq,fqk,fql->fkl", assembly.facet_weights, j, j, optimize=True)
        gram = np.zeros((len(z), *pieces.shape[1:]), dtype=pieces.dtype)
        np.add.at(gram, electrode, pieces)
        drive, sense = protocol.patterns()
        J: Numbers = np.einsum("em,lef,fm->ml", drive, gram, sense, optimize=True)
        return J

    def contact_drops(self, w: Numbers, U: Numbers, lift: Array) -> Numbers:
        """U - u on the electrodes' pieces, (pieces, q, k), of a solution u = w + lift U."""
        assembly = self.assembly
        on = np.einsum("fiq,fie->fqe", assembly.facet_shape, w[assembly.facet_numbers])
        # u - U_l is w itself where the electrode's own potential is lifted off.
        own = U * (1.0 - lift.max(axis=0))[:, None]
        drops: Numbers = own[assembly.facet_electrode][:, None] - on
        return drops

    def potentials(
        self, conductivity: Conductivity | None = None, area_ratio: AreaRatio | None = None
    ) -> Numbers:
        """Potential at the mesh's points per unit current into each electrode [V/A].

        Shape (points, electrodes); the current leaves through all electrodes alike, so that
        differences of columns are the potentials of drive pairs. They count from the mean of the
        electrodes' own potentials, as those of `impedance` do.
        """
        u, U = self.element_potentials(conductivity, area_ratio)
        counted: Numbers = self.at_points(u) - U.mean(axis=0)
        return counted

    def element_potentials(
        self, conductivity: Conductivity | None = None, area_ratio: AreaRatio | None = None
    ) -> tuple[Numbers, Numbers]:
        """Potentials in the elements and of the electrodes, per unit current into each [V/A].

        Coefficients of the elements' functions (elements, functions, electrodes), and (electrodes,
        electrodes), of the first by a current into the second; it leaves through all alike. Both
        count from the grounded place, where gradients keep all digits for any contact impedance.
        """
        stiffness, system, w, U = self._solve(conductivity, area_ratio)
        return self.assembly.space.in_elements(w + system.lift @ U, stiffness.inner), U

    def at_points(self, u: Numbers) -> Numbers:
        """Functions of the elements (elements, functions, k) at the mesh's points, (points, k)."""
        space, cells = self.assembly.space, self.mesh.cells
        elements = np.arange(len(cells)) // space.element.cells
        X = space.reference(elements, self.mesh.points[cells])
        values = np.einsum("ick,cie->cke", space.element.values(X), u[elements], optimize=True)
        at_points = np.empty((len(self.mesh.points), u.shape[-1]), dtype=u.dtype)
        at_points[cells] = values
        return at_points

    def current_density(
        self,
        drive: tuple[int, int],
        conductivity: Conductivity | None = None,
        area_ratio: AreaRatio | None = None,
    ) -> Numbers:
        """Mean current density in each cell per unit current [A/m2 per A], (cells, 3)."""
        plus, minus = drive
        u, _ = self.element_potentials(conductivity, area_ratio)
        assembly = self.assembly
        gradients = assembly.cell_gradients(u[..., [plus]] - u[..., [minus]])[..., 0]
        sigma = _symmetric(self._conductivity(conductivity))
        weights = assembly.cell_weights
        flux = -np.einsum("cqab,cqb->cqa", np.broadcast_to(sigma, (*gradients.shape, 3)), gradients)
        mean: Numbers = np.einsum("cq,cqa->ca", weights, flux) / weights.sum(axis=1)[:, None]
        return mean

    @cached_property
    def _own_conductivity(self) -> Conductivity:
        """The design's conductivity: one number, or of each cell's layer.

        Tetrahedra do not keep to the layers, so theirs is a function of place.
        """
        if not self.design.layers:
            return self.design.conductivity
        if self.mesh.heights is None:
            return self.design.conductivity_at
        return self.design.conductivity_at(self.mesh.points[self.mesh.cells].mean(axis=1))

    @property
    def contact_impedance(self) -> Numbers:
        """Of each electrode [ohm m2], (electrodes,); complex where any is."""
        z = np.array([e.contact_impedance for e in self.design.electrodes])
        return z if np.any(np.imag(z)) else np.real(z)

    def _system(
        self, conductivity: Conductivity | None, area_ratio: AreaRatio | None
    ) -> tuple[Stiffness, System]:
        """Stiffness and system of one scene; counts as a factorisation."""
        assembly = self.assembly
        ratio = (
            1.0 if area_ratio is None else area_ratio(assembly.facet_points, assembly.facet_normals)
        )
        contact = assembly.contact(self.contact_impedance, ratio)
        stiffness = assembly.stiffness(self._conductivity(conductivity))
        self.factorisations += 1
        return stiffness, self.places.system(stiffness.values, contact)

    def _solve(
        self, conductivity: Conductivity | None, area_ratio: AreaRatio | None = None
    ) -> tuple[Stiffness, System, Numbers, Numbers]:
        """Stiffness, system, w (unknowns, electrodes) and U, per unit electrode current [V/A].

        The currents leave through all electrodes alike.
        """
        stiffness, system = self._system(conductivity, area_ratio)
        per_potential = self.solver.factorise(system.values).solve(system.coupling)
        T = system.coupling.T @ per_potential
        U = np.linalg.solve(system.admittance - 0.5 * (T + T.T), zero_sums(np.eye(len(T))))
        return stiffness, system, per_potential @ U, U

    def _conductivity(self, conductivity: Conductivity | None) -> Array:
        """The conductivity as `Assembly.stiffness` takes it, (cells, q or 1, 1 or 6)."""
        if conductivity is None:
            conductivity = self._own_conductivity
        if callable(conductivity):
            return _field_entries(conductivity, self.assembly.points)
        value = np.asarray(conductivity, dtype=np.float64)
        shape = (len(self.mesh.cells), 1)
        return _entries(value[:, None] if value.ndim else value, shape, "per cell of", shape[:1])


def _field_entries(conductivity: Field, points: Array) -> Array:
    """Scalars or entries xx, yy, zz, xy, xz, yz of a field at points (..., 3), (..., 1 or 6)."""
    value = np.asarray(conductivity(points), dtype=np.float64)
    shape = points.shape[:-1]
    return _entries(value, shape, f"from f(x) of x with shape {points.shape} of", shape)


def _entries(value: Array, shape: tuple[int, ...], what: str, asked: tuple[int, ...]) -> Array:
    """Scalars (...) as (..., 1), tensors (..., 3, 3) as (..., 6); raises ConfigurationError."""
    if value.shape == shape or value.ndim == 0:
        entries = np.broadcast_to(value, shape)[..., None]
    elif value.shape == (*shape, 3, 3):
        entries = value[..., TENSOR_ROWS, TENSOR_COLUMNS]
    else:
        raise ConfigurationError(
            f"conductivity must be a scalar, or {what} shape {asked} or {(*asked, 3, 3)}, got "
            f"shape {value.shape}"
        )
    if not _positive_definite(value, entries):
        raise ConfigurationError(
            "conductivity must be finite, symmetric and positive everywhere, in S/m; "
            f"smallest entry on the diagonal: {entries[..., :3].min():g}"
        )
    return entries


def _symmetric(entries: Array) -> Array:
    """Tensors (..., 3, 3) of the entries (..., 1 or 6)."""
    if entries.shape[-1] == 1:
        return entries[..., None] * np.eye(3)
    tensors = np.empty((*entries.shape[:-1], 3, 3))
    tensors[..., TENSOR_ROWS, TENSOR_COLUMNS] = entries
    tensors[..., TENSOR_COLUMNS, TENSOR_ROWS] = entries
    return tensors


def _positive_definite(given: Array, entries: Array) -> bool:
    """Whether all scalars, or all tensors of these entries, are positive (Sylvester's minors)."""
    if entries.shape[-1] == 1:
        return bool(np.all(given > 0.0) and np.all(np.isfinite(given)))
    xx, yy, zz, xy, xz, yz = np.moveaxis(entries, -1, 0)
    second = xx * yy - xy**2
    third = second * zz - xx * yz**2 - yy * xz**2 + 2.0 * xy * xz * yz
    # NaN fails every comparison, so it is refused too.
    positive = all(bool(np.all(m > 0.0) and np.all(np.isfinite(m))) for m in (xx, second, third))
    return positive and all(
        bool(np.allclose(given[..., a, b], given[..., b, a], rtol=1e-9, atol=0.0))
        for a, b in ((0, 1), (0, 2), (1, 2))
    )
