"""Methods to compare with."""

from .fdm import FDM
from .sdsef import SDSEF

__all__ = ["FDM", "SDSEF"]
