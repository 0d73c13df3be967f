"""Provenance of a measurement: machine, versions, seed and date."""

import platform
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path

PACKAGES = ("eitskin", "numpy", "scipy", "scikit-fem", "pyeit")


@dataclass(frozen=True, slots=True)
class Provenance:
    """Machine, versions, seed and date of a measurement.

    Attributes:
        machine: model of the processor.
        python: version of the interpreter.
        packages: version of each package involved; "not installed" where one is absent.
        seed: seed of all random numbers.
        date: date of the measurement, ISO 8601, UTC.
    """

    machine: str
    python: str
    packages: dict[str, str]
    seed: int
    date: str

    @classmethod
    def now(cls, seed: int) -> "Provenance":
        """Provenance of a measurement on this machine, now."""
        return cls(
            machine=_processor(),
            python=platform.python_version(),
            packages=package_versions(PACKAGES),
            seed=seed,
            date=datetime.now(UTC).isoformat(timespec="minutes"),
        )

    def __str__(self) -> str:
        """All fields on one line."""
        packages = ", ".join(f"{name} {version}" for name, version in self.packages.items())
        return (
            f"{self.machine}, one core; Python {self.python}, {packages}; seed {self.seed}; "
            f"{self.date}"
        )


def _processor() -> str:
    """Model of the processor, from /proc/cpuinfo where it exists."""
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name" and value.strip():
                return value.strip()
    return platform.processor() or platform.machine()


@cache
def package_versions(packages: tuple[str, ...]) -> dict[str, str]:
    """Version of each package; "not installed" where one is absent."""
    versions = {}
    for package in packages:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions
