"""Touches of a scene: their dents, depth, contact and pressure."""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import Plates
from eitskin.simulator.deformation.compared_presses import (
    NOT_VALIDATED_AFTER_BEND,
    find_cautions,
    require_compared,
    signal_error,
)
from eitskin.simulator.deformation.contact import ContactFrame
from eitskin.simulator.deformation.dents import (
    BentPresses,
    ColumnField,
    Dents,
    PlacedDent,
    TabulatedDent,
)
from eitskin.simulator.deformation.field import Field
from eitskin.simulator.deformation.node_sums import NodeSums
from eitskin.simulator.deformation.pair_corrections import pair_corrections
from eitskin.simulator.deformation.pressed_sensor import (
    DEPTH_TOLERANCE,
    DentedTouch,
    DepthSearch,
    PressedSensor,
    TouchModel,
    dent_touch,
)
from eitskin.simulator.deformation.solved_correction import Correction
from eitskin.simulator.deformation.tabled_corrections import (
    correction_problems,
    corrections,
    rectangle_sums,
)
from eitskin.simulator.scene.indenters import Footprint
from eitskin.simulator.scene.scene import AnyIndenter, PressedTouch, Touch, neighbour_distance

Array = NDArray[np.float64]

_TRIED_PARTS = 0.45, 0.9  # of the deepest dent of a table, by which deeper ones are foreseen
_MOST_SEARCHED = 10  # dents tried in a search for given depths


def dents(
    scenes: Sequence[tuple[Touch, ...]], sensors: Sequence[PressedSensor]
) -> Sequence[Dents | BentPresses]:
    """Deformations of the gel by the touches of each scene, which do not depend on other scenes.

    Each scene has a sensor; they differ in the angle of their plates alone, and all are bent or
    none is. Those of a sensor that plates have bent include its bend. Raises ConfigurationError for
    presses beyond the range of the model.
    """
    dented = [_solve_dents(*each) for each in zip(scenes, sensors, strict=True)]
    bends = [sensor.bend for sensor in sensors]
    frames = [
        None if bend is None else _frames(one, sensor, bend)
        for one, sensor, bend in zip(dented, sensors, bends, strict=True)
    ]
    tabulated = [n for n, one in enumerate(dented) if one.solved is None]
    summed = _interpolate_corrections(
        [dented[n] for n in tabulated],
        [sensors[n] for n in tabulated],
        [frames[n] for n in tabulated],
    )
    presses: list[Dents | BentPresses] = []
    for one, bend, own in zip(dented, bends, frames, strict=True):
        fields = next(summed) if one.solved is None else (one.solved,)
        tops = (None,) * len(one.parts) if own is None else own[: len(one.parts)]
        placed = Dents(
            tuple(
                PlacedDent(touch.x, touch.y, dent, top)
                for (_, touch, dent), top in zip(one.parts, tops, strict=True)
            ),
            fields,
        )
        presses.append(placed if bend is None else BentPresses(bend, placed))
    return presses


def _frames(scene: "_DentedScene", sensor: PressedSensor, bend: Deformation) -> list[ContactFrame]:
    """Frames of the bent top at the parts of a scene, and in the middles of pairs by tables."""
    places = np.array([(touch.x, touch.y) for _, touch, _ in scene.parts]).reshape(-1, 2)
    if scene.solved is not None:
        return sensor.frames(sensor.state or bend, places)
    middles = [(places[a] + places[b]) / 2.0 for a, b in scene.pairs]
    return sensor.frames(bend, np.stack([*places, *middles])) if len(places) else []


class _DentedScene(NamedTuple):
    """Touches of a scene with their dents.

    Attributes:
        touches: touches as they press.
        sunk: length by which each indenter sinks deeper than its dent [m], if prescribed or wanted.
        solved: correction that was solved for this scene alone; None for one by tables.
    """

    touches: list[DentedTouch]
    sunk: Array
    solved: Correction | None = None

    @property
    def parts(self) -> list[tuple[int, Touch, TabulatedDent]]:
        """Numbers of touches whose dents have not faded, the touches, and the dents."""
        return [(n, each.touch, each.dent) for n, each in enumerate(self.touches) if each.dent]

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Pairs of the parts that are of different touches."""
        numbers = [n for n, *_ in self.parts]
        every = combinations(range(len(numbers)), 2)
        return [(a, b) for a, b in every if numbers[a] != numbers[b]]


def _solve_dents(
    touches: tuple[Touch, ...], sensor: PressedSensor, with_depths: bool = False
) -> _DentedScene:
    """Dents of touches, and how deep indenters sink; corrections where they have no tables."""
    search = DepthSearch(touches, sensor.design)
    for _ in range(_MOST_SEARCHED):
        dented = [
            dent_touch(touch, float(depth), sensor)
            for touch, depth in zip(touches, search.depths, strict=True)
        ]
        scene = _DentedScene(dented, np.zeros(len(touches)))
        presses = {n: each.press for n, each in enumerate(dented) if each.press is not None}
        # As their dents, so that forces are not looked up once more.
        acting = tuple(touches[n] if touches[n].depth else press for n, press in presses.items())
        if acting and resolve_touch_model(acting, sensor) == "solved":
            _require_carried(dented, sensor)
            solved = sensor.solve(tuple(presses.values()))
            scene = scene._replace(solved=solved)
            scene.sunk[list(presses)] = solved.sunk
        elif acting and (with_depths or search.is_needed):
            scene.sunk[list(presses)] = _evaluate([scene], [sensor], None)[1]
        if search.advance(np.array([each.depth for each in dented]), scene.sunk):
            return scene
    raise ConfigurationError(
        f"no dents take these indenters to their depths within {DEPTH_TOLERANCE:.1%}; press less "
        "deep, or prescribe forces"
    )


def _interpolate_corrections(
    scenes: list[_DentedScene],
    sensors: list[PressedSensor],
    frames: list[list[ContactFrame] | None],
) -> Iterator[tuple[ColumnField, ...]]:
    """Corrections of the dents of each scene by tables.

    On bent plates those of a rigid base are turned to the bent gel, each press and each pair on its
    own, at its middle; what plates change is not turned.
    """
    pressed = [scene for scene in scenes if scene.parts]
    if not pressed:
        return iter([()] * len(scenes))
    turns = None
    if sensors[0].is_bent:
        tops = [(own or [], len(one.parts)) for own, one in zip(frames, scenes, strict=True)]
        parts = [frame.rotation for own, count in tops for frame in own[:count]]
        turns = np.array(parts + [frame.rotation for own, count in tops for frame in own[count:]])
    sums, scales = _scene_sums(pressed[0], len(scenes), sensors[0])
    fields: list[list[ColumnField]] = [[] for _ in scenes]
    for owner, field in _evaluate(scenes, sensors, sums, turns, scales)[0]:
        fields[owner].append(field)
    summed = sums.fields(sensors[0].design.thickness, scales) if sums else [None] * len(scenes)
    return iter(
        [
            (*own, *([total] if total is not None and scene.parts else []))
            for scene, own, total in zip(scenes, fields, summed, strict=True)
        ]
    )


def _scene_sums(
    scene: _DentedScene, count: int, sensor: PressedSensor
) -> tuple[NodeSums | None, Array]:
    """Sums of fields of scenes where there are such, and factors of their components."""
    design, mechanics, _, grid, plates = sensor
    table = corrections(design, mechanics, scene.parts[0][1].indenter, grid)
    components = 4 if mechanics.piezoresistivity.pressure else 3
    needs_sums = table.strip or plates is not None
    return rectangle_sums(design, count, components) if needs_sums else None, table.scales


def _evaluate(
    scenes: list[_DentedScene],
    sensors: list[PressedSensor],
    sums: NodeSums | None,
    turns: Array | None = None,
    scales: Array | None = None,
) -> tuple[list[tuple[int, Field]], Array]:
    """Fields that are not in the sums, and by what the parts of scenes sink deeper [m].

    Each field comes with the number of its scene. Turns (n, 3, 3) are those of all parts, then of
    all pairs; sums hold components over scales (k,).
    """
    design, mechanics, _, grid, plates = sensors[0]
    presses = [(k, t, dent) for k, one in enumerate(scenes) for _, t, dent in one.parts]
    count, owners = len(presses), np.array([k for k, *_ in presses])
    places = np.array([(t.x, t.y, dent.depth) for _, t, dent in presses])
    starts = np.cumsum([0] + [len(one.parts) for one in scenes]).tolist()
    index_pairs = [
        (start + a, start + b)
        for start, one in zip(starts, scenes, strict=False)
        for a, b in one.pairs
    ]
    scaled = None
    if turns is not None and scales is not None:
        scaled = (turns * scales[:3] / scales[:3, None]).astype(np.float32)
    fields: list[tuple[int, Field]] = []

    def add_field(owner: int, number: int, field: Field) -> None:
        fields.append((owner, field if turns is None else field.rotate(turns[number])))

    extra = np.zeros(count)
    # In an order that does not depend on other scenes.
    for indenter in sorted({t.indenter for _, t, _ in presses}, key=repr):
        here = np.flatnonzero([t.indenter == indenter for _, t, _ in presses])
        table = corrections(design, mechanics, indenter, grid)
        own = None if scaled is None else scaled[here]
        press_fields, extra[here] = table.evaluate(places[here], owners[here], sums, own)
        for n, each in zip(here.tolist(), press_fields, strict=True):
            for field in each:
                add_field(int(owners[n]), n, field)
        if plates is not None:
            angles = np.array([0.0 if s.plates is None else s.plates.angle_deg for s in sensors])
            at = places[here], angles[owners[here]], owners[here]
            extra[here] += plates.evaluate(indenter, *at, sums)
    # Between different indenters the change is that by those of the smaller one's kind.
    pairs: dict[AnyIndenter, list[tuple[int, int, int]]] = {}
    for number, (first, second) in enumerate(index_pairs):
        kinds = (presses[n][1].indenter for n in (first, second))
        some = pairs.setdefault(min(kinds, key=lambda i: i.rims[1]), [])
        some.append((first, second, count + number))
    for indenter, some in sorted(pairs.items(), key=lambda each: repr(each[0])):
        one, other, numbers = np.array(some).T
        changes = pair_corrections(design, mechanics, indenter, grid)
        own = None if scaled is None else scaled[numbers]
        pair_fields, deeper = changes.evaluate(places[one], places[other], owners[one], sums, own)
        for end in (one, other):
            np.add.at(extra, end, deeper)
        for n, number, change in zip(one.tolist(), numbers.tolist(), pair_fields, strict=True):
            if change is not None:
                add_field(int(owners[n]), number, change)
    return fields, extra


def require_model(touches: tuple[Touch, ...], sensor: PressedSensor) -> None:
    """Raise ConfigurationError for tables of touches whose corrections cannot be tabulated.

    So do touches that are like none compared.
    """
    require_compared(touches, sensor.design, sensor.mechanics)
    if touches and sensor.model == "tabulated" and not sensor.is_tabulable:
        outline = type(sensor.design.outline).__name__.lower()
        raise ConfigurationError(
            "presses are tabulated on plane outlines of at least twice the thickness of their "
            f"stack, on the support 'rigid', 'plates' or a substrate, got a {outline} on "
            f"{sensor.design.support}; leave the touch model out, or let it be 'solved'"
        )


def resolve_touch_model(touches: tuple[Touch, ...], sensor: PressedSensor) -> TouchModel:
    """Way to the corrections of touches: the model, or by tables where all of them ship.

    Footprints have no tables.
    """
    if any(isinstance(touch.indenter, Footprint) for touch in touches):
        return "solved"
    if sensor.model is not None:
        return sensor.model
    pairs = len(touches) > 1
    shipped = [_corrections_ship(sensor, each, pairs) for each in {t.indenter for t in touches}]
    return "tabulated" if all(shipped) and _plates_reach(touches, sensor) else "solved"


def _corrections_ship(sensor: PressedSensor, indenter: AnyIndenter, pairs: bool) -> bool:
    """Whether all tables of corrections come with the package, those of pairs if wanted."""
    design, mechanics, _, grid, plates = sensor
    if not sensor.is_tabulable:
        return False
    problems = list(correction_problems(design, mechanics, indenter, grid, pairs))
    problems += [] if plates is None else [plates.problem(indenter)]
    return all(problem.is_shipped for problem in problems)


def _plates_reach(touches: tuple[Touch, ...], sensor: PressedSensor) -> bool:
    """Whether touches are within the tables of their plates, where there are such.

    Dents are at most as deep as their touches.
    """
    if sensor.plates is None:
        return True
    depths = (touch.depth or dent_touch(touch, 0.0, sensor).depth for touch in touches)
    return all(
        depth <= sensor.plates.deepest(touch.indenter, touch.x)
        for touch, depth in zip(touches, depths, strict=True)
    )


def _require_carried(touches: list[DentedTouch], sensor: PressedSensor) -> None:
    """Raise ConfigurationError for presses that take a stack over a gap deeper than it is thick.

    No such press was ever compared, and one takes up to an hour to solve. Depths grow faster with
    the force than the quadratic through those of two tabulated dents.
    """
    design, plates = sensor.design, sensor.plates
    if plates is None or not isinstance(design.support, Plates):
        return
    start, end = design.support.gap(design.outline)
    thickness = design.encapsulated_thickness
    for touch, dent in ((each.touch, each.dent) for each in touches if each.dent is not None):
        if not start < touch.x < end:
            continue
        least, advice = touch.depth or 0.0, "press less deep"
        deepest = plates.deepest(touch.indenter, touch.x)
        tabulated = _corrections_ship(sensor, touch.indenter, pairs=False)
        if tabulated and touch.depth is None and dent.depth > deepest > 0.0:
            tried = [
                Touch(touch.x, touch.y, indenter=touch.indenter, depth=part * deepest)
                for part in _TRIED_PARTS
            ]
            dented = [dent_touch(each, each.depth or 0.0, sensor) for each in tried]
            scenes = [_DentedScene([each], np.zeros(1)) for each in dented]
            sunk = _evaluate(scenes, [sensor] * len(scenes), None)[1]
            forces = np.array([each.dent.force for each in dented if each.dent])
            depths = np.array([each.depth for each in dented]) + sunk
            linear, square = np.linalg.solve(np.stack([forces, forces**2], axis=1), depths)
            if square < 0.0:  # next to a plate, which carries a part
                continue
            least = linear * dent.force + square * dent.force**2
            most = 2.0 * thickness / (linear + math.sqrt(linear**2 + 4.0 * square * thickness))
            advice = f"press with at most {math.floor(10.0 * most) / 10.0:g} N"
        if least > thickness:
            raise ConfigurationError(
                f"at ({touch.x:g}, {touch.y:g}) m over the gap between plates the sensor would "
                f"sink {1e3 * least:.3g} mm, more than its thickness of {1e3 * thickness:g} mm, "
                f"which was never compared; {advice} there, or farther from the gap's middle"
            )


def pressed_touches(
    touches: tuple[Touch, ...],
    sensor: PressedSensor,
    bent_after: bool = False,
    compared: bool = False,
) -> tuple[PressedTouch, ...]:
    """Depth, contact and pressure of each touch, on a flat sensor or one bent by its plates.

    `bent_after` says that the pressed sensor is bent, rolled or twisted afterwards, and `compared`
    that this is like cases that were compared with presses of the bent sensor.
    """
    all_pressed = []
    scene = _solve_dents(touches, sensor, with_depths=True)
    holding = iter(() if scene.solved is None else scene.solved.holding.tolist())
    for each, sunk in zip(scene.touches, scene.sunk.tolist(), strict=True):
        touch, dent, force = each.touch, each.dent, each.force
        edge = float(sensor.design.outline.nearest(np.array([touch.x, touch.y]))[1])
        neighbour = neighbour_distance(touch, touches)
        depth = each.depth + sunk
        deepest = sensor.plates.deepest(touch.indenter, touch.x) if sensor.plates and dent else 0.0
        part = dent.depth / deepest if dent and deepest else 1.0
        error = signal_error(touch, edge, sensor.design, part, bent_after)
        about = edge, neighbour, depth, sensor.design, sensor.mechanics
        cautions = find_cautions(touch, *about)
        cautions += [NOT_VALIDATED_AFTER_BEND] * (bent_after and not compared)
        radius, pressure, thinning = 0.0, 0.0, 0.0
        if each.press is not None and scene.solved is not None:
            elastic, peak, touching = next(holding)
        if dent is not None:
            radius, thinning = dent.contact_radius, dent.thinning
            pressure = dent.peak_pressure * force / dent.force
        elif each.press is not None and scene.solved is not None:
            radius = math.sqrt(touching) * touch.indenter.rims[1]
            thinning = scene.solved.thinning(touch.x, touch.y)
            force *= elastic if touch.depth is not None else 1.0
            pressure = peak * force / elastic
        all_pressed.append(
            PressedTouch(
                touch=touch,
                force=force,
                depth=depth,
                contact_radius=radius if force > 0.0 else 0.0,  # a dent, but no contact
                peak_pressure=pressure,
                thinning=thinning,
                edge_distance=edge,
                neighbour_distance=neighbour,
                signal_error=None if cautions else error,
                caution="; ".join(cautions),
            )
        )
    return tuple(all_pressed)
