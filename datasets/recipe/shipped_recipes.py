"""Recipes that come with eitskin: their folder and names; loads nothing else."""

from pathlib import Path

SHIPPED = Path(__file__).parent / "shipped"


def shipped_names() -> tuple[str, ...]:
    """Names of the recipes that come with eitskin."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))
