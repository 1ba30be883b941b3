"""Every work that the paper cites as a method or a part of one, and where it is here."""

from __future__ import annotations

from experiments.paper.document import Document
from experiments.paper.study import Study

WORKS = (
    ("Schaal 1999", "dynamical movement primitives", "`baselines.DMP`"),
    ("Rai et al. 2014", "their coupling terms around obstacles", "`baselines.AvoidanceTerms`"),
    ("Khansari-Zadeh and Billard 2011", "SEDS", "`baselines.SEDS`"),
    ("Khansari-Zadeh and Billard 2014", "CLF-DM", "`baselines.CLFDM`"),
    ("Neumann and Steil 2015", "τ-SEDS", "`baselines.TauSEDS`"),
    ("Figueroa and Billard 2018", "LPV-DS", "`baselines.LPVDS`"),
    ("Ravichandar, Salehi and Dani 2017", "contracting Gaussian mixtures, CDSP", "`baselines.CDSP`"),
    ("Ravichandar and Dani 2019", "the same for orientation", "`latentds.PoseDS` around `baselines.CDSP`"),
    ("Manek and Kolter 2019", "a network with its Lyapunov function", "`baselines.NeuralLyapunov`"),
    ("Perrin and Schlehuber-Caissier 2016", "fast diffeomorphic matching", "`baselines.FDM`"),
    ("Joshi and Miller 2000", "landmark matching, LDDMM", "`baselines.LDDMM`"),
    ("Rana et al. 2020", "SDS-EF", "`baselines.SDSEF`, two recipes"),
    ("Urain et al. 2020", "ImitationFlow", "`baselines.ImitationFlow`, `baselines.LimitCycleFlow`"),
    ("Belkin and Niyogi 2003", "Laplacian eigenmaps", '`ChebyshevDS(embedding="neighbours")`'),
    ("Fichera and Billard 2022", "several attractors", "`baselines.separate`, `baselines.MultipleAttractors`"),
    ("Kronander and Billard 2016", "passive control", "`latentds.deploy.passive`"),
    ("Salvador and Chan 2004", "FastDTW", "`latentds.metrics`, by the package fastdtw"),
)


def works(_: Study, document: Document) -> None:
    document.table(["work", "what it is", "here"], WORKS)
