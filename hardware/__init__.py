"""Boards, real and virtual: wire protocol, host, firmware, sensor check and live loop.

Data pass `protocol` (bytes to messages), `boards` (messages to frames), `opening` (a board by its
URI), `live` (frames to estimates), `streams` (readings to other programs); `virtual` simulates what
stands behind a port.
"""

from eitskin.extras import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
