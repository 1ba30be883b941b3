"""Methods to compare with."""

from .attractors import MultipleAttractors, separate
from .avoidance import AvoidanceTerms
from .cdsp import CDSP
from .clfdm import CLFDM
from .cloning import BehaviourCloning
from .contracting import NCDS
from .cycles import LimitCycleFlow
from .dmp import DMP
from .fdm import FDM
from .imitation import ImitationFlow
from .lddmm import LDDMM
from .lpvds import LPVDS
from .lyapunov import NeuralLyapunov
from .promp import ProMP
from .sdsef import SDSEF
from .seds import SEDS
from .tauseds import TauSEDS

__all__ = [
    "CDSP",
    "CLFDM",
    "DMP",
    "FDM",
    "LDDMM",
    "LPVDS",
    "NCDS",
    "SDSEF",
    "SEDS",
    "AvoidanceTerms",
    "BehaviourCloning",
    "ImitationFlow",
    "LimitCycleFlow",
    "MultipleAttractors",
    "NeuralLyapunov",
    "ProMP",
    "TauSEDS",
    "separate",
]
