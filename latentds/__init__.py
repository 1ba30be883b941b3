"""latentds: globally stable motions from one demonstration."""

from . import datasets
from .base import FitReport, LatentDS, StableDS
from .benchmark import compare
from .chebyshev import ChebyshevDS
from .demonstration import Demonstration
from .diffeomorphism import Diffeomorphism, LocallyWeightedTranslations
from .tube import TubeDS
from .kernels import warmup

__version__ = "0.1.0"
__all__ = [
    "ChebyshevDS",
    "Demonstration",
    "Diffeomorphism",
    "FitReport",
    "LatentDS",
    "LocallyWeightedTranslations",
    "StableDS",
    "TubeDS",
    "compare",
    "datasets",
    "warmup",
]
