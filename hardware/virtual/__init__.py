"""Virtual board: simulated measurements and faults behind a pseudo-terminal.

A `Stage` plays scenes, a `SimulatedSensor` measures them, a `VirtualFirmware` answers requests and
sends frames, changed by the faults of `fault_table`, and a `PseudoTerminal` serves the bytes.
"""
