"""Files that appear whole or not at all."""

import pytest

from eitskin.errors import ConfigurationError, PartialError
from eitskin.files import (
    TEMPORARY,
    atomic_file,
    atomic_folder,
    remove_file,
    remove_leftovers,
    write_file,
)


def test_a_file_takes_its_name_at_the_end_and_a_failed_one_leaves_the_old(tmp_path) -> None:
    path = tmp_path / "a.png"
    with atomic_file(path) as temporary:
        temporary.write_text("old")
        assert temporary.suffix == ".png"
        assert not path.exists()
    assert path.stat().st_mode & 0o777 == 0o644
    with pytest.raises(UnicodeEncodeError), atomic_file(path) as temporary:
        temporary.write_text("half \udcff", encoding="utf-8")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_said(tmp_path) -> None:
    with (
        pytest.raises(ConfigurationError, match="No such file or directory"),
        atomic_file(tmp_path / "none" / "a.txt"),
    ):
        pass


def filled(path, *names) -> None:
    with atomic_folder(path) as folder:
        for name in names:
            (folder / name).write_text(name)


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path) -> None:
    path = tmp_path / "above" / "some"
    filled(path, "a", "b")
    with pytest.raises(UnicodeEncodeError), atomic_folder(path) as folder:
        (folder / "c").write_text("half \udcff", encoding="utf-8")
    assert sorted(file.name for file in path.iterdir()) == ["a", "b"]
    filled(path, "c")
    assert [file.name for file in path.iterdir()] == ["c"]
    assert path.stat().st_mode & 0o777 == 0o755
    assert list(path.parent.iterdir()) == [path]


def test_every_file_of_a_folder_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr("eitskin.files.sync", lambda path: synced.append(path.name))
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "inner").mkdir()
        (folder / "inner" / "file").write_text("content")
    assert {"inner", "file"} <= set(synced)


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (PermissionError(13, "Permission denied"), ConfigurationError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_folder_that_cannot_take_the_name_leaves_what_was_there(
    error, raised, tmp_path, monkeypatch
) -> None:
    path = tmp_path / "some"
    filled(path, "a")
    rename = type(path).rename

    def refuse(source, target):
        if source.name.startswith(".some.") and target == path:
            raise error
        return rename(source, target)

    monkeypatch.setattr(type(path), "rename", refuse)
    with pytest.raises(raised, match=r"^$|Permission denied"):
        filled(path, "b")
    assert [file.name for file in path.iterdir()] == ["a"]
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_removed_is_a_clear_error(tmp_path):
    remove_file(tmp_path / "absent")
    (tmp_path / "folder").mkdir()
    with pytest.raises(PartialError, match=r"folder: .*--resume"):
        remove_file(tmp_path / "folder")


def test_leftovers_of_killed_writers_are_removed_and_nothing_else(tmp_path) -> None:
    write_file(tmp_path / "a.json", b"{}")
    (tmp_path / f"{TEMPORARY}x.json").write_text("half")
    remove_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
