"""The crash benchmark in small: damage is noticed, and what is counted as good is good."""

from eitskin.benchmarks.studies.crash_damage import damage
from eitskin.benchmarks.studies.crash_runs import contents, intact


def test_damage_is_noticed_by_all_who_have_the_manifest(tmp_path):
    rows = damage(tmp_path, trials=6, seed=1)
    assert [(row.tried, row.as_promised) for row in rows] == [(6, 6), (6, 6), (3, 3), (3, 3)]
    assert rows[2].remark == "3 refused"


def test_a_changed_shard_is_not_intact(tmp_path):
    for name in ("shard-000000.h5", "manifest.json", ".writing-x"):
        (tmp_path / name).write_text(name)
    whole = contents(tmp_path)
    assert set(whole) == {"shard-000000.h5", "manifest.json"}
    assert intact(tmp_path, whole)
    (tmp_path / "shard-000000.h5").write_text("changed")
    assert not intact(tmp_path, whole)
