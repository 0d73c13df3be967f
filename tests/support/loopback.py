"""Virtual board behind a port in memory: no cable, no pseudo-terminal, no waiting."""

import dataclasses
import itertools

import numpy as np

from eitskin.hardware import SerialBoard, Stage, open_board
from eitskin.hardware.protocol.packets import Decoder
from eitskin.hardware.virtual.virtual_firmware import VirtualFirmware
from eitskin.simulator import Protocol

PROTOCOL = Protocol.pairwise(8)
FLAT = np.linspace(400.0, 820.0, 28)


def matrix_of_pairs(resistances):
    """Impedance matrix (8, 8) whose pairs have these resistances (28,)."""
    matrix = np.zeros((8, 8))
    matrix[np.triu_indices(8, 1)] = -0.5 * np.asarray(resistances)
    return matrix + matrix.T


class FakeSimulator:
    """Simulator whose impedances depend on the bend angle alone; counts computed scenes."""

    protocol = PROTOCOL

    def __init__(self):
        self.computed = 0

    def impedance_matrix(self, scene):
        self.computed += 1
        return matrix_of_pairs(FLAT * (1.0 + 1e-3 * scene.bend.angle_deg))


def virtual(**options):
    return open_board("virtual:?speed=max", simulator=FakeSimulator(), **options)


def take(board, count, **options):
    return list(itertools.islice(board.frames(**options), count))


class Loopback:
    """Port with a firmware right behind it, and a clock that only waiting moves."""

    def __init__(self, firmware):
        self.firmware, self.now, self.closed = firmware, 0.0, False
        self.waiting = bytearray(firmware.boot())
        self.deaf = 0  # requests that the board does not hear
        self.heard = []

    def clock(self):
        return self.now

    @property
    def in_waiting(self):
        return len(self.waiting)

    def read(self, size=1):
        if not self.waiting and self.firmware.streaming:
            self.waiting += self.firmware.frame()
            self.now += self.firmware.info.period
        elif not self.waiting:
            self.now += 0.05
        data = bytes(self.waiting[:size])
        del self.waiting[:size]
        return data

    def write(self, data):
        self.heard += Decoder().feed(data)
        if self.deaf:
            self.deaf -= 1
        else:
            self.waiting += self.firmware.receive(data)

    def reset_input_buffer(self):
        self.waiting.clear()

    def close(self):
        self.closed = True


def firmware(faults=(), sensor=lambda _: FLAT, protocol=PROTOCOL, **changes):
    def measure(matrix, now):
        changed = PROTOCOL.measure(matrix) - FLAT if protocol == PROTOCOL else 0.0
        values = sensor(now) + changed
        return values.astype(complex), np.zeros(len(values), np.uint8)

    stage = Stage(lambda _: matrix_of_pairs(FLAT), faults=faults)
    board = VirtualFirmware(stage, protocol, measure)
    board.info = dataclasses.replace(board.info, **changes)
    return board


def connected(board_firmware, **state):
    port = Loopback(board_firmware)
    vars(port).update(state)
    return SerialBoard(lambda: port, "serial:loopback", clock=port.clock), port
