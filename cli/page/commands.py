"""Commands of the live page: its protocol, and those to a virtual board."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

import msgspec
import numpy as np

from eitskin import hardware
from eitskin.bounds import require_in_range
from eitskin.cli.page.plan import Region
from eitskin.config import from_dict
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.bodies.pressed_body import require_over_body
from eitskin.simulator.scene.scene import Scene, Touch

Kind = TypeVar("Kind")

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


@dataclass(frozen=True, slots=True)
class SceneCommand:
    """POST /scene: the whole scene that the board measures from now on."""

    bend_deg: float = 0.0
    touches: tuple[PageTouch, ...] = ()

    def __post_init__(self) -> None:
        """Check angle and number."""
        require_in_range("bend_deg", self.bend_deg, *BEND_RANGE, "deg")
        if len(self.touches) > MAX_TOUCHES:
            raise ConfigurationError(
                f"at most {MAX_TOUCHES} touches at once, got {len(self.touches)}"
            )


@dataclass(frozen=True, slots=True)
class FaultCommand:
    """POST /fault: a fault as "name" or "name:index", or the end of all lasting faults."""

    fault: str = ""
    clear: bool = False

    def __post_init__(self) -> None:
        """Check that either a fault or its end is given."""
        if bool(self.fault) == self.clear:
            raise ConfigurationError('give either "fault", a name, or "clear": true')
        if self.fault and not re.fullmatch(r"\w{1,40}(:\d{1,6})?", self.fault):
            raise ConfigurationError(f"expected a fault as name or name:index, got {self.fault!r}")


@dataclass(frozen=True, slots=True)
class PlayCommand:
    """POST /play: begin the paper's episode, or end it with the sensor flat and untouched."""

    play: bool


@dataclass(frozen=True, slots=True)
class EnterCommand:
    """POST /enter: the token from the page's address."""

    token: str


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
    actions: Mapping[str, tuple[Any, Callable[[Any], bytes | None]]],
    act: Callable[[Callable[[Any], Any], Any], bytes | None],
) -> Commands:
    """Commands from the type of each payload and its action, which `act` calls with the payload."""

    def take(path: str, target: Any, action: Callable[[Any], Any], body: bytes) -> bytes | None:
        return act(action, read_command(target, path, body))

    return {path: partial(take, path, *action) for path, action in actions.items()}


def read_command(target: type[Kind], path: str, body: bytes) -> Kind:
    """Command that was posted to `path`; raises ConfigurationError for another body."""
    try:
        data = msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(f"expected JSON, got what is not: {error}") from error
    if not isinstance(data, Mapping):
        raise ConfigurationError(f"expected a JSON object, got {type(data).__name__}")
    return from_dict(target, data, path.lstrip("/"))


def stage_commands(board: "hardware.Board", sheet: SensorDesign | Region) -> Commands:
    """Commands to scene and faults of a virtual board; they conflict with every other board."""
    stage: Any = getattr(board, "stage", None)

    def set_scene(command: SceneCommand) -> None:
        for press in command.touches:
            _require_inside(sheet, press)
        touches = tuple(Touch(press.x, press.y, press.force) for press in command.touches)
        stage.set(Scene(Bend(command.bend_deg), touches))

    def set_fault(command: FaultCommand) -> None:
        if command.clear:
            stage.clear()
        else:
            stage.inject(command.fault)

    def play(command: PlayCommand) -> None:

        if not command.play:
            stage.set(Scene())
            return
        frames = max(1, round(STEP / (board.info.period or 1.0)))
        stage.play(hardware.Script(tuple(hardware.Step(scene, frames) for scene in STEPS)))

    def act(action: Callable[[Any], Any], command: Any) -> None:
        if stage is None:
            raise ConflictError("this board is not a virtual one and takes no commands")
        action(command)

    actions: dict[str, tuple[Any, Callable[[Any], None]]] = {
        "/scene": (SceneCommand, set_scene),
        "/fault": (FaultCommand, set_fault),
        "/play": (PlayCommand, play),
    }
    return make_commands(actions, act)


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
