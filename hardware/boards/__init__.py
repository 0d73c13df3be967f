"""Boards that give frames: on a serial port, printing text, or replayed from a recording."""
