"""Firmware of the virtual board: requests and frames as bytes, with its faults."""

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from eitskin.hardware.protocol import messages
from eitskin.hardware.protocol.packets import (
    PER_PACKET,
    Decoder,
    FrameData,
    MessageError,
    Packet,
    encode,
    frame_packets,
)
from eitskin.hardware.virtual.fault import Fault, Hook
from eitskin.hardware.virtual.stage import Measure, Stage
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME

T = TypeVar("T")


class VirtualFirmware:
    """Firmware of a virtual board: bytes in, bytes out, without port or clock.

    Attributes:
        info: identity and settings of the board, before faults.
        streaming: whether frames are due.
        delay: delay of the frame after the newest [s].
        stage: scene and faults of the board.
    """

    def __init__(
        self,
        stage: Stage,
        protocol: Protocol,
        measure: Measure,
        period: float | None = None,
    ) -> None:
        """Build a board that has not booted yet.

        Args:
            stage: scene and faults of the board.
            protocol: stimulation and measurement pattern.
            measure: measured values of an impedance matrix, by frames since the board was made.
            period: time from frame to frame [s]; 10.6 ms for each measurement when omitted.
        """
        self.stage = stage
        self.streaming, self.delay = False, 0.0
        self._protocol, self._measure = protocol, measure
        self._decoder = Decoder()
        self._seq = self._left = self.number = self._started = 0
        self._late = 0.0
        self._table = messages.Table.from_protocol(protocol)
        self.info = messages.Info.from_protocol(
            protocol,
            firmware="eitskin-virtual",
            uid=b"eitskin-0000",
            frequency=40e3,
            amplitude=0.607,
            rtia=200.0,
            rcal=200.0,
            period=len(protocol) * MEASUREMENT_TIME if period is None else period,
        )

    @property
    def holds_port(self) -> bool:
        """Whether another program has the port open."""
        return self._apply_faults(Hook.PORT_HELD, False)

    @property
    def can_reconnect(self) -> bool:
        """Whether the cable, once pulled, may be put back."""
        return not self._apply_faults(Hook.STAYS_OUT, False)

    def set_boot_count(self, count: int) -> None:
        """Set the boot count to `count`, modulo 2**32."""
        self.info = dataclasses.replace(self.info, boot_count=count % 2**32)

    def boot(self) -> bytes:
        """Boot, and give the bytes sent on boot."""
        self.info = dataclasses.replace(self.info, boot_count=(self.info.boot_count + 1) % 2**32)
        self._start()
        return self._send(self._apply_faults(Hook.INFO, self.info)) + self._send(
            messages.Event(0, 0, f"boot {self.info.boot_count}")
        )

    def receive(self, data: bytes) -> bytes:
        """Answers to bytes from the host."""
        return b"".join(self._reply(packet) for packet in self._decoder.feed(data))

    def frame(self) -> bytes:
        """Bytes of the next frame; raises `Unplugged` for a fault that pulls the cable."""
        now, faults = self.stage.frames, self.stage.active
        if self._apply_faults(Hook.REBOOTS, False, now, faults):
            self.stage.frames += 1
            return self.boot()
        network = self._apply_faults(Hook.NETWORK, self.stage.impedance_at_frame(now), now, faults)
        impedance, status = self._measure(network, now)
        self.stage.record_truth(self.number)
        data = FrameData(
            number=self.number,
            time=(now - self._started) * self.info.period + self._late,
            duration=min(len(self._protocol) * MEASUREMENT_TIME, self.info.period),
            impedance=self._apply_faults(
                Hook.IMPEDANCE, impedance.astype(np.complex64), now, faults
            ),
            status=self._apply_faults(Hook.STATUS, status, now, faults),
        )
        packets = frame_packets(data, self._seq)
        self._seq += len(packets)
        self.skip()
        self.delay = self._apply_faults(Hook.DELAY, 0.0, now, faults)
        self._late += self.delay
        sent = self._apply_faults(Hook.PACKET, b"".join(map(encode, packets)), now, faults)
        return self._apply_faults(Hook.LINE, sent, now)

    def delay_clock(self, seconds: float) -> None:
        """Let the clock of later frames show time in which none was measured [s]."""
        self._late += seconds

    def skip(self) -> None:
        """Leave out one frame, for which the host is too slow."""
        self.stage.frames += 1
        self.number = (self.number + 1) % 2**32
        if self._left:
            self._left -= 1
            self.streaming = self._left > 0

    def _start(self) -> None:
        self._decoder = Decoder()
        self._seq = self._left = 0
        self.number = self._apply_faults(Hook.FIRST_NUMBER, 0)
        self._started, self._late, self.delay = self.stage.frames, 0.0, 0.0
        self.streaming = self._apply_faults(Hook.STREAMS, False)

    def _reply(self, packet: Packet) -> bytes:
        reply = self._apply_faults(Hook.REPLY, self._answer(packet), self.stage.requests)
        self.stage.requests += 1
        return self._apply_faults(Hook.LINE, reply)

    def _answer(self, packet: Packet) -> bytes:
        try:
            message = messages.unpack(packet)
        except MessageError:
            return self._acknowledge(packet, messages.AckStatus.MALFORMED)
        match message:
            case messages.Hello():
                return self._pack(self._apply_faults(Hook.INFO, self.info))
            case messages.GetTable(first):
                return self._table_answer(packet, first)
            case messages.Start(frames):
                self._left, self.streaming = frames, True
            case messages.Stop():
                self.streaming = False
            case messages.Calibrate():
                pass  # its resistor is exact
            case _:
                return self._acknowledge(packet, messages.AckStatus.UNKNOWN_TYPE)
        return self._acknowledge(packet, messages.AckStatus.DONE)

    def _table_answer(self, packet: Packet, first: int | None) -> bytes:
        """Answer to GET_TABLE: the table of version 1, or its rows from `first` on."""
        rows = len(self._table.rows)
        if first is None and rows <= PER_PACKET:
            return self._pack(self._table)
        if first is None:
            return self._acknowledge(packet, messages.AckStatus.FAILED)
        if first < rows:
            return self._pack(messages.TablePart.from_table(self._table, first))
        return self._acknowledge(packet, messages.AckStatus.MALFORMED)

    def _acknowledge(self, packet: Packet, status: messages.AckStatus) -> bytes:
        return self._pack(messages.Ack(packet.seq, packet.type, status))

    def _pack(self, message: messages.Message) -> bytes:
        sent = encode(messages.pack(message, self._seq))
        self._seq += 1
        return sent

    def _send(self, message: messages.Message) -> bytes:
        return self._apply_faults(Hook.LINE, self._pack(message))

    def _apply_faults(
        self, hook: Hook, value: T, now: int | None = None, faults: Sequence[Fault] | None = None
    ) -> T:
        """Value after the faults at `hook`; frame and faults are the newest when omitted."""
        now = self.stage.frames if now is None else now
        for fault in self.stage.active if faults is None else faults:
            value = fault.change(hook, value, now, self.info, self._protocol)
        return value
