"""Scripts of scenes for a virtual board, frame by frame."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from eitskin.config import read_toml, toml_table
from eitskin.errors import ConfigurationError
from eitskin.input_files import read_text
from eitskin.simulator.scene.scene import Scene

SceneSource = Callable[[int], Scene]
"""Function from frame number to scene."""


@dataclass(frozen=True, slots=True)
class Step:
    """Scene that lasts for a number of frames; the flat, untouched sensor when omitted."""

    scene: Scene = field(default_factory=Scene)
    frames: int = 1

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ConfigurationError(f"a step lasts for at least one frame, got {self.frames}")


@dataclass(frozen=True, slots=True)
class Script:
    """Sequence of scenes; a function from frame number to scene.

    Attributes:
        steps: steps in the order in which they are played.
        repeat: begin again after the last step; else the last one stays.
    """

    steps: tuple[Step, ...]
    repeat: bool = True

    def __post_init__(self) -> None:
        """Require at least one step; raises ConfigurationError for none."""
        if not self.steps:
            raise ConfigurationError("a script needs at least one step, got none")

    @classmethod
    def from_toml(cls, path: str | Path) -> "Script":
        """Script of a TOML file: [[steps]] with frames and a scene, or one scene that stays."""
        path = Path(path)
        if path.is_file() and "steps" in _top_keys(path):
            return read_toml(cls, path)
        return cls((Step(Scene.from_toml(path)),))

    def __call__(self, number: int) -> Scene:
        """Scene of frame `number`."""
        total = sum(step.frames for step in self.steps)
        frame = number % total if self.repeat else min(number, total - 1)
        for step in self.steps:
            if frame < step.frames:
                break
            frame -= step.frames
        return step.scene


def _top_keys(path: Path) -> set[str]:
    """Keys at the top of a TOML file; none for other files, an error when they are read."""
    try:
        return set(toml_table(read_text(path), str(path)))
    except ConfigurationError:
        return set()
