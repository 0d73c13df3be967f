"""Wire protocol between host and board.

Bytes become packets with a checksum (`packets`), packets become messages (`messages`), and back.
"""
