"""What happens to a virtual board's sensor, frame by frame, and what is then measured."""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from eitskin.config import read_toml
from eitskin.errors import ConfigurationError
from eitskin.simulator.scene.scene import Scene

SceneSource = Callable[[int], Scene]
"""The scene of the frame with a given number."""


@dataclass(frozen=True, slots=True)
class Step:
    """A scene that lasts for a number of frames."""

    scene: Scene
    frames: int = 1

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ConfigurationError(f"a step lasts for at least one frame, got {self.frames}")


@dataclass(frozen=True, slots=True)
class Script:
    """Scenes that follow each other.

    Attributes:
        steps: in the order in which they are played.
        repeat: from the first again after the last; else the last one stays.
    """

    steps: tuple[Step, ...]
    repeat: bool = True

    def __post_init__(self) -> None:
        """Check that there is something to play."""
        if not self.steps:
            raise ConfigurationError("a script needs at least one step, got none")

    @classmethod
    def from_toml(cls, path: str | Path) -> "Script":
        """Read a script ([[steps]] with frames and a scene), or a scene that stays for ever."""
        path = Path(path)
        if path.is_file() and "steps" in _top_keys(path):
            return read_toml(cls, path)
        return cls((Step(Scene.from_toml(path)),))

    def __call__(self, number: int) -> Scene:
        """The scene of frame `number`."""
        total = sum(step.frames for step in self.steps)
        place = number % total if self.repeat else min(number, total - 1)
        for step in self.steps:
            if place < step.frames:
                break
            place -= step.frames
        return step.scene


def _top_keys(path: Path) -> set[str]:
    """Keys at the top of a TOML file; none where it is not TOML, which reading it will say."""
    try:
        return set(tomllib.loads(path.read_text(encoding="utf-8")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return set()
