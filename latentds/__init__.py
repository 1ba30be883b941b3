"""latentds: globally stable motions from one demonstration."""

from . import datasets
from .base import FitReport, LatentDS, Learned, StableDS
from .benchmark import compare
from .certificate import Certificate, certify
from .demonstration import Demonstration
from .diffeomorphism import Diffeomorphism
from .fidelity import FitWarning
from .kernels import warmup
from .methods.chebyshev import ChebyshevDS
from .methods.tube import TubeDS
from .modulation import AvoidingDS, BoundedDS
from .poses import PoseDemonstration, PoseDS
from .storage import load
from .transform import as_transform
from .translations import LocallyWeightedTranslations

__version__ = "0.1.0"  # the one place
__all__ = [
    "AvoidingDS",
    "BoundedDS",
    "Certificate",
    "ChebyshevDS",
    "Demonstration",
    "Diffeomorphism",
    "FitReport",
    "FitWarning",
    "LatentDS",
    "Learned",
    "LocallyWeightedTranslations",
    "PoseDS",
    "PoseDemonstration",
    "StableDS",
    "TubeDS",
    "as_transform",
    "certify",
    "compare",
    "datasets",
    "load",
    "warmup",
]
