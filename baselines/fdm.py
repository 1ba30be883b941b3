"""FDM: a straight line, uniform in time, matched greedily to the demonstration."""

from __future__ import annotations

from latentds.arguments import Array
from latentds.demonstration import Demonstration
from latentds.fitting.embedding import map_to_endpoints, straight_column
from latentds.methods.greedy import GreedyDS
from latentds.time_law import KnottedLaw


class FDM(GreedyDS):
    """Fast diffeomorphic matching (Perrin and Schlehuber-Caissier 2016): ChebyshevDS with another latent line.

    The latent point moves straight to the goal at one speed, and the layers of their Algorithm 1, in its bounds, carry
    the line onto the demonstration: globally asymptotically stable by construction, whatever the layers are. Unlike the
    paper's, the ends are pinned, so that the attractor is the goal itself; and β, μ and the number of layers may be
    chosen by the rule of Gupta, Nayak and Billard (``n_layers=None``).

    The arguments are those of :class:`~latentds.methods.greedy.GreedyDS`.
    """

    @staticmethod
    def latent_line(shown: Demonstration) -> Array:
        return map_to_endpoints(straight_column(len(shown)), shown.start.numpy(), shown.goal.numpy())

    @staticmethod
    def time_law(duration: float) -> KnottedLaw:
        return KnottedLaw.uniform(duration)
