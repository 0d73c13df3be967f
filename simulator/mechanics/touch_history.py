"""Touches that follow each other: those on one place remember the ones before."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import hypot, inf

from eitskin.simulator.mechanics.viscoelasticity import Prony, elastic_force
from eitskin.simulator.scene.scene import Touch

_NEGLIGIBLE = 1e-3  # residual force of a released touch that is dropped, relative to its force
_INSTANT = 1e-9  # s; a touch that ends at this moment is released
_SAME_PLACE = 1e-3  # distance of touches on one place [m]


@dataclass(frozen=True, slots=True)
class HeldTouch:
    """A touch held from `start` until `end` [s]."""

    touch: Touch
    start: float
    end: float


def held_touches(steps: Iterable[tuple[float, Iterable[Touch]]]) -> list[HeldTouch]:
    """Touches of steps, each from a time on [s]; one of several steps in a row is held.

    Those of the last step have no end.
    """
    begun: dict[Touch, float] = {}
    history = []
    for time, touches in steps:
        present = dict.fromkeys(touches)
        for touch in [touch for touch in begun if touch not in present]:
            history.append(HeldTouch(touch, begun.pop(touch), time))
        for touch in present:
            begun.setdefault(touch, time)
    return history + [HeldTouch(touch, start, inf) for touch, start in begun.items()]


def recall_touches(
    history: Sequence[HeldTouch], time: float, relaxation: Prony | None
) -> tuple[Touch, ...]:
    """Touches at a time [s], held ones first; with `relaxation` also those that fade.

    Touches creep while held, and recover after their release until a thousandth of their force is
    left. Those on one place, by one indenter, are one touch with the earlier ones in `before`.
    """
    held = [each for each in history if each.start <= time < each.end]
    if relaxation is None:
        return tuple(each.touch for each in held)
    faded = [
        replace(each.touch, held=each.end - each.start, released=max(time - each.end, _INSTANT))
        for each in history
        if each.end <= time
    ]
    faded = [touch for touch in faded if _residual(touch, relaxation) > _NEGLIGIBLE]
    touches = [replace(each.touch, held=time - each.start) for each in held]
    for touch in sorted(faded, key=lambda touch: touch.released):
        for number, other in enumerate(touches):
            if _on_one_place(touch, other):
                earlier = touch.force, touch.held or 0.0, touch.released
                touches[number] = replace(other, before=(*other.before, earlier))
                break
        else:
            touches.append(touch)
    return tuple(touches)


def _residual(touch: Touch, relaxation: Prony) -> float:
    return elastic_force(relaxation, 1.0, touch.held or 0.0, touch.released)


def _on_one_place(first: Touch, second: Touch) -> bool:
    by_force = first.depth is None and second.depth is None
    near = hypot(first.x - second.x, first.y - second.y) <= _SAME_PLACE
    return near and by_force and first.indenter == second.indenter
