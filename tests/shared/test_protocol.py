"""Protocols: order, patterns, and what is refused."""

import itertools

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.simulator import Protocol


def test_pairwise_lists_every_pair_once_in_order() -> None:
    protocol = Protocol.pairwise(8)
    assert len(protocol) == 28
    assert protocol.labels[:3] == ("0-1", "0-2", "0-3")
    assert protocol.labels[-1] == "6-7"


def test_measure_is_sense_pattern_times_matrix_times_drive_pattern() -> None:
    rng = np.random.default_rng(0)
    Z = rng.standard_normal((5, 4, 4))
    protocol = Protocol(((0, 1, 2, 3), (1, 3, 0, 2)), 4)
    drive, sense = protocol.patterns()
    expected = np.einsum("em,nef,fm->nm", sense, Z, drive)
    assert protocol.measure(Z) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ((), "one measurement"),
        (((0, 1, 0, 8),), "each from 0 to 7"),
        (((0, 0, 1, 2),), "two different electrodes"),
        (((0, 1, 2),), "expected"),
    ],
)
def test_impossible_tables_are_refused(table, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Protocol(table, 8)


def test_a_matrix_of_another_size_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"\(8, 8\)"):
        Protocol.pairwise(8).measure(np.eye(7))


def test_adjacent_drives_every_neighbour_and_leaves_out_shared_electrodes() -> None:
    protocol = Protocol.adjacent(8)
    assert len(protocol) == 8 * 5
    assert protocol.table[:2] == ((0, 1, 2, 3), (0, 1, 3, 4))
    assert all(not {a, b} & {c, d} for a, b, c, d in protocol.table)
    assert len(Protocol.adjacent(8, shared=True)) == 8 * 8


def test_opposite_drives_each_diameter_once_and_senses_neighbours() -> None:
    protocol = Protocol.opposite(8)
    assert {row[:2] for row in protocol.table} == {(0, 4), (1, 5), (2, 6), (3, 7)}
    assert {(d - c) % 8 for _, _, c, d in protocol.table} == {1}
    assert len(protocol) == 4 * 4


def test_skip_leaves_electrodes_between_the_two_of_a_pair() -> None:
    protocol = Protocol.skip(8, 2)
    assert {((b - a) % 8, (d - c) % 8) for a, b, c, d in protocol.table} == {(3, 3)}
    mixed = Protocol.skip(8, 2, sense_skip=0)
    assert {((b - a) % 8, (d - c) % 8) for a, b, c, d in mixed.table} == {(3, 1)}


@pytest.mark.parametrize("n", [5, 8, 13])
def test_known_ranks(n) -> None:
    # The impedance matrix is symmetric with zero row sums: n (n - 1) / 2 free numbers.
    assert Protocol.pairwise(n).rank == n * (n - 1) // 2
    assert Protocol.adjacent(n).rank == n * (n - 3) // 2
    assert Protocol.adjacent(n, shared=True).rank == n * (n - 1) // 2


@pytest.mark.parametrize("protocol", ["pairwise", "adjacent", "opposite", "skip:1", "skip:2"])
def test_rank_is_that_of_the_measured_symmetric_matrices(protocol) -> None:
    n = 8
    protocol = Protocol.named(protocol, n)
    # One matrix per pair: a resistor between the two electrodes, as a conductance matrix.
    pairs = np.array([np.eye(n)[i] - np.eye(n)[j] for i, j in itertools.combinations(range(n), 2)])
    measured = protocol.measure(pairs[:, :, None] * pairs[:, None, :])
    assert protocol.rank == np.linalg.matrix_rank(measured)


def test_a_file_gives_back_what_was_written(tmp_path) -> None:
    path = tmp_path / "protocol.csv"
    Protocol.adjacent(8).to_file(path)
    assert path.read_text().startswith("drive_plus,drive_minus,sense_plus,sense_minus\n0,1,2,3\n")
    assert Protocol.from_file(path, 8) == Protocol.adjacent(8)
    assert Protocol.named(str(path), 8) == Protocol.adjacent(8)
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_with_windows_line_ends_spaces_and_empty_lines_is_read(tmp_path) -> None:
    path = tmp_path / "protocol.csv"
    text = "\ufeffdrive_plus, drive_minus, sense_plus, sense_minus\r\n\r\n0, 1, 2, 3\r\n"
    path.write_bytes(text.encode())
    assert Protocol.from_file(path, 8).table == ((0, 1, 2, 3),)


HEADER = "drive_plus,drive_minus,sense_plus,sense_minus\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "an empty file"),
        ("a,b,c,d\n0,1,2,3\n", "expected the header"),
        (HEADER, "none"),
        (HEADER + "0,1,2,3\n0,1,2.0,4\n", r"line 3: .*0,1,2.0,4"),
        (HEADER + "0,1,2,x\n", r"line 2: .*whole numbers"),
        (HEADER + "0,1,2\n", r"line 2: .*4 electrodes.*3"),
        (HEADER + "\n0,1,2,8\n", r"line 3: .*0 to 7"),
        (HEADER + "0,1,-1,3\n", r"line 2: .*0 to 7"),
        (HEADER + "0,0,2,3\n", r"line 2: .*different"),
        (HEADER + "0,1,2,3\n4,5,6,7\n0,1,2,3\n", r"line 4: .*line 2"),
        (HEADER + '0,1,2,"3\n', "cannot read"),
        (HEADER + "0,1,2,\udcff\n", "cannot read"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_line(tmp_path, text, message) -> None:
    path = tmp_path / "protocol.csv"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigurationError, match=message):
        Protocol.from_file(path, 8)


def test_missing_files_and_folders_are_said(tmp_path) -> None:
    with pytest.raises(ConfigurationError, match="protocol"):
        Protocol.from_file(tmp_path / "none.csv", 8)
    with pytest.raises(ConfigurationError, match="cannot write"):
        Protocol.pairwise(8).to_file(tmp_path / "none" / "protocol.csv")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Protocol.opposite(7), r"even.*7"),
        (lambda: Protocol.skip(8, 7), "can skip 0 to 6"),
        (lambda: Protocol.skip(8, -1), "can skip 0 to 6"),
        (lambda: Protocol.adjacent(3), "shares an electrode"),
        (lambda: Protocol.named("adjacnet", 8), r"pairwise, adjacent, opposite, skip:N, .*CSV"),
    ],
)
def test_protocols_that_cannot_be_are_refused(make, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make()


def test_a_text_with_the_number_of_electrodes():
    assert Protocol.from_text("pairwise:8") == Protocol.pairwise(8)
    for text in ("pairwise", "pairwise:1", "pairwise:x", "adjacent:8"):
        with pytest.raises(ConfigurationError, match="pairwise:N"):
            Protocol.from_text(text)
