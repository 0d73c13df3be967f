"""The image that is flashed on a NUCLEO-F411RE, run in QEMU, against the host's build."""

import struct
import time

import numpy as np
import pytest

from eitskin.hardware.protocol import messages
from eitskin.hardware.protocol.packets import FrameData, MessageType, Packet, encode
from eitskin.simulator import Status

from compiled_firmware import booted, frames, sensor
from emulator.board import EmulatedBoard
from emulator.chip import UID
from loopback import FLAT, PROTOCOL
from simulated_afe import SimulatedAfe

pytestmark = pytest.mark.slow

START_AND_TWO_FRAMES = 1.5e6  # us
STRAY = 1.0 / (2j * np.pi * 40e3 * 100e-12)  # ohm of the capacitance of an open pair


def every_status():
    """Phases all around, and pairs that are open, without current and clipped."""
    values = FLAT * np.exp(2j * np.pi * np.arange(28) / 28.0)
    values[[3, 11, 19]] = STRAY, 1e12, 150.0
    return values


@pytest.fixture(scope="module")
def running():
    """One emulated board on a flat sensor, booted, and what it said of itself."""
    with EmulatedBoard() as board:
        info, before = board.wait_for(messages.Info)
        assert before == []
        yield board, info


def no_complaints(board):
    return not board.chip.complaints and not board.chip.afe.complaints and not board.chip.faults


# ---- the same as on the host ----


def test_eitskin_reads_the_frames_of_the_hosts_build_to_the_last_bit():
    (expected,) = frames(booted(every_status()), 1)
    with EmulatedBoard(SimulatedAfe(sensor(every_status()))) as board:
        device = board.serial_board()
        found = next(device.frames())
        assert no_complaints(board)
    assert device.protocol == PROTOCOL
    assert found.impedance.astype(np.complex64).tobytes() == expected.impedance.tobytes()
    assert found.status.tobytes() == expected.status.tobytes()
    assert {Status(int(status)) for status in found.status} == {
        Status(0),
        Status.OPEN,
        Status.OPEN | Status.LOW_CURRENT,
        Status.CLIPPED,
    }


def test_it_says_who_it_is_and_drops_garbage_and_wrong_requests(running):
    board, info = running
    assert (info.firmware, info.uid, info.boot_count) == ("eitskin-f411 1.0", UID, 1)
    assert board.ask(messages.Hello(), messages.Info) == info
    assert board.ask(messages.GetTable(), messages.Table) == messages.Table.from_protocol(PROTOCOL)
    board.line.write(bytes(range(256)) * 2)
    assert board.ask(messages.Hello(), messages.Info) == info
    board.line.write(encode(Packet(0x7F, 300, b"")) + encode(Packet(MessageType.START, 301, b"12")))
    refused = [board.wait_for(messages.Ack)[0] for _ in range(2)]
    assert refused == [
        messages.Ack(300, 0x7F, messages.AckStatus.UNKNOWN_TYPE),
        messages.Ack(301, MessageType.START, messages.AckStatus.MALFORMED),
    ]
    assert board.ask(messages.Hello(), messages.Info) == info
    assert board.line.baud == pytest.approx(921_600, rel=0.005)


# ---- a board of its own each ----


def test_the_watchdog_ends_a_hang_and_the_boot_is_counted():
    with EmulatedBoard() as board:
        first, _ = board.wait_for(messages.Info)
        board.ask(messages.Start(0), messages.Ack)
        board.chip.spi_hangs = True
        while board.chip.resets == 0:
            assert not board.chip.complaints
        board.chip.spi_hangs = False
        second, _ = board.wait_for(messages.Info)
        assert (first.boot_count, second.boot_count) == (1, 2)
        assert board.chip.resets == 1
        records = struct.unpack("<4I", board.chip.store[:16])
        assert records == (1, 0xFFFFFFFE, 2, 0xFFFFFFFD)
        assert board.ask(messages.Start(1), messages.Ack).status == messages.AckStatus.DONE


def test_a_frame_that_finds_the_line_busy_is_left_out_whole():
    """By the interrupts of a USART whose first byte takes longer than two frames."""
    with EmulatedBoard() as board:
        board.wait_for(messages.Info)
        board.line.slower = 60_000.0
        board.line.write(encode(messages.pack(messages.Start(2), 1)))
        while board.chip.now < START_AND_TWO_FRAMES:
            time.sleep(0.01)
        board.line.slower = 1.0
        came = board.messages()
        board.line.write(encode(messages.pack(messages.Hello(), 2)))
        assert [type(next(came)) for _ in range(3)] == [messages.Ack, FrameData, messages.Info]
        assert no_complaints(board)


def test_without_the_crystal_it_runs_from_the_internal_clock():
    with EmulatedBoard(crystal=False) as board:
        board.wait_for(messages.Info)
        assert board.chip.sysclk == 96e6
        assert board.line.baud == pytest.approx(921_600, rel=0.005)
        assert no_complaints(board)
