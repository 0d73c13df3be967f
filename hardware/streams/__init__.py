"""Streams: readings as JSON for other programs, by UDP and WebSocket.

`reading_record` has the form of a reading, `publisher` the thread that sends it.
"""
