"""Store of bent and pressed bodies, in memory and on disk."""

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.bodies.clamped_body import BentBody, ClampedBody
from eitskin.simulator.bodies.pressed_body import BodyPress, PressedBody
from eitskin.simulator.bodies.tetrahedral_field import TetrahedralField
from eitskin.simulator.bodies.tetrahedral_solid import surface_of
from eitskin.simulator.mechanics import solved_files
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]
Solved = TypeVar("Solved", BentBody, PressedBody)

# Version of the solutions: raise it whenever bodies are meshed or solved in another way.
_VERSION = 1
_SAMPLES = 65  # of the indenter's profile, which identify the indenter
_FIELD = tuple(field.name for field in dataclasses.fields(TetrahedralField))


@dataclasses.dataclass(frozen=True, slots=True)
class BodyTouch:
    """Touch of a body without history: position, indenter, and force [N] or depth [m]."""

    touch: Touch
    force: float | None
    depth: float | None


def bent_body(
    design: SensorDesign, span: float, offset: float, mechanics: Mechanics, angle_deg: float
) -> BentBody:
    """Clamped body at an angle [deg]; the first time takes a minute or more.

    Raises SolidError, naming the angle reached, where no stable equilibrium is found.
    """
    path = _path("bend", design, mechanics, [span, offset, angle_deg])

    def solve() -> BentBody:
        (found,) = _clamped(design, span, offset, mechanics).equilibria([angle_deg])
        return found

    return _kept(path, BentBody, solve)


def pressed_body(
    design: SensorDesign, touches: tuple[BodyTouch, ...], mechanics: Mechanics
) -> PressedBody:
    """Body under touches; the first time takes a minute or more.

    Raises SolidError, with the fraction of the load that was carried, where no stable equilibrium
    is found.
    """
    path = _path("press", design, mechanics, [_described(touch) for touch in touches])

    def solve() -> PressedBody:
        press = BodyPress(design, [each.touch for each in touches], mechanics)
        return press.equilibrium([t.force for t in touches], [t.depth for t in touches])

    return _kept(path, PressedBody, solve)


@lru_cache(maxsize=2)
def _clamped(design: SensorDesign, span: float, offset: float, mechanics: Mechanics) -> ClampedBody:
    return ClampedBody(design, span, offset, mechanics)


_memory: dict[Path, BentBody | PressedBody] = {}
_MOST_KEPT = 16  # in memory, each of some megabytes


def _kept(path: Path, kind: type[Solved], solve: Callable[[], Solved]) -> Solved:
    """Solution from memory or disk, or solved now and stored."""
    known = _memory.get(path)
    found = known if isinstance(known, kind) else None
    if found is None:
        found = solved_files.kept(
            path, lambda: _read(path, kind), solve, lambda made: _write(path, made)
        )
    _memory.pop(path, None)
    _memory[path] = found
    while len(_memory) > _MOST_KEPT:
        _memory.pop(next(iter(_memory)))
    return found


def _path(kind: str, design: SensorDesign, mechanics: Mechanics, rest: Sequence[Any]) -> Path:
    """File of a solution, named by a hash of everything that the solution depends on."""
    points, faces = surface_of(design).triangles()
    gel = mechanics.gel
    described = {
        "version": _VERSION,
        "kind": kind,
        "surface": hashlib.sha256(points.round(12).tobytes() + faces.tobytes()).hexdigest(),
        "gel": [type(gel).__name__, *dataclasses.astuple(gel)],
        "bulk_ratio": mechanics.bulk_ratio,
        "rest": rest,
    }
    return solved_files.folder() / solved_files.file_name("body", described)


def _described(each: BodyTouch) -> list[Any]:
    touch = each.touch
    radius = touch.indenter.rims[1]
    height, slope, _ = touch.indenter.profile(np.linspace(0.0, radius, _SAMPLES))
    shape = [radius, touch.indenter.rough, height.tolist(), slope.tolist()]
    return [touch.x, touch.y, each.force, each.depth, shape]


def _read(path: Path, kind: type[Solved]) -> Solved | None:
    """Solution in a file; None where the file is absent or incomplete."""
    found = solved_files.read(path)
    names = {field.name for field in dataclasses.fields(kind)} - {"field"}
    if found is None or set(found) != names | {f"field_{name}" for name in _FIELD}:
        return None
    field = TetrahedralField(**{name: found[f"field_{name}"] for name in _FIELD})
    return kind(field=field, **{name: _plain(found[name]) for name in names})


def _plain(value: Array) -> Any:
    return value if value.ndim else float(value)


def _write(path: Path, solved: BentBody | PressedBody) -> None:
    """Store a solution if the disk can be written; otherwise it is solved again next time."""
    names = [field.name for field in dataclasses.fields(solved) if field.name != "field"]
    arrays = {name: np.asarray(getattr(solved, name)) for name in names}
    arrays |= {f"field_{name}": getattr(solved.field, name) for name in _FIELD}
    solved_files.write(path, arrays)
