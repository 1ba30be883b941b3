"""Every method of the field, each with its best recipe: the columns of the comparison."""

from __future__ import annotations

from functools import partial

from baselines import (
    CDSP,
    CLFDM,
    DMP,
    FDM,
    LDDMM,
    LPVDS,
    NCDS,
    SDSEF,
    SEDS,
    BehaviourCloning,
    ImitationFlow,
    NeuralLyapunov,
    ProMP,
    TauSEDS,
)
from experiments.compared import greedy
from experiments.field.motions import Motion
from experiments.published import TABLE_ONE
from latentds import ChebyshevDS, TubeDS
from latentds.benchmark import Factory

OURS = "TubeDS"
METHODS: dict[str, Factory] = {
    OURS: TubeDS,
    "Chebyshev": partial(ChebyshevDS, n_layers=None),
    "FDM": partial(FDM, n_layers=None),
    "LDDMM": LDDMM,
    "SDS-EF": SDSEF,
    "ImitationFlow": ImitationFlow,
    "CLF-DM": CLFDM,
    "LPV-DS": LPVDS,
    "CDSP": CDSP,
    "SEDS": SEDS,
    "τ-SEDS": TauSEDS,
    "NeuralLyapunov": NeuralLyapunov,
    "NCDS": NCDS,
    "BehaviourCloning": BehaviourCloning,
    "ProMP": ProMP,
    "DMP": DMP,
}
"""By the names that tables give them, with their defaults. Chebyshev and FDM choose hyperparameters by the paper's rule
where the paper prints none."""
PHASE_DRIVEN = ("ProMP", "DMP")
"""These follow a clock and are no fields: ranked apart."""
DRAWN_AT_RANDOM = (
    "SDS-EF",
    "NCDS",
    "NeuralLyapunov",
    "BehaviourCloning",
    "LPV-DS",
    "SEDS",
    "CLF-DM",
    "τ-SEDS",
    "CDSP",
    "ImitationFlow",
)
"""Their fits begin at random, so that three seeds tell how much that matters."""


def factory_of(label: str, motion: Motion) -> Factory:
    """The method of that label for that motion.

    ProMP gets 50 basis functions for a single demonstration: 20, which generalise better from several, cannot wind.
    """
    if label == "ProMP" and len(motion.shown) == 1:
        return partial(ProMP, n_basis=50)
    printed = TABLE_ONE.get(label, {}).get(motion.name)
    return METHODS[label] if printed is None else greedy(label, printed)
