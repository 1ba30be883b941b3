"""Methods to compare with."""

from .clfdm import CLFDM
from .dmp import DMP
from .fdm import FDM
from .promp import ProMP
from .sdsef import SDSEF
from .seds import SEDS

__all__ = ["CLFDM", "DMP", "FDM", "SDSEF", "SEDS", "ProMP"]
