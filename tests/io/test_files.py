import gzip

import pytest

from evofsm.io import file_kind


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("a.txt", b"time,gap\n", "csv"),
        ("a.csv", b"PAR1", "parquet"),
        ("a", b"\xef\xbb\xbf <fcd-export>", "xml"),
        ("a.db3", b"SQLite format 3\0", "bag"),
        ("a.csv", b"\x89MCAP0\r\n\x01" + bytes(8) + b"\4\0\0\0ros2", "bag"),
        ("a.mcap", b"\x89MCAP0\r\n\x01" + bytes(12) + b"\x0b\0\0\0evofsm 0.1", "run"),
        ("a.mcap", b"\x89MCAP0\r\n\x01" + bytes(12) + b"\x0b\0\0\0another one", "mcap"),
        ("a.mcap", b"\x89MCAP0\r\n", "mcap"),
        ("a.osi", b"anything", "osi"),
        ("a.osi.gz", b"anything", "osi"),
    ],
)
def test_a_file_is_known_by_how_it_begins(tmp_path, name, content, kind):
    (tmp_path / name).write_bytes(content)
    assert file_kind(str(tmp_path / name)) == kind


def test_packed_files_are_looked_into_and_folders_of_bags_known(tmp_path):
    with gzip.open(tmp_path / "a.gz", "wb") as file:
        file.write(b"<fcd-export>")
    assert file_kind(str(tmp_path / "a.gz")) == "xml"
    (tmp_path / "bag").mkdir()
    with pytest.raises(IsADirectoryError, match="is a folder"):
        file_kind(str(tmp_path / "bag"))
    (tmp_path / "bag" / "metadata.yaml").touch()
    assert file_kind(str(tmp_path / "bag")) == "bag"
