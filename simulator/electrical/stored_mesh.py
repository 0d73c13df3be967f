"""Meshes of a design; those of tetrahedra, which come out different each time, are stored."""

import hashlib
from collections.abc import Sequence
from dataclasses import astuple

from eitskin.geometry.design.inclusion import Inclusion
from eitskin.geometry.design.patches import electrode_contacts
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_design import CellKind, mesh_design, natural_cells
from eitskin.simulator.deformation.solution_store import Arrays, Problem, load_or_solve

_VERSION = 1  # raise it whenever tetrahedra are meshed in another way
_EDGE_SPACING = 1e-4  # of points by which electrodes are distinguished [m]


def stored_mesh(
    design: SensorDesign,
    grading: Grading,
    cells: CellKind | None = None,
    breaks: Sequence[float] = (),
    inclusions: Sequence[Inclusion] = (),
) -> Mesh:
    """Mesh of a design as by `mesh_design`; one of tetrahedra is made once and stored.

    fTetWild cannot be seeded, and gives another mesh each time. The stored one has the same bits
    in all processes that share a cache; it is found by the body, not by the name of its file.
    """
    if inclusions or (cells or natural_cells(design)) != "tetrahedra":
        return mesh_design(design, grading, cells, breaks, inclusions)
    outline = design.outline
    body = repr(outline).encode()
    if isinstance(outline, Surface):
        points, faces = outline.triangles()
        body = points.round(12).tobytes() + faces.tobytes()
    edges = design.edges(_EDGE_SPACING).round(12).tobytes()
    described = {
        "version": _VERSION,
        "body": hashlib.sha256(body).hexdigest(),
        "thickness": design.thickness,
        "electrodes": hashlib.sha256(edges).hexdigest(),
        "grading": list(astuple(grading)[:4]),
    }

    def solve() -> Arrays:
        mesh = mesh_design(design, grading, "tetrahedra")
        return {"points": mesh.points, "cells": mesh.cells}

    found = load_or_solve(Problem("mesh", described, lambda _: solve()), dict)
    points, corners = found["points"], found["cells"]
    return Mesh(points, corners, electrode_contacts(points, corners, design.patches()), None)
