"""Frames by pyEIT 1.2.4, whose electrodes are single nodes (Liu et al. 2018)."""

import time
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.accuracy.truth import Drop, Frame
from eitskin.extras import require
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.protocol import Protocol

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Six tetrahedra around a diagonal of a hexahedron; neighbours split shared faces alike. pyEIT
# wants them left-handed: others give it a stiffness of the wrong sign.
_TETRAHEDRA = np.array(
    [[0, 1, 6, 2], [0, 2, 6, 3], [0, 3, 6, 7], [0, 7, 6, 4], [0, 4, 6, 5], [0, 5, 6, 1]]
)
_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def is_installed() -> bool:
    """Whether pyEIT is installed."""
    return find_spec("pyeit") is not None


class PointElectrodeModel:
    """Point electrode model of a slab of tetrahedra or, averaged over the height, of triangles.

    Attributes:
        nodes: number of nodes.
        setup_seconds: what a new geometry costs, beyond making the mesh [s].
    """

    def __init__(self, design: SensorDesign, mesh: Mesh, plane: bool) -> None:
        """Split the boxes of `mesh`; each electrode is the node nearest to its centre."""
        fem, wrapper = require("pyeit.eit.fem", "bench"), require("pyeit.mesh", "bench")
        self._thickness = design.thickness if plane else 1.0
        nodes, elements = _triangles(mesh) if plane else _tetrahedra(mesh)
        height = 0.0 if plane else 0.5 * design.thickness
        centres = np.array([(e.x, e.y, height)[: nodes.shape[1]] for e in design.electrodes])
        away = np.linalg.norm(nodes - centres[:, None], axis=2)
        self.nodes = len(nodes)
        self._electrodes = away.argmin(axis=1)
        self._points = _evaluation_points(nodes[elements], design.thickness)
        start = time.process_time()
        self._forward = fem.Forward(
            wrapper.PyEITMesh(node=nodes, element=elements, el_pos=self._electrodes)
        )
        self.setup_seconds = time.process_time() - start

    def frame(self, background: float) -> Frame:
        """Function from the deformed layer to the resistances of all pairs [ohm]."""
        table = np.array(Protocol.pairwise(len(self._electrodes)).table)

        def frame(drop: Drop | None) -> Array:
            sigma = drop(self._points) if drop else np.full(self._points.shape[:2], background)
            return self._resistances(sigma.mean(axis=1), table[:, :2])

        return frame

    def _resistances(self, conductivity: Array, pairs: Indices) -> Array:
        """Resistances of all pairs [ohm], by superposition of drives from electrode 0."""
        self._forward.assemble_pde(conductivity * self._thickness)
        others = range(1, len(self._electrodes))
        driven = [self._forward.solve(np.array([0, j]))[self._electrodes] for j in others]
        from_zero = np.array([np.zeros(len(self._electrodes)), *driven])
        plus, minus = pairs.T
        potentials = from_zero[minus] - from_zero[plus]
        rows = np.arange(len(pairs))
        resistances: Array = potentials[rows, plus] - potentials[rows, minus]
        return resistances


def _tetrahedra(mesh: Mesh) -> tuple[Array, Indices]:
    return mesh.points, mesh.cells[:, _TETRAHEDRA].reshape(-1, 4)


def _triangles(mesh: Mesh) -> tuple[Array, Indices]:
    """Points of the lowest layer, and its squares cut into two triangles each."""
    levels = _levels(mesh)
    squares = mesh.cells[:: levels - 1, :4] // levels
    nodes: Array = mesh.points[::levels, :2]
    return nodes, squares[:, _TRIANGLES].reshape(-1, 3)


def _levels(mesh: Mesh) -> int:
    if mesh.heights is None or mesh.cells.shape[1] != 8:
        raise ValueError("expected a structured mesh of hexahedra")
    return len(mesh.heights)


def _evaluation_points(corners: Array, thickness: float) -> Array:
    """Points (elements, q, 3) [m] of the conductivity: centroids; over the height in the plane."""
    middles = corners.mean(axis=1)
    if middles.shape[1] == 3:
        points: Array = middles[:, None]
        return points
    heights = thickness * (np.arange(4) + 0.5) / 4.0
    points = np.empty((len(middles), len(heights), 3))
    points[..., :2], points[..., 2] = middles[:, None], heights
    return points
