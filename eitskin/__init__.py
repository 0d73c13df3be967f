"""Simulator of electrical-impedance robot skin, and the perception pipeline trained on it.

The modules here are shared by all packages: errors, checked configuration, atomic files, optional
extras, and the two types that every package uses, `Frame` and `Protocol`. Data passes through the
packages in one direction: geometry -> simulator -> datasets -> training -> hardware -> cli.
"""

from eitskin.extras import lazy_exports

__version__ = "0.2.0"

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
