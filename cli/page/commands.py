"""Commands of the live page: its protocol, and those to a virtual board."""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import msgspec
import numpy as np

from eitskin import hardware
from eitskin.bounds import require_in_range
from eitskin.cli.page.drawing import Region
from eitskin.config import Location, build
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.bodies.pressed_body import require_over_body
from eitskin.simulator.scene.scene import Scene, Touch

MAX_TOUCHES = 4
STEP = 3.0  # duration of each step of the episode [s]
_SPREAD = (Touch(0.025, 0.018), Touch(0.050, 0.042), Touch(0.100, 0.042), Touch(0.125, 0.018))
_OTHERS = (Touch(0.025, 0.042), Touch(0.060, 0.018), Touch(0.090, 0.042), Touch(0.125, 0.018))
STEPS = (  # the paper's real-time episode: touches at four bends
    Scene(),
    Scene(Bend(-10.0)),
    Scene(Bend(-10.0), (Touch(0.040, 0.020), Touch(0.110, 0.040))),
    Scene(Bend(20.0)),
    Scene(Bend(20.0), (Touch(0.030, 0.040), Touch(0.075, 0.018), Touch(0.120, 0.040))),
    Scene(Bend(40.0)),
    Scene(Bend(40.0), _SPREAD),
    Scene(),
    Scene(touches=_OTHERS),
)


BEND_RANGE, FORCE_RANGE = (-30.0, 60.0), (1.0, 12.0)  # deg, N


@dataclass(frozen=True, slots=True)
class PageTouch:
    """Touch on the page: position on the flat sensor [m] and force [N]."""

    x: float
    y: float
    force: float

    def __post_init__(self) -> None:
        """Check the force; the position is checked with the sensor."""
        require_in_range("force", self.force, *FORCE_RANGE, "N")


class ConflictError(ConfigurationError):
    """A command that is valid, but not possible now or with this board."""


class SessionCommands(Protocol):
    """Commands to a live session."""

    @property
    def commands(self) -> "Commands":
        """Commands by path."""

    def state(self) -> Mapping[str, Any]:
        """Plain data of what is being done, and of what may be asked for."""


Commands = Mapping[str, Callable[[bytes], bytes | None]]
"""Function of each path that is posted to, from the body to the JSON of its answer.

May raise ConfigurationError. Without an answer the browser learns that it was done.
"""


def make_commands(
    actions: Mapping[str, Callable[..., bytes | None]],
    act: Callable[[Callable[[], Any]], bytes | None] = lambda action: action(),
) -> Commands:
    """Commands whose bodies are the arguments of an action, which `act` calls."""

    def take(path: str, action: Callable[..., Any], body: bytes) -> bytes | None:
        return act(partial(action, **read_arguments(action, path, body)))

    return {path: partial(take, path, action) for path, action in actions.items()}


def read_arguments(action: Callable[..., Any], path: str, body: bytes) -> dict[str, Any]:
    """Arguments of an action in a body posted to `path`; raises ConfigurationError for others."""

    def collect(**given: Any) -> dict[str, Any]:
        return given

    collect.__signature__ = inspect.signature(action, eval_str=True)  # type: ignore[attr-defined]
    try:
        data = msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(f"expected JSON, got what is not: {error}") from error
    if not isinstance(data, Mapping):
        raise ConfigurationError(f"expected a JSON object, got {type(data).__name__}")
    return build(collect, data, Location(path.lstrip("/")))


def stage_commands(board: "hardware.Board", sheet: SensorDesign | Region) -> Commands:
    """Commands to scene and faults of a virtual board; they conflict with every other board."""
    stage: Any = getattr(board, "stage", None)

    def set_scene(bend_deg: float = 0.0, touches: tuple[PageTouch, ...] = ()) -> None:
        require_in_range("bend_deg", bend_deg, *BEND_RANGE, "deg")
        if len(touches) > MAX_TOUCHES:
            raise ConfigurationError(f"at most {MAX_TOUCHES} touches at once, got {len(touches)}")
        for press in touches:
            _require_inside(sheet, press)
        pressed = tuple(Touch(press.x, press.y, press.force) for press in touches)
        stage.set(Scene(Bend(bend_deg), pressed))

    def set_fault(fault: str = "", clear: bool = False) -> None:
        if bool(fault) == clear:
            raise ConfigurationError('give either "fault", a name, or "clear": true')
        if fault and not re.fullmatch(r"\w{1,40}(:\d{1,6})?", fault):
            raise ConfigurationError(f"expected a fault as name or name:index, got {fault!r}")
        if clear:
            stage.clear()
        else:
            stage.inject(fault)

    def play_episode(play: bool) -> None:
        if not play:
            stage.set(Scene())
            return
        frames = max(1, round(STEP / (board.info.period or 1.0)))
        stage.play(hardware.Script(tuple(hardware.Step(scene, frames) for scene in STEPS)))

    def act(action: Callable[[], Any]) -> None:
        if stage is None:
            raise ConflictError("this board is not a virtual one and takes no commands")
        action()

    return make_commands({"/scene": set_scene, "/fault": set_fault, "/play": play_episode}, act)


def _require_inside(sheet: SensorDesign | Region, press: PageTouch) -> None:
    region = sheet if isinstance(sheet, Region) else Region.from_design(sheet)
    area = sheet if isinstance(sheet, Region) else sheet.outline
    if isinstance(area, Surface):
        require_over_body(area, Touch(press.x, press.y, press.force))
    elif not area.contains(np.array([press.x, press.y])):
        raise ConfigurationError(
            f"touches are on the sensor, {region.length:g} x {region.width:g} m, got one at "
            f"({press.x:g}, {press.y:g}) m"
        )
