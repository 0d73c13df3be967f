"""Dataset card: the README.md of an exported dataset, with the front matter of Hugging Face."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from eitskin.datasets.export.frame_table import TOUCH_FIELDS, Column
from eitskin.datasets.store.schema import State

PAPER = """@article{chen2026multitouch,
  title = {Multi-Touch and Bending Sensing Using Electrical Impedance Tomography for Robotics},
  author = {Chen, Haofeng and Himmel, Bedrich and Li, Bin and Wang, Xiaojie and Hoffmann, Matej},
  journal = {IEEE Robotics and Automation Letters},
  volume = {11},
  number = {8},
  pages = {9851--9858},
  year = {2026},
  doi = {10.1109/LRA.2026.3709063}
}"""
_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"))


@dataclass(frozen=True, slots=True)
class Card:
    """Content of a dataset card.

    Attributes:
        title: of the dataset.
        license: identifier of Hugging Face, such as cc-by-4.0.
        splits: frames and size in memory [bytes] of each split.
        origin: of all frames, as plain data.
        recipe: TOML text; empty for recordings.
        columns: of the table of frames; none for episodes.
        version: of eitskin.
    """

    title: str
    license: str
    splits: Mapping[str, tuple[int, int]]
    origin: Mapping[str, Any]
    recipe: str
    columns: Sequence[Column]
    version: str

    def text(self) -> str:
        """Content of README.md."""
        told, frames = self.origin, sum(count for count, _ in self.splits.values())
        made = "measured, and exported" if told["source"] == "measured" else "simulated"
        electrodes = f"{told['n_electrodes']} electrodes, " if told["n_electrodes"] else ""
        of_what = told["quantity"] or "values of a kind that the recording does not name"
        counts = "\n".join(f"| {name} | {count} |" for name, (count, _) in self.splits.items())
        return f"""{self._front_matter()}
# {self.title}

Frames of electrical-impedance robot skin, {made} by eitskin {self.version}. {frames} frames; \
{electrodes}{told["frequency_hz"]:g} Hz; {of_what}. SI units; degrees where a name ends in `_deg`. \
Places are those of the flat sensor, from a corner of its conductive layer.

{self._columns() if self.columns else _EPISODES}

## Splits

By specimen: no sensor is in two splits. The split of a specimen follows from a hash of its name, \
or of the seed and its number, and not from the other frames.

| split | frames |
|---|---|
{counts}

{self._recipe()}

## Checksums

`sha256sum -c SHA256SUMS` compares every file with what was written.

## Citation

```bibtex
@software{{eitskin,
  title = {{eitskin: a simulator of electrical-impedance robot skin}},
  author = {{{{The eitskin authors}}}},
  version = {{{self.version}}},
  year = {{2026}}
}}

{PAPER}
```
"""

    def _front_matter(self) -> str:
        """YAML between dashes; only names that need no quotes come into it."""
        frames = sum(count for count, _ in self.splits.values())
        size = next((name for most, name in _SIZES if frames < most), "n>1M")
        tags = ["tactile", "electrical-impedance-tomography", "robot-skin"]
        tags += [] if self.columns else ["LeRobot"]
        lines = ["---", f"license: {self.license}", "task_categories:", "- robotics", "tags:"]
        lines += [f"- {tag}" for tag in tags]
        lines += ["size_categories:", f"- {size}", "configs:", "- config_name: default"]
        if not self.columns:
            return "\n".join([*lines, "  data_files: data/*/*.parquet", "---", ""])
        lines.append("  data_files:")
        for name in self.splits:
            lines += [f"  - split: {name}", f"    path: data/{name}-*"]
        lines += ["dataset_info:", "  features:"]
        lines += [f"  {line}" for column in self.columns for line in _feature(column)]
        lines.append("  splits:")
        for name, (count, size_bytes) in self.splits.items():
            lines += [f"  - name: {name}", f"    num_bytes: {size_bytes}"]
            lines.append(f"    num_examples: {count}")
        return "\n".join([*lines, "---", ""])

    def _columns(self) -> str:
        lines = ["## Columns", "", "| column | type | units | content |", "|---|---|---|---|"]
        for each in self.columns:
            kind = f"{each.kind} x {each.length}" if each.length else each.kind
            if each.kind == "touches":
                kind = f"list of ({', '.join(TOUCH_FIELDS)})"
            lines.append(f"| `{each.name}` | {kind} | {each.units} | {each.description} |")
        return "\n".join(lines)

    def _recipe(self) -> str:
        if not self.recipe:
            return "## Origin\n\nRecorded; there is no recipe that makes these frames again."
        return (
            "## Recipe\n\n`recipe.toml` makes these frames again: "
            f"`eitskin generate recipe.toml --out SET`, with seed {self.origin['seed']}.\n\n"
            f"```toml\n{self.recipe.strip()}\n```"
        )


_EPISODES = """## Features

`meta/info.json` names the features of a frame: `observation.*` is what a board measures and the
flat sensor it is compared with, `label.*` the truth. In labels NaN is unknown or absent, and state
255 unknown. There are no actions. `timestamp` is the time since the episode began [s]; `fps` is one
over the usual interval. `meta/episodes` tells the specimen and the split of each episode."""


def _feature(column: Column) -> list[str]:
    """Lines of YAML for a column, as the package `datasets` describes features."""
    head = f"- name: {column.name}"
    if column.kind == "touches":
        inner = [
            line for name in TOUCH_FIELDS for line in (f"  - name: {name}", "    dtype: float32")
        ]
        return [head, "  list:", *inner]
    if column.name == "state":
        names = [f"        '{int(state)}': {state.name.lower()}" for state in State]
        return [head, "  dtype:", "    class_label:", "      names:", *names]
    if column.length:
        return [head, f"  list: {column.kind}", f"  length: {column.length}"]
    return [head, f"  dtype: {'string' if column.kind == 'text' else column.kind}"]
