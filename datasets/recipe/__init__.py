"""Recipes: description of datasets, and random sampling of specimens, scenes and episodes.

A `recipe` has `specimen`s, `scene_group`s and `episode`s; `frame_sampling` draws frame i from them.
"""

from pathlib import Path

SHIPPED_FOLDER = Path(__file__).parent / "shipped"


def shipped_names() -> tuple[str, ...]:
    """Names of the recipes that come with eitskin; loads nothing else."""
    return tuple(sorted(path.stem for path in SHIPPED_FOLDER.glob("*.toml")))
