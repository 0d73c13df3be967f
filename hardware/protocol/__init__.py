"""The wire protocol between host and board: packets and messages."""
