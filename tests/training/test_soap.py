"""SOAP against Adam, and that it sees no difference between turned problems."""

import pytest
import torch

from eitskin.training.method.network_training import dense_layers, seeded_network, train_network
from eitskin.training.method.settings import NetworkSettings
from eitskin.training.method.soap import MAX_SIZE, TURN_EVERY, Soap

STEPS = 60  # more than two turns of the eigenvectors


def minimise(optimiser, start: torch.Tensor, loss, steps: int = STEPS) -> torch.Tensor:
    """Parameters after some steps of an optimiser, made from them and a learning rate."""
    parameters = start.clone().requires_grad_()
    stepper = optimiser([parameters], 0.01)
    for _ in range(steps):
        stepper.zero_grad()
        loss(parameters).backward()
        stepper.step()
    return parameters.detach()


def quadratic(size: int):
    """Least squares of square matrices, and a start."""
    torch.manual_seed(0)
    left, right, goal = torch.randn(3, size, size, dtype=torch.float64)
    start = torch.zeros_like(goal)
    return start, lambda matrix: (left @ (matrix - goal) @ right).square().sum()


def adam(parameters, learning_rate: float) -> torch.optim.Optimizer:
    return torch.optim.Adam(parameters, learning_rate, betas=(0.95, 0.95))


def test_a_turned_problem_is_solved_by_turned_steps() -> None:
    start, loss = quadratic(6)
    left, right = torch.linalg.qr(torch.randn(2, 6, 6, dtype=torch.float64)).Q
    plain = minimise(Soap, start, loss)
    turned = minimise(Soap, start, lambda matrix: loss(left.T @ matrix @ right))
    assert turned.numpy() == pytest.approx((left @ plain @ right.T).numpy(), abs=1e-4)


@pytest.mark.parametrize("shape", [(9,), (MAX_SIZE + 1, MAX_SIZE + 2)], ids=["vector", "too large"])
def test_what_is_not_turned_is_scaled_as_by_adam(shape) -> None:
    torch.manual_seed(1)
    start, weights = torch.randn(shape, dtype=torch.float64), torch.rand(shape, dtype=torch.float64)
    ends = [minimise(each, start, lambda x: (weights * x**4).sum()) for each in (Soap, adam)]
    assert ends[0].numpy() == pytest.approx(ends[1].numpy(), abs=1e-12)


def test_diagonal_gradients_are_scaled_as_by_adam_also_when_they_change_places() -> None:
    """Their eigenvectors are the axes; the second gradient becomes the larger one on the way."""
    start = torch.diag(torch.tensor([0.5, 0.8], dtype=torch.float64))
    weights = torch.tensor([2.0, 1.0], dtype=torch.float64)
    loss = lambda x: weights @ x.diag() ** 2  # noqa: E731
    ends = [minimise(each, start, loss, 4 * STEPS) for each in (Soap, adam)]
    assert ends[0].numpy() == pytest.approx(ends[1].numpy(), abs=1e-9)


def test_eigenvectors_follow_gradients_that_turn() -> None:
    torch.manual_seed(3)
    gradients = torch.randn(2, 5, 5, dtype=torch.float64)
    parameters = torch.zeros(5, 5, dtype=torch.float64, requires_grad=True)
    stepper = Soap([parameters], 0.01)
    for gradient in gradients:
        for _ in range(20 * TURN_EVERY):
            parameters.grad = gradient.clone()
            stepper.step()
    moments = stepper.state[parameters]["moments"]
    for side, basis in enumerate(moments.bases):
        singular = torch.linalg.svd(gradients[1])[0 if side == 0 else 2]
        vectors = singular if side == 0 else singular.T
        assert (basis.T @ vectors).abs().numpy() == pytest.approx(torch.eye(5).numpy(), abs=1e-3)


def test_a_smooth_network_is_fitted_in_fewer_steps_than_by_adam() -> None:
    places = torch.rand(256, 2, generator=torch.Generator().manual_seed(2))
    values = torch.sin(3.0 * places[:, :1]) * torch.cos(2.0 * places[:, 1:])
    losses = []
    for soap in (True, False):
        network = seeded_network(lambda: dense_layers([2, 24, 24, 1]), 0)
        curve = train_network(
            network,
            lambda chosen, _: (places[chosen], values[chosen]),
            torch.nn.functional.mse_loss,
            len(places),
            NetworkSettings(0.01, epochs=150, soap=soap),
            0,
            lambda *_: None,
        )
        losses.append(curve.training[-1])
    assert losses[0] < 0.2 * losses[1]
