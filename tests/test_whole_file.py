"""Files that appear whole or not at all."""

import pytest

from eitskin.geometry import ConfigurationError
from eitskin.geometry.whole_file import whole_file


def test_a_block_that_raises_leaves_the_old_file_and_nothing_else(tmp_path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError), whole_file(path) as temporary:
        temporary.write_text("half \udcff", encoding="utf-8")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_takes_its_name_only_at_the_end(tmp_path) -> None:
    path = tmp_path / "a.png"
    with whole_file(path) as temporary:
        temporary.write_text("new")
        assert temporary.suffix == ".png"
        assert not path.exists()
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o644


def test_a_folder_that_is_not_there_is_said(tmp_path) -> None:
    with (
        pytest.raises(ConfigurationError, match="No such file or directory; name a file"),
        whole_file(tmp_path / "none" / "a.txt"),
    ):
        pass
