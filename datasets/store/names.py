"""Names of specimens and sessions, as a recording gave them, beside the numbers of a dataset."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Names:
    """Names of specimens and sessions by their numbers; those without a name are left out.

    Attributes:
        specimens: name of a specimen, with that of its sensor where a recording tells both, by
            `Dataset.specimen_number`.
        sessions: name of a session, by the number of its episode.
    """

    specimens: dict[int, str] = field(default_factory=dict)
    sessions: dict[int, str] = field(default_factory=dict)

    @classmethod
    def of(cls, specimens: Mapping[str, int], sessions: Mapping[str, int]) -> "Names":
        """Names that say more than the numbers they stand for; both are numbers by name."""
        return cls(_telling(specimens), _telling(sessions))

    def __bool__(self) -> bool:
        """Whether there is any name."""
        return bool(self.specimens or self.sessions)

    def shifted(self, specimens: int, episodes: int) -> "Names":
        """The same names of specimens and episodes that are counted from other numbers."""
        return Names(
            {number + specimens: name for number, name in self.specimens.items()},
            {number + episodes: name for number, name in self.sessions.items()},
        )

    def joined(self, other: "Names") -> "Names":
        """Names of both; where both name a number, those of this one."""
        return Names(other.specimens | self.specimens, other.sessions | self.sessions)

    def specimen(self, number: int) -> str:
        """Name of a specimen; its number where it has none."""
        return self.specimens.get(number, str(number))


def _telling(numbers: Mapping[str, int]) -> dict[int, str]:
    return {number: name for name, number in numbers.items() if name != str(number)}
