"""Protocols: order, patterns, and what is refused."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, FrameError
from eitskin.simulator import Protocol


def test_named_protocols_drive_sense_and_measure_the_pairs_of_their_name():
    pairwise = Protocol.pairwise(8)
    assert len(pairwise) == 28
    assert (*pairwise.labels[:3], pairwise.labels[-1]) == ("0-1", "0-2", "0-3", "6-7")
    opposite = Protocol.opposite(8)
    assert {row[:2] for row in opposite.table} == {(0, 4), (1, 5), (2, 6), (3, 7)}
    assert {(d - c) % 8 for _, _, c, d in opposite.table} == {1}
    assert len(opposite) == 4 * 4
    adjacent = Protocol.adjacent(8)
    assert (len(adjacent), len(Protocol.adjacent(8, shared=True))) == (8 * 5, 8 * 8)
    assert adjacent.table[:2] == ((0, 1, 2, 3), (0, 1, 3, 4))
    assert all(not {a, b} & {c, d} for a, b, c, d in adjacent.table)
    for skip, apart in ((Protocol.skip(8, 2), (3, 3)), (Protocol.skip(8, 2, sense_skip=0), (3, 1))):
        assert {((b - a) % 8, (d - c) % 8) for a, b, c, d in skip.table} == {apart}
    rng = np.random.default_rng(0)
    Z = rng.standard_normal((5, 4, 4))
    protocol = Protocol(((0, 1, 2, 3), (1, 3, 0, 2)), 4)
    drive, sense = protocol.patterns()
    expected = np.einsum("em,nef,fm->nm", sense, Z, drive)
    assert protocol.measure(Z) == pytest.approx(expected)


@pytest.mark.parametrize("n", [5, 8, 13])
def test_known_ranks(n) -> None:
    # The impedance matrix is symmetric with zero row sums: n (n - 1) / 2 free numbers.
    assert Protocol.pairwise(n).rank == n * (n - 1) // 2
    assert Protocol.adjacent(n).rank == n * (n - 3) // 2
    assert Protocol.adjacent(n, shared=True).rank == n * (n - 1) // 2


def test_files_bring_tables_back_electrodes_counted_from_the_text_or_from_one(tmp_path):
    path = tmp_path / "protocol.csv"
    Protocol.adjacent(8).to_file(path)
    assert path.read_text().startswith("drive_plus,drive_minus,sense_plus,sense_minus\n0,1,2,3\n")
    assert Protocol.from_file(path, 8) == Protocol.adjacent(8)
    assert Protocol.from_name(str(path), 8) == Protocol.adjacent(8)
    assert list(tmp_path.iterdir()) == [path]
    assert (
        Protocol.from_name("adjacent:16")
        == Protocol.from_name("adjacent", 16)
        == Protocol.adjacent(16)
    )
    assert Protocol.from_name("adjacent:16", 16) == Protocol.adjacent(16)
    assert Protocol.from_name("skip:2:16") == Protocol.skip(16, 2)
    path = tmp_path / "own:2.csv"
    Protocol(((0, 1, 2, 3), (1, 2, 3, 4)), 8).to_file(path)
    assert Protocol.from_name(str(path)).n_electrodes == 5
    assert Protocol.from_name(f"{path}:8").n_electrodes == 8
    assert Protocol.from_name(str(path), 8).n_electrodes == 8
    protocol, path = Protocol.adjacent(5), tmp_path / "one.csv"
    rows = [",".join(str(electrode + 1) for electrode in row) for row in protocol.table]
    heading = "\ufeffdrive_plus, drive_minus, sense_plus, sense_minus"  # as Windows writes it
    path.write_bytes("\r\n".join([heading, "", *rows]).encode())
    assert Protocol.from_file(path, 5) == Protocol.from_name(f"{path}:5") == protocol
    assert Protocol.from_file(path, 6).table[0] == (1, 2, 3, 4)
    with pytest.raises(ConfigurationError, match=r"no electrode 0.*one.csv:5'.*one.csv:6'"):
        Protocol.from_file(path)


@pytest.mark.parametrize("name", ["pairwise:8", "adjacent:16", "opposite:8", "skip:2:16"])
def test_a_protocol_is_written_with_the_name_that_it_is_read_by(name) -> None:
    protocol = Protocol.from_name(name)
    assert str(protocol) == f"{name} ({len(protocol)} measurements)"
    other = Protocol(protocol.table[::-1], protocol.n_electrodes)
    assert "a table for" in str(other)


def test_another_protocol_is_refused_with_both_names_and_the_first_difference() -> None:
    adjacent = Protocol.adjacent(8)
    with pytest.raises(
        FrameError, match=r"made for adjacent:8 .*got pairwise:8 .*'0-1/2-3' .*'0-1'.*; change"
    ):
        adjacent.require_same(Protocol.pairwise(8), "made for", "got", "change one")
    with pytest.raises(FrameError, match="9 electrodes"):
        adjacent.require_same(Protocol(adjacent.table, 9), "made for", "got", "change one")
    adjacent.require_same(Protocol.adjacent(8), "made for", "got", "change one")


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


REFUSED = {
    "one measurement": [lambda: Protocol((), 8), lambda: Protocol.from_name("pairwise:1")],
    "each from 0 to 7|expected 4 items": [
        lambda: Protocol(((0, 1, 0, 8),), 8),
        lambda: Protocol(((0, 1, 2),), 8),
    ],
    "two different electrodes": [lambda: Protocol(((0, 0, 1, 2),), 8)],
    r"\(8, 8\)": [lambda: Protocol.pairwise(8).measure(np.eye(7))],
    "cannot write": [lambda: Protocol.pairwise(8).to_file("none/protocol.csv")],
    "needs a number of electrodes.*:16": [
        lambda t=t: Protocol.from_name(t) for t in ("pairwise", "adjacent", "skip:2")
    ],
    "skip:N, each with :ELECTRODES": [
        lambda t=t: Protocol.from_name(t)
        for t in ("pairwise:x", "skip:", "", "none.csv:16", "adjacent:16\n", "\0", "adjacnet")
    ],
    "for 16 electrodes, the sensor has 8": [lambda: Protocol.from_name("adjacent:16", 8)],
    "even.*7": [lambda: Protocol.opposite(7)],
    "can skip 0 to 6": [lambda: Protocol.skip(8, 7), lambda: Protocol.skip(8, -1)],
    "shares an electrode": [lambda: Protocol.adjacent(3)],
}


@pytest.mark.parametrize("message", REFUSED)
def test_protocols_that_cannot_be_are_refused(message, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for make in REFUSED[message]:
        with pytest.raises(ConfigurationError, match=message):
            make()
