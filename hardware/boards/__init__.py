"""Sources of frames behind one interface, `board.Board`: serial, text and replay.

Bytes come from a `port`, which may go away and be opened again; a board makes frames of them; a
`Connection` in `board` continues over interruptions.
"""
