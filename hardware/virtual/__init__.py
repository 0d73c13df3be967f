"""Virtual board: simulated measurements and faults behind a line in memory.

A `Stage` plays scenes, a `SimulatedSensor` measures them, a `VirtualFirmware` answers requests and
sends frames, changed by the faults of `fault_table`, and a `MemoryLine` passes the bytes; a
`PseudoTerminal` offers that line to other programs.
"""
