"""Questions to the person at a sensor, and what is told of it meanwhile."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import typer

from eitskin.cli.options import Output


class Dialogue(Protocol):
    """Way to the person at a sensor: a terminal, or a page."""

    def ask(
        self, text: str, choices: Mapping[str, str], place: tuple[float, float] | None = None
    ) -> str:
        """Wait for the answer to a question.

        Args:
            text: the question.
            choices: words of the possible answers, by answer; an empty answer comes first. Empty
                where the answer may be anything.
            place: position on the sensor that the question is about [m].
        """

    def note(self, text: str) -> None:
        """Tell what is done, or what came of it."""

    def sketch(self, text: str) -> None:
        """Show a map in letters, where places are not shown otherwise."""


@dataclass(frozen=True, slots=True)
class TerminalDialogue(Dialogue):
    """Dialogue in the terminal: Enter, or a letter and Enter."""

    output: Output

    def ask(
        self,
        text: str,
        choices: Mapping[str, str],
        place: tuple[float, float] | None = None,  # noqa: ARG002
    ) -> str:
        keys = ", ".join(f"{key or 'Enter'}: {words}" for key, words in choices.items())
        shown = f"{text} ({keys})" if keys else text
        typed = str(typer.prompt(shown, "", show_default=False, err=True)).strip()
        return typed.lower() if choices else typed  # a port's name may have capitals

    def note(self, text: str) -> None:
        self.output.note(text)

    def sketch(self, text: str) -> None:
        self.output.note(text)
