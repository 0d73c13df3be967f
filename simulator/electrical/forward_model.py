"""Forward model: impedances between electrodes from a conductivity, and the adjoint Jacobians."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_axes, require_count
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import WHOLE_TENSOR
from eitskin.geometry.design.dispersion import Dispersion, resolve_conductivity
from eitskin.geometry.design.electrode import read_contact_impedances
from eitskin.geometry.design.inclusion import Inclusion
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_body import MeshBody
from eitskin.geometry.meshing.mesh_design import CellKind
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.assembly import Assembly, Stiffness
from eitskin.simulator.electrical.cem_system import (
    CemSystem,
    SystemPattern,
    impedance_matrix,
    zero_sums,
)
from eitskin.simulator.electrical.conductivity import (
    Conductivity,
    Field,
    conductivity_entries,
    warn_of_edges,
)
from eitskin.simulator.electrical.function_space import (
    Fields,
    FunctionSpace,
    MemoryLimitError,
    fits_memory,
)
from eitskin.simulator.electrical.resolution import (
    Discretisation,
    Resolution,
    discretisation,
    faster_resolutions,
    suited_cells,
)
from eitskin.simulator.electrical.sensitivity import Tensors, pixel_gram
from eitskin.simulator.electrical.stored_mesh import stored_mesh
from eitskin.simulator.linalg.multifrontal import MultifrontalSolver
from eitskin.simulator.linalg.sparse_structure import choose_order
from eitskin.threads import one_thread

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
AreaRatio: TypeAlias = Callable[[Array, Array], Array]

ISOTROPIC = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])  # entries of the identity


class ForwardModel:
    """Complete electrode model of one design on one mesh.

    div(sigma grad u) = 0; u + z sigma du/dn = U_l on electrode l; no flux elsewhere (Somersalo,
    Cheney and Isaacson 1992). The equations are solved on the undeformed mesh: a deformed sensor is
    given by the pulled-back tensor J F^-1 sigma F^-T and the area ratio of the electrodes.

    Attributes:
        design: the sensor, or the body of a custom mesh.
        mesh: mesh of the undeformed layer.
        assembly: assembly of the matrices on the mesh.
        pattern: pattern of the linear system, shared by all scenes.
        solver: solver of the linear system; `solver.name` names its order of elimination.
        factorisations: number of matrices factorised so far.

    Example:
        >>> from eitskin import Protocol, SensorDesign
        >>> from eitskin.simulator import ForwardModel
        >>> model = ForwardModel(SensorDesign.reference(), "coarse")
        >>> Protocol.adjacent(8).measure(model.impedance()).shape
        (40,)
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation = "standard",
        breaks: Sequence[float] = (),
        cells: CellKind | None = None,
        solver: str | None = None,
        inclusions: Sequence[Inclusion] = (),
    ) -> None:
        """Mesh the design.

        Args:
            design: the sensor.
            resolution: a name, or element order and grading.
            breaks: further positions along x with faces of a mesh of hexahedra [m].
            cells: kind of mesh; when omitted hexahedra for rectangles with few electrodes, prisms
                for other plane outlines and tetrahedra for surfaces.
            solver: order of elimination, "block Cholesky" or "nested dissection"; by the shape of
                the body when omitted.
            inclusions: parts of another conductivity, at whose rims a mesh of prisms has faces. A
                later one lies over an earlier one.

        Raises:
            ConfigurationError: for an unknown resolution, cells that do not suit the outline, an
                unknown solver, or inclusions that do not lie inside.
        """
        cells = cells or ("prisms" if inclusions else suited_cells(resolution, design, breaks))
        order, grading = discretisation(resolution, design, cells)
        mesh = stored_mesh(design, grading, cells, breaks, inclusions)
        try:
            self._begin(design, mesh, order, solver)
        except MemoryLimitError as error:
            for name in faster_resolutions(resolution):
                order, grading = discretisation(name, design, cells)
                mesh = stored_mesh(design, grading, cells, breaks, inclusions)
                if fits_memory(FunctionSpace(mesh, order)):
                    raise MemoryLimitError(f"{error}; '{name}' fits this design") from None
            raise
        middles = mesh.points[mesh.cells].mean(axis=1)
        self._inclusions += [(each.contains(middles), each.conductivity) for each in inclusions]
        self._resolution, self._breaks = resolution, breaks

    @classmethod
    def from_mesh(
        cls,
        mesh: Any,
        electrodes: Sequence[str | ArrayLike] | None = None,
        conductivity: Conductivity | Mapping[str, complex] = 1.0,
        contact_impedance: ArrayLike = 1e-3,
        order: int = 2,
        thickness: float = 1.0,
    ) -> "ForwardModel":
        """Model of a body on a custom mesh.

        Triangles are a plate of `thickness`, through which currents flow in the plane: at the usual
        one metre, impedances are those of two dimensions [ohm m]. Potentials are given at the
        points of the mesh, NaN where no cell has one, and Jacobians by its cells.

        Args:
            mesh: mesh of triangles or tetrahedra, in metres: of skfem or meshio, the path of a file
                that meshio reads (gmsh, VTK ...), or a pair of points (n, 2 or 3) and cells (m, 3
                or 4).
            electrodes: electrodes of each the name of a part of the boundary, its faces (k, 2 or 3)
                or all its points (k,) by their numbers; every named part when omitted, in the order
                of names with their numbers.
            conductivity: conductivity as in `impedance`, or by the region's name [S/m].
            contact_impedance: contact impedance of the electrodes, (electrodes,), or of all of them
                [ohm m2].
            order: order of the elements, 1 or 2; up to 4 on triangles.
            thickness: thickness of triangles [m].

        Raises:
            ConfigurationError: for another mesh, parts that it does not have, and electrodes
                without a face of the boundary.
            ImportError: where a file is given and meshio is not installed.
        """
        body = MeshBody.from_mesh(mesh, electrodes, conductivity, contact_impedance, thickness)
        model = cls.__new__(cls)
        model._begin(body, body.mesh, (order,), None)
        return model

    @one_thread()
    def _begin(
        self,
        design: SensorDesign | MeshBody,
        mesh: Mesh,
        order: tuple[int, ...],
        solver: str | None,
    ) -> None:
        """Prepare matrices and solver on a mesh, as for `__init__`."""
        self.design: Any = design
        self.mesh: Mesh = mesh
        self.factorisations = 0
        self._inclusions: list[tuple[NDArray[np.bool_], complex | Dispersion]] = []
        self.assembly = Assembly(self.mesh, order)
        self.pattern = SystemPattern(self.assembly)
        positions = self.pattern.rows, self.pattern.columns
        numbers = self.assembly.space.numbers
        middles = self.assembly.points.reshape(len(numbers), -1, 3).mean(axis=1)
        name, blocks = choose_order(solver, positions, numbers, middles)
        self.solver = MultifrontalSolver(*positions, blocks, name)

    @property
    def unknowns(self) -> int:
        """Number of potential unknowns, after static condensation."""
        return self.assembly.unknowns

    def impedance(
        self,
        conductivity: Conductivity | None = None,
        area_ratio: AreaRatio | None = None,
        contact_impedance: ArrayLike | None = None,
        frequency: ArrayLike | None = None,
    ) -> Numbers:
        """Electrode impedance matrix Z [ohm], (electrodes, electrodes).

        Z maps injected currents that sum to zero to electrode potentials of zero mean: rows and
        columns of Z sum to zero. Z is complex where the conductivity or a contact impedance is.
        Changes by inclusions, unless the conductivity is given by cells, are added to Z of the
        mesh without them, so that the difference of such two models has no error of meshes.

        Args:
            conductivity: outside inclusions [S/m], a scalar, (cells,), (cells, 3, 3), or f(x) with
                x (..., 3) [m] giving (...) or (..., 3, 3); the design's own when omitted. Complex
                for an admittivity sigma + j omega epsilon, whose real part is positive; a
                `ColeCole` or a `ConductivityTable` for one by the frequency.
            area_ratio: f(x, normal), both (..., 3), giving the ratio of deformed to flat area of
                the electrodes, (...); one when omitted.
            contact_impedance: contact impedance of the electrodes, (electrodes,), or of all of them
                [ohm m2]; the design's when omitted.
            frequency: frequency of conductivities that depend on it [Hz]; 40 kHz when omitted. Z
                has further axes first for those of several frequencies.

        Raises:
            ConfigurationError: for a conductivity or contact impedance of another shape, or whose
                real part is not positive, and for a frequency beyond a table of conductivities.
        """
        arguments = conductivity, area_ratio, contact_impedance
        if np.ndim(frequency) > 0:  # type: ignore[arg-type]
            return np.array([self.impedance(*arguments, each) for each in np.asarray(frequency)])
        at = None if frequency is None else float(np.asarray(frequency))
        Z = self._impedance(arguments, at)
        by_cells = not callable(conductivity) and np.ndim(conductivity) > 0  # type: ignore[arg-type]
        if not self._inclusions or by_cells:
            return Z
        return Z + (self._plain.impedance(*arguments, at) - self._impedance(arguments, at, False))

    def _impedance(
        self, scene: tuple[Any, Any, Any], frequency: float | None, with_inclusions: bool = True
    ) -> Numbers:
        """Impedance matrix on this mesh [ohm], (electrodes, electrodes)."""
        with self.solver.threads():
            sigma = self._conductivity(scene[0], frequency, with_inclusions)
            _, system = self._system(sigma, *scene[1:])
            T = self.solver.congruence(system.values, system.coupling)
            return impedance_matrix(system.admittance, T)

    @cached_property
    def _plain(self) -> "ForwardModel":
        """Model of the design without inclusions."""
        return ForwardModel(self.design, self._resolution, self._breaks)

    @cached_property
    def flat_impedance(self) -> Numbers:
        """Impedance matrix of the flat sensor [ohm], (electrodes, electrodes), solved once."""
        return np.broadcast_to(self.impedance(), 2 * (len(self.design.electrodes),))  # read-only

    def sensitivity(
        self,
        protocol: Protocol,
        conductivity: Conductivity | None = None,
        pixels: tuple[int, int] | None = None,
        area_ratio: AreaRatio | None = None,
        along: Tensors | Numbers | None = None,
    ) -> Numbers:
        """Adjoint Jacobian d measurement / d conductivity [ohm per S/m], (measurements, cells).

        d V_m / d sigma_c = - int_c grad u_drive . S grad u_sense (Geselowitz 1971), exact for the
        discrete model. S is the identity, or the field of tensors `along` for a change of the
        conductivity by a multiple of S.

        Args:
            protocol: the measurements.
            conductivity: conductivity where the derivative is taken, as in `impedance`.
            pixels: (rows along y, columns along x) of a grid on the outline's bounding box;
                derivatives by the conductivity of pixel columns instead of cells, (measurements,
                rows * columns), row by row, x and y increasing.
            area_ratio: area ratio as in `impedance`.
            along: symmetric S(x), (..., 3, 3), for pixels; with the conductivity itself as S the
                result is per relative change [ohm]. Numbers (elements,) stand for multiples of the
                identity.

        Raises:
            ConfigurationError: for `along` without pixels.
        """
        u, _ = self.element_potentials(conductivity, area_ratio)
        if along is not None and not callable(along):
            along = np.broadcast_to(along, len(u))
            u, along = u * np.sqrt(along)[:, None, None], None
        if pixels is not None:
            gram = pixel_gram(self.assembly, self.mesh, u, self.design.outline, pixels, along)
        elif along is None:
            gram = self.assembly.cell_gram(u)
        else:
            raise ConfigurationError("expected pixels with along, got cells; give pixels")
        drive, sense = protocol.patterns()
        J: Numbers = -np.einsum("em,cef,fm->mc", drive, gram, sense, optimize=True)
        return J

    def contact_sensitivity(
        self, protocol: Protocol, conductivity: Conductivity | None = None
    ) -> Numbers:
        """Adjoint Jacobian d measurement / d contact impedance [1/m2], (measurements, electrodes).

        d V_m / d z_l = int_{E_l} j_drive j_sense with the current densities
        j = (U_l - u) / z_l (Vilhunen et al. 2002), exact for the discrete model.
        """
        gram = self.contact_gram(conductivity)
        drive, sense = protocol.patterns()
        J: Numbers = np.einsum("em,efl,fm->ml", drive, gram, sense, optimize=True)
        return J

    def contact_gram(
        self,
        conductivity: Conductivity | None = None,
        area_ratio: AreaRatio | None = None,
        contact_impedance: ArrayLike | None = None,
    ) -> Numbers:
        """Derivatives of the impedance matrix by each contact impedance [1/m2].

        Shape (electrodes, electrodes, electrodes), the contact last.

        Args:
            conductivity, area_ratio, contact_impedance: values as in `impedance`.
        """
        assembly = self.assembly
        z = self._contact_impedance(contact_impedance)
        _, system, w, U = self._solve(conductivity, area_ratio, contact_impedance)
        ratio = self._area_ratio(area_ratio)
        return assembly.contact_gram(self.contact_drops(w, U, system.lift), z, ratio)

    def contact_drops(self, w: Numbers, U: Numbers, lift: Array) -> Numbers:
        """Potential drop U - u across the contacts, (pieces, q, k), for u = w + lift U."""
        assembly = self.assembly
        rows = int(assembly.facet_numbers.max()) + 1
        require_axes("U", U, len(self.design.electrodes), None, more=False)
        require_axes("w", w, None, U.shape[1], more=False)
        require_axes("lift", lift, len(w), len(U), more=False)
        require_count("number of rows of w", len(w), rows, 1 << 30)
        on = np.einsum("fiq,fie->fqe", assembly.facet_shape, w[assembly.facet_numbers])
        # u - U_l is w itself on electrodes with a lifting function.
        own = U * (1.0 - lift.max(axis=0))[:, None]
        drops: Numbers = own[assembly.facet_electrode][:, None] - on
        return drops

    def potentials(
        self, conductivity: Conductivity | None = None, area_ratio: AreaRatio | None = None
    ) -> Numbers:
        """Potentials of `fields` at the points of the mesh, (points, electrodes) [V/A]."""
        return self.fields(conductivity, area_ratio).potentials

    def current_density(
        self,
        drive: tuple[int, int],
        conductivity: Conductivity | None = None,
        area_ratio: AreaRatio | None = None,
    ) -> Numbers:
        """Mean current density in each cell per unit drive current [1/m2], (cells, 3).

        Args:
            drive: electrodes where the current enters and leaves.
            conductivity, area_ratio: values as in `impedance`.
        """
        plus, minus = drive
        each = self.fields(conductivity, area_ratio).current_densities
        difference: Numbers = each[..., plus] - each[..., minus]
        return difference

    def fields(
        self, conductivity: Conductivity | None = None, area_ratio: AreaRatio | None = None
    ) -> Fields:
        """Potentials and current densities of all electrodes, from one factorisation.

        Arguments as for `impedance`.
        """
        u, U = self.element_potentials(conductivity, area_ratio)
        assembly, cells = self.assembly, self.mesh.cells
        weights = assembly.cell_weights
        sigma = self._conductivity(conductivity)
        if sigma.shape[-1] == 1:
            sigma = sigma * ISOTROPIC
        flux = -(sigma[..., WHOLE_TENSOR] @ assembly.cell_gradients(u))
        mean = np.einsum("cq,cqae->cae", weights, flux) / weights.sum(axis=1)[:, None, None]
        elements = np.arange(len(cells)) // assembly.space.element.cells
        X = assembly.space.reference(elements, self.mesh.points[cells])
        at_points = np.empty((len(self.mesh.points), u.shape[-1]), dtype=u.dtype)
        at_points[cells] = np.einsum(
            "ick,cie->cke", assembly.space.element.values(X), u[elements], optimize=True
        )
        if isinstance(self.design, MeshBody):
            at_points = self.design.values_on_given_mesh(at_points)
        ground = U.mean(axis=0)
        return Fields(at_points - ground, U - ground, mean)

    def element_potentials(
        self, conductivity: Conductivity | None = None, area_ratio: AreaRatio | None = None
    ) -> tuple[Numbers, Numbers]:
        """Potentials in the elements and of the electrodes, per unit electrode current [V/A].

        Returns coefficients of the shape functions, (elements, functions, electrodes), and
        potentials of the first electrode per current into the second, (electrodes, electrodes);
        the currents leave through all electrodes in equal parts. Potentials are relative to the
        grounded unknown, so that gradients keep all digits for any contact impedance.
        """
        stiffness, system, w, U = self._solve(conductivity, area_ratio)
        return self.assembly.space.in_elements(w + system.lift @ U, stiffness.inner), U

    def _own_conductivity(self, frequency: float | None) -> Conductivity:
        """Conductivity of the design [S/m]: one number, or the conductivity of each cell's layer.

        Tetrahedra cross the layers: on their meshes the conductivity is a function of position.
        """
        if not self.design.layers:
            own: Conductivity = self.design.conductivity
            return own
        field: Field = self.design.resolve_frequency(frequency).evaluate_conductivity
        middles = self.mesh.points[self.mesh.cells].mean(axis=1)
        return field if self.mesh.heights is None else np.asarray(field(middles))

    @property
    def contact_impedance(self) -> Numbers:
        """Contact impedances [ohm m2], (electrodes,); complex where any electrode's is."""
        return np.asarray(self.design.contact_impedance)

    def _area_ratio(self, area_ratio: AreaRatio | None) -> Array | float:
        """Ratio of deformed to flat area at `facet_points`; a ConfigurationError for others."""
        if area_ratio is None:
            return 1.0
        points = self.assembly.facet_points
        try:
            ratio = np.asarray(area_ratio(points, self.assembly.facet_normals))
        except TypeError as error:
            raise ConfigurationError(
                f"area_ratio: expected a function of points and normals, which failed: {error}"
            ) from error
        if ratio.dtype.kind not in "fiu" or ratio.shape not in ((), points.shape[:-1]):
            raise ConfigurationError(
                f"area_ratio: expected real numbers of the shape {points.shape[:-1]}, got "
                f"{ratio.dtype} of {ratio.shape}"
            )
        return np.broadcast_to(ratio, points.shape[:-1])

    def _system(
        self,
        sigma: Numbers,
        area_ratio: AreaRatio | None,
        contact_impedance: ArrayLike | None = None,
    ) -> tuple[Stiffness, CemSystem]:
        """Stiffness and linear system of entries of tensors; counts as a factorisation."""
        assembly = self.assembly
        ratio = self._area_ratio(area_ratio)
        z = self._contact_impedance(contact_impedance)
        contact = assembly.electrode_terms(z, ratio)
        stiffness = assembly.condense(assembly.matrices(sigma))
        self.factorisations += 1
        return stiffness, self.pattern.system(stiffness.values, contact)

    def _solve(
        self,
        conductivity: Conductivity | None,
        area_ratio: AreaRatio | None = None,
        contact_impedance: ArrayLike | None = None,
    ) -> tuple[Stiffness, CemSystem, Numbers, Numbers]:
        """Stiffness, system, w (unknowns, electrodes) and U, per unit electrode current [V/A].

        The currents leave through all electrodes in equal parts.
        """
        sigma = self._conductivity(conductivity)
        stiffness, system = self._system(sigma, area_ratio, contact_impedance)
        per_potential = self.solver.factorise(system.values).solve(system.coupling)
        T = system.coupling.T @ per_potential
        U = np.linalg.solve(system.admittance - 0.5 * (T + T.T), zero_sums(np.eye(len(T))))
        return stiffness, system, per_potential @ U, U

    def _contact_impedance(self, given: ArrayLike | None) -> Numbers:
        """Contact impedances [ohm m2], (electrodes,); the design's where none are given."""
        if given is None:
            return self.contact_impedance
        return read_contact_impedances(given, len(self.design.electrodes))

    def _conductivity(
        self,
        conductivity: Conductivity | None,
        frequency: float | None = None,
        with_inclusions: bool = True,
    ) -> Numbers:
        """Conductivity, the design's own where None, as `conductivity_entries` gives it."""
        own = self._own_conductivity(frequency) if conductivity is None else conductivity
        entries = conductivity_entries(own, self.assembly.points, len(self.mesh.cells), frequency)
        if conductivity is not None:
            warn_of_edges(entries)
        for inside, law in self._inclusions if with_inclusions else ():
            value = resolve_conductivity(law, frequency)
            kind = np.result_type(entries, value)
            entries = np.array(np.broadcast_to(entries, (len(inside), *entries.shape[1:])), kind)
            entries[inside] = value * ISOTROPIC[: entries.shape[-1]]
        return entries
