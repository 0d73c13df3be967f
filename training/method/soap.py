"""SOAP, an optimiser of networks. Imports torch at its top.

Small smooth networks that are fitted to almost exact data, as the response to touches, are badly
conditioned: Adam needs more steps for the same loss, and now and then a step of it throws the
network far back.
"""

from collections.abc import Iterable

import torch  # noqa: TID253  see above
from torch import Tensor  # noqa: TID253  see above

MEMORY = 0.95  # share of the past in all running means
TURN_EVERY = 20  # steps
MAX_SIZE = 400  # of a side that is turned, which costs its cube
EPSILON = 1e-8


class Soap(torch.optim.Optimizer):
    """Adam in the eigenbasis of Shampoo's preconditioner (Vyas et al. 2024, algorithm 3).

    Matrices of parameters are turned to the eigenvectors of the running means of G G^T and G^T G,
    of their gradients G, and each entry is scaled there as by Adam. Vectors, and sides longer than
    `MAX_SIZE`, are not turned.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        """Take the parameters and the learning rate, which a schedule may change."""
        super().__init__(parameters, {"lr": learning_rate})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Change the parameters by their gradients."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if (gradient := parameter.grad) is not None:
                    state = self.state[parameter]
                    if not state:
                        state["moments"] = _Moments(gradient)
                    parameter.sub_(state["moments"].direction(gradient), alpha=group["lr"])


class _Moments:
    """Running means of one parameter's gradients, and the eigenvectors in which it is scaled."""

    def __init__(self, gradient: Tensor) -> None:
        """Begin with the eigenvectors of the first gradient."""
        turned = range(gradient.ndim) if gradient.ndim == 2 else ()
        self.sides = [side for side in turned if gradient.shape[side] <= MAX_SIZE]
        self.covariances = [_covariance(gradient, side) for side in self.sides]
        self.bases = [torch.linalg.eigh(each).eigenvectors.flip(1) for each in self.covariances]
        self.mean, self.squares = torch.zeros_like(gradient), torch.zeros_like(gradient)
        self.steps = 0

    def direction(self, gradient: Tensor) -> Tensor:
        """Direction of a step against a gradient, which joins the means."""
        self.steps += 1
        self.mean.lerp_(gradient, 1.0 - MEMORY)
        self.squares.lerp_(self._turn(gradient) ** 2, 1.0 - MEMORY)
        unbiased = 1.0 - MEMORY**self.steps
        scale = (self.squares / unbiased).sqrt() + EPSILON
        step = self._turn(self.mean) / unbiased / scale
        for side, basis in zip(self.sides, self.bases, strict=True):
            step = _multiply(basis, step, side)
        for side, covariance in zip(self.sides, self.covariances, strict=True):
            covariance.lerp_(_covariance(gradient, side), 1.0 - MEMORY)
        if self.steps % TURN_EVERY == 0:
            self._follow()
        return step

    def _turn(self, matrix: Tensor) -> Tensor:
        """A matrix in the eigenvectors."""
        for side, basis in zip(self.sides, self.bases, strict=True):
            matrix = _multiply(basis.T, matrix, side)
        return matrix

    def _follow(self) -> None:
        """Turn the eigenvectors by one step of subspace iteration, the largest first."""
        for number, (side, covariance) in enumerate(zip(self.sides, self.covariances, strict=True)):
            moved = covariance @ self.bases[number]
            order = torch.sum(self.bases[number] * moved, dim=0).argsort(descending=True)
            self.squares = self.squares.index_select(side, order)
            self.bases[number] = torch.linalg.qr(moved[:, order]).Q


def _covariance(gradient: Tensor, side: int) -> Tensor:
    """G G^T of a gradient (m, n), or G^T G by its columns."""
    return gradient @ gradient.T if side == 0 else gradient.T @ gradient


def _multiply(factor: Tensor, matrix: Tensor, side: int) -> Tensor:
    """Product with the rows of a matrix, or with its columns."""
    return factor @ matrix if side == 0 else matrix @ factor.T
