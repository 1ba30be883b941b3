"""Where the studies look for the kinds of files, which are in recordings; goes with their import."""

from .recordings import READERS

__all__ = ["READERS"]
