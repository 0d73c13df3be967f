"""Wrong and extreme arguments of the public functions, classes and methods."""

import contextlib
import enum
import functools
import importlib
import inspect
import itertools
import random
import types
import typing
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.datasets import Recipe, State
from eitskin.errors import EitskinError
from eitskin.geometry import (
    Bend,
    Hinge,
    Polygon,
    Roll,
    SensorDesign,
    Twist,
)
from eitskin.hardware import Counts, Script, Stage, Step
from eitskin.simulator import (
    ForwardModel,
    FourTerminalMeter,
    Frame,
    Instrument,
    Mechanics,
    Protocol,
    Scene,
    Simulator,
    Touch,
)
from eitskin.training import (
    FrameLabel,
    PixelGrid,
    Reconstructor,
    Regularisation,
    StoredReference,
    TouchLabel,
    TrainingSettings,
    Zero,
    open_pipeline,
)
from eitskin.training.pipeline.saved_form import SHIPPED_PATH

import small_dataset

ROOMS = ("geometry", "simulator", "datasets", "training", "hardware")
NUMBERS = (0, -1, 1, 2**31, 2**63, 10**30, 10**400, -(10**400), 0.0, -0.0, 1e300, -1e300, 5e-324)
ODD = (float("nan"), float("inf"), -float("inf"), 1 + 2j, complex("nan"), True, None, np.float32(1))
TEXTS = ("", "a", "\0", "a" * 300, b"a", "-1", "nan", "\ud800", Path("a" * 300))
OBJECTS = ((), [], {}, {"a": 1}, {1}, [[1], [2, 3]], range(5), ..., Decimal("1e400"), np.int8(-1))
ARRAYS = (
    *(np.zeros(0), np.array(np.nan), np.zeros((2, 3)), np.full(28, np.nan), np.ones(28) * 1j),
    *(np.array(["a"]), np.array([None]), np.full((3, 28), 1e300), np.arange(28) - 5, np.zeros(28)),
    *(np.ma.masked_equal(np.arange(28), 3), np.ma.ones(28), np.datetime64("2026-01-01")),
)
SIMPLE: dict[Any, list[Any]] = {
    int: [1, 4, 8, 28],
    float: [0.01, 0.03, 1.0, 40.0],
    bool: [True, False],
    complex: [0.1, 1e-3 + 1e-4j],
    str: ["pairwise:8", "a"],
    type(None): [None],
    np.ndarray: [np.full(28, 500 + 1j), np.ones((3, 28)), np.full((1, 3), 0.03), np.ones(8)],
}


@functools.cache
def foreign() -> tuple[Any, ...]:
    """Values of other libraries."""
    found: list[Any] = []
    with contextlib.suppress(ImportError):
        import pandas

        found += [pandas.Series(np.ones(28)), pandas.DataFrame(np.ones((3, 28))), pandas.NA]
    with contextlib.suppress(ImportError):
        import torch

        found += [torch.ones(28), torch.ones(28, requires_grad=True), torch.tensor(1.5)]
    return tuple(found)


@functools.cache
def sound() -> dict[type, list[Any]]:
    """Sound values by type."""
    protocol, design = Protocol.pairwise(8), SensorDesign.reference()
    frames = [Frame(np.linspace(400, 820, 28) + 0j, protocol, 0.1 * n, n) for n in range(4)]
    pipeline = open_pipeline(SHIPPED_PATH)
    data = small_dataset.make(12, design=design)
    simulator = Simulator(design, resolution="coarse", fixture=Hinge())
    model = ForwardModel(design, "coarse")
    grid = PixelGrid.from_outline(design.outline, 100)
    scene = Scene(Bend(10.0), (Touch(0.05, 0.03, 2.0),))
    reference = StoredReference(frames[0].impedance, protocol, 40e3, Zero.FLAT, 5, 1e-4, "2026")
    stage = Stage(simulator.impedance_matrix)
    stage.set(Scene())
    values = [
        *(protocol, design, *frames, pipeline, data, simulator, model, grid, scene, reference),
        *(Bend(10.0), Hinge(), Roll(3.0), Twist(3.0), design.outline, design.electrodes[0], stage),
        *(Polygon(((0.0, 0.0), (0.1, 0.0), (0.1, 0.1))), model.mesh, model.mesh.contacts),
        *(scene.touches[0], scene.touches[0].indenter, Instrument.ad5940(), Mechanics()),
        *(FourTerminalMeter(1e-5, 1e-5), Recipe.from_shipped("quick"), Step(Scene(), 2)),
        *(Script((Step(Scene(), 2),)), TrainingSettings(), FrameLabel(1.0), TouchLabel(0.05, 0.02)),
        *(Reconstructor(design, protocol, pixels=100), Regularisation("lambda", 0.1)),
        *(pipeline.layout, np.random.default_rng(0), State.TOUCH, Zero.FLAT, Counts()),
    ]
    table: dict[type, list[Any]] = {}
    for value in values:
        for kind in type(value).__mro__[:-1]:
            table.setdefault(kind, []).append(value)
    return table


@functools.cache
def calls() -> list[tuple[str, Callable[..., Any]]]:
    """Every public function, class and method with parameters, by its name."""
    found: list[tuple[str, Any]] = []
    for room in ROOMS:
        package = importlib.import_module(f"eitskin.{room}")
        for name in package.__all__:
            public = getattr(package, name)
            if inspect.isfunction(public):
                found.append((name, public))
            if not inspect.isclass(public) or issubclass(public, BaseException | enum.Enum | float):
                continue
            if not getattr(public, "_is_protocol", False) and not inspect.isabstract(public):
                found.append((name, public))
            owner = sound().get(public, [public])[0]
            for key in dir(public):
                static = inspect.getattr_static(public, key)
                bound = isinstance(static, classmethod | staticmethod) or (
                    owner is not public and inspect.isfunction(static)
                )
                if bound and not key.startswith("_") and key not in ("expanded", "fit"):
                    found.append((f"{name}.{key}", getattr(owner, key)))
    return [each for each in found if _parameters(each[1])]


def _parameters(call: Any) -> list[inspect.Parameter]:
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [p for p in inspect.signature(call).parameters.values() if p.kind not in kinds]


def good(kind: Any, name: str, rng: random.Random, folder: Path) -> Any:
    """Value of an annotation, as sound as can be."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    one = functools.partial(good, name=name, rng=rng, folder=folder)
    if name in ("path", "folder", "out", "file", "folders"):
        return folder / rng.choice(("set", "none", "new"))
    if name in ("uri", "text", "form", "rule"):
        return rng.choice(("virtual:?speed=max&resolution=coarse", "pairwise:8", "csv", "lambda"))
    if origin in (typing.Literal, typing.Union, types.UnionType):
        found = rng.choice(inner)
        return found if origin is typing.Literal else one(found)
    if origin is tuple and inner[1:] != (...,):
        return tuple(map(one, inner))
    if origin in (tuple, list) or "Sequence" in str(origin) or "Iterable" in str(origin):
        return tuple(one(inner[0]) for _ in range(rng.randrange(4)))
    known = origin or kind
    return rng.choice(SIMPLE.get(known) or sound().get(known) or ARRAYS)


def wrong(value: Any, rng: random.Random) -> Any:
    """Another value: extreme, of another type or library, or of another part of the package."""
    if rng.random() < 0.5:
        if isinstance(value, np.ndarray) and value.ndim * value.size and value.dtype.kind in "fciu":
            changed = value * (1.0 if value.dtype.kind != "c" else 1.0 + 0j)
            changed.flat[rng.randrange(changed.size)] = rng.choice((np.nan, np.inf, -1.0, 1e300))
            forms = (changed, changed.T, changed[..., :-1], changed[None], changed.tolist())
            return rng.choice(forms)
        if isinstance(value, tuple) and value:
            items = list(value)
            items[rng.randrange(len(items))] = wrong(rng.choice(items), rng)
            return rng.choice((tuple, list))(items)
    objects = rng.choice(sound()[rng.choice(list(sound()))])
    pools = (NUMBERS, ODD, TEXTS, OBJECTS, ARRAYS, foreign(), (objects,))
    return rng.choice(rng.choice(pools))


def attack(rng: random.Random, folder: Path) -> None:
    """Call one public name with at least one wrong argument; raises what is no refusal."""
    name, call = rng.choice(calls())
    parameters, given = _parameters(call), {}
    chosen, hints = rng.choice(parameters), _hints(call)
    for each in parameters:
        optional = each.default is not each.empty and each is not chosen
        if optional and rng.random() < 0.7:
            continue
        value = good(hints.get(each.name, Any), each.name, rng, folder)
        is_wrong = each is chosen or rng.random() < 0.15
        given[each.name] = wrong(value, rng) if is_wrong else value
    try:
        names = [p.name for p in parameters if p.kind is p.POSITIONAL_ONLY and p.name in given]
        result = call(*map(given.pop, names), **given)
        if hasattr(result, "__next__"):
            list(itertools.islice(result, 3))
        if hasattr(result, "close"):
            result.close()
    except (EitskinError, ImportError):
        pass
    except Exception as error:
        named = isinstance(error, TypeError | ValueError) and any(n in str(error) for n in given)
        if not named:
            error.add_note(f"{name}({given!r:.500})")
            raise


def _hints(call: Any) -> dict[str, Any]:
    """Types of the parameters, as far as they are known while it runs."""
    try:
        return typing.get_type_hints(call.__init__ if isinstance(call, type) else call)
    except NameError:
        return {}
