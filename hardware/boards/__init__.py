"""Sources of frames behind one interface, `board.Board`: serial, text and replay.

Bytes come from a `port`, which a `ReopenablePort` opens again; a board makes frames of them; a
`Connection` goes on over interruptions.
"""
