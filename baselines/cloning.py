"""Behaviour cloning: a network regresses velocities, and nothing makes it stable."""

from __future__ import annotations

from torch import Tensor

from latentds.arguments import whole_number

from .networks import EPOCHS, VelocityRegression, perceptron, seeded_generator


class BehaviourCloning(VelocityRegression):
    """ẏ = N(y), a plain network fitted to the demonstrated velocities (Pomerleau 1989): what stability costs.

    It promises nothing: the attractor is where the demonstrations end, and neither rests there nor draws anything in.
    ``lyapunov`` is the squared distance from it, in sizes of the motion, which no motion needs to diminish.

    The network has three hidden layers, as that of Pérez-Dattari and Kober (2023) whose cloning loss without the
    stabilising one is this baseline.

    Args:
        dim: n >= 1.
        n_units: in each hidden layer, >= 1.
        seed: of the initial network and the batches; None draws them from torch's generator.
        epochs: passes over the samples, >= 1.
    """

    weight_decay = 1e-4

    def __init__(self, dim: int, *, n_units: int = 128, seed: int | None = None, epochs: int = EPOCHS) -> None:
        super().__init__(dim, seed=seed, epochs=epochs)
        self.n_units = whole_number(n_units, "n_units", at_least=1)
        sizes = [self.dim, *[self.n_units] * 3, self.dim]
        self.network = perceptron(sizes, seeded_generator(self.seed))

    def normalized_velocity(self, u: Tensor) -> Tensor:
        velocity: Tensor = self.network(u)
        return velocity

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        return self._normalize(points).square().sum(-1).to(wanted)
